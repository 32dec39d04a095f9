"""The background image and the masks of people."""
