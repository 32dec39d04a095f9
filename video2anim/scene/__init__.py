"""The scene: room surfaces and who touches what."""
