"""The clip's camera: whether it moves, its focal length, and the up direction."""
