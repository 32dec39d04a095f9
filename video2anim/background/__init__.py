"""The background image, and which pixels are the person."""
