"""A denoiser by its configuration."""

from __future__ import annotations

from scenemi.model.config import AnyConfig, BaselineConfig, PaperConfig
from scenemi.model.denoiser import Denoiser
from scenemi.model.paper import PaperDenoiser, SceneDenoiser

AnyDenoiser = Denoiser | SceneDenoiser


def build_denoiser(config: AnyConfig) -> AnyDenoiser:
    """An untrained denoiser of the shipped form or the paper's; those of other papers are made by
    `scenemi.model.baselines.build`.

    Raises:
        ValueError: a configuration of another paper's method.
    """
    if isinstance(config, BaselineConfig):
        raise ValueError(f"{config.method} is a baseline of `scenemi evaluate`, and fills nothing here")
    return PaperDenoiser(config) if isinstance(config, PaperConfig) else Denoiser(config)
