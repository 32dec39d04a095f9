"""A denoiser by its configuration."""

from __future__ import annotations

from scenemi.model.config import AnyConfig, PaperConfig
from scenemi.model.denoiser import Denoiser
from scenemi.model.paper import PaperDenoiser

AnyDenoiser = Denoiser | PaperDenoiser


def build_denoiser(config: AnyConfig) -> AnyDenoiser:
    """An untrained denoiser."""
    return PaperDenoiser(config) if isinstance(config, PaperConfig) else Denoiser(config)
