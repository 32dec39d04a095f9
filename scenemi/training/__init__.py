"""Training of the denoiser: batches, losses, one loop, checkpoints."""
