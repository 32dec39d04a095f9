"""Stages, their graph, and the runner that keeps a scene folder up to date."""
