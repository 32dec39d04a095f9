"""People from frame to frame: detection, appearance, identities."""
