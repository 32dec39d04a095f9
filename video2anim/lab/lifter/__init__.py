"""Training of the temporal lifter: bodies in motion in front of random cameras, with realistic landmark errors."""
