"""Synthetic clips with ground truth: rooms, people, cameras, and images with per-pixel labels."""
