"""Motion data: reading, retargeting, writing."""
