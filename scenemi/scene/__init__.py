"""What the model sees of a scene: occupied voxels around the person, offsets from the skin to the nearest solid."""
