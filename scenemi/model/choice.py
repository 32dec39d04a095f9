"""The prior a command line or a table asks for, by the name of its weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from scenemi.prior import SAMPLE_STEPS, InbetweeningPrior, InterpolationPrior
from video2anim.errors import ModelMissingError, UsageError

INTERPOLATION = "interpolation"


def load_prior_by_name(
    weights: str = "small",
    *,
    device: str = "cpu",
    steps: int | None = None,
    temperature: float | None = None,
    seed: int = 0,
    **sampler: Any,
) -> InbetweeningPrior:
    """The prior with weights `small` or a file (of the shipped model, or of a baseline), or `interpolation`.

    Args:
        weights: name or path of the weights.
        device: cpu or cuda.
        steps: of the sampler; None = one, the expected motion, or 20 where a temperature is given, and for baselines.
            Its whole schedule (1000) is sampled by DDPM, as in the paper.
        temperature: of the sampler; None = its default.
        seed: of `fill`.
        sampler: other fields of `SamplerConfig`.

    Raises:
        ModelMissingError: no such weights.
        UsageError: an impossible sampler.
    """
    if weights == INTERPOLATION:
        return InterpolationPrior()
    from scenemi.model.baselines.build import build_any
    from scenemi.model.baselines.prior import prior_of, sampler_of
    from scenemi.model.diffusion import STEPS
    from scenemi.model.weights import load_weights

    try:
        model = load_weights(weights, build=build_any)
    except ModelMissingError as error:
        raise ModelMissingError(f"{error}; --weights {INTERPOLATION} needs none") from error
    try:
        config = replace(sampler_of(model.denoiser), **sampler)
        if temperature is not None:
            config, steps = replace(config, temperature=temperature), steps or SAMPLE_STEPS
        if steps is not None:
            method = "ddpm" if steps >= STEPS else config.method
            config = replace(config, steps=steps, method=method)
    except ValueError as error:
        raise UsageError(f"sampler: {error}") from error
    return prior_of(model, config, device=device, seed=seed)
