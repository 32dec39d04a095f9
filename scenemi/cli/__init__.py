"""The `scenemi` command."""
