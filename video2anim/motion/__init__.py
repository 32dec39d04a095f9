"""The final motion: keyframe roots, observation, movable objects, refinement, and quality."""
