"""The final motion: keyframes and their roots, the observation, the scene that gives way, and quality."""
