"""The prior a command line or a table asks for, by the name of its weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from scenemi.prior import WEIGHTS_FOLDER, InbetweeningPrior, InterpolationPrior
from video2anim.errors import ModelMissingError, UsageError

INTERPOLATION = "interpolation"


SAMPLE_STEPS = 20
"""Of motions that differ by their seeds; the expected motion takes one step."""


def load_prior_by_name(
    weights: str = "small",
    *,
    device: str = "cpu",
    steps: int | None = None,
    temperature: float | None = None,
    seed: int = 0,
    **sampler: Any,
) -> InbetweeningPrior:
    """The diffusion prior with weights `small` or a file, or `interpolation`.

    Args:
        weights: name or path of the weights.
        device: cpu or cuda.
        steps: of the sampler; None = one, the expected motion, or 20 where a temperature is given. Its whole schedule
            (1000) is sampled by DDPM, as in the paper.
        temperature: of the sampler; None = its default.
        seed: of `fill`.
        sampler: other fields of `SamplerConfig`.

    Raises:
        ModelMissingError: no such weights.
        UsageError: an impossible sampler.
    """
    if weights == INTERPOLATION:
        return InterpolationPrior()
    from scenemi.model.diffusion import STEPS
    from scenemi.model.prior import load_diffusion_prior
    from scenemi.model.sampling import SamplerConfig

    try:
        config = SamplerConfig(**sampler)
        if temperature is not None:
            config, steps = replace(config, temperature=temperature), steps or SAMPLE_STEPS
        if steps is not None:
            method = "ddpm" if steps >= STEPS else config.method
            config = replace(config, steps=steps, method=method)
    except ValueError as error:
        raise UsageError(f"sampler: {error}") from error
    try:
        prior = load_diffusion_prior(WEIGHTS_FOLDER, device=device, weights=weights, sampler=config)
    except ModelMissingError as error:
        raise ModelMissingError(f"{error}; --weights {INTERPOLATION} needs none") from error
    prior.seed = seed
    return prior
