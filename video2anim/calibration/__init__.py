"""Joint calibration of camera, body heights, floor, depth scale and object distances (docs/calibration.md)."""
