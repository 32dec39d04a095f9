"""Rotations, rigid transforms, cameras and point-set distances: pure maths, no files."""
