"""The choice between priors, by the weights that are present."""

from __future__ import annotations

from typing import Literal

from scenemi.prior import WEIGHTS_FOLDER, InbetweeningPrior, InterpolationPrior
from video2anim.errors import ModelMissingError, UsageError

PriorChoice = Literal["auto", "interpolation", "scenemi"]
WEIGHTS_NAME = "small"
"""Of the weights that ship; others are taken only where they are named."""


def load_prior(choice: PriorChoice = "auto", *, device: str = "cpu", seed: int = 0) -> InbetweeningPrior:
    """The prior by name; `auto` is `scenemi` where its weights are present, else `interpolation` (see `.name`).

    Args:
        choice: which.
        device: of torch.
        seed: of sampling; interpolation draws nothing.

    Raises:
        ModelMissingError: `scenemi` was asked for and no weights are present.
        UsageError: unknown name.
    """
    if choice not in ("auto", "interpolation", "scenemi"):
        raise UsageError(f"prior: want auto, interpolation or scenemi, got {choice!r}")
    if choice == "interpolation" or (choice == "auto" and not scenemi_available()):
        return InterpolationPrior()
    if not scenemi_available():
        raise ModelMissingError(
            f"prior scenemi: no weights {WEIGHTS_NAME}.safetensors in {WEIGHTS_FOLDER}; set the prior to "
            "'interpolation' or 'auto'"
        )
    from scenemi.model.prior import load_diffusion_prior

    return load_diffusion_prior(WEIGHTS_FOLDER, device=device, weights=WEIGHTS_NAME, seed=seed)


def scenemi_available() -> bool:
    """Whether the weights that `load_prior` takes are installed."""
    return (WEIGHTS_FOLDER / f"{WEIGHTS_NAME}.safetensors").is_file()
