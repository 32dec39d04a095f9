"""Keyframes of a motion: which frames are reliable, and how far each is off."""
