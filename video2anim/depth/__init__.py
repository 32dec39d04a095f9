"""Depth by a network: uncertainty from hue jitter, and alignment over time."""
