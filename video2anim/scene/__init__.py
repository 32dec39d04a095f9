"""The scene: floor, walls, ceiling, what is seen beyond, and who touches what."""
