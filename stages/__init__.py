"""The pipeline's stages, one module each; none imports another. `video2anim.cli.compose` puts them in order."""
