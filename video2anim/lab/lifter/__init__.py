"""Training of the temporal lifter: bodies in motion before random cameras, seen through real landmark errors."""
