"""Synthetic clips, evaluation, and training of the networks. `run` never imports it."""
