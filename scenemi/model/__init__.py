"""The denoiser, its diffusion process, samplers and weights."""
