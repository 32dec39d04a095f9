"""Camera motion from the picture."""
