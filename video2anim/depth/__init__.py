"""Depth of frames and background: planar proxy, people, alignment over time."""
