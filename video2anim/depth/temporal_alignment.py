"""Temporal alignment of the depth of a static camera: every frame's depth is fitted to that of the background image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

_ROUNDS = 8
"""Steps of reweighting."""
_HUBER = 1.5
"""Residuals beyond so many standard deviations weigh less."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Depth of the sampled frames in the units of the background image."""

    value: Float[np.ndarray, "samples height width"]
    sigma: Float[np.ndarray, "samples height width"]
    valid: Bool[np.ndarray, "samples height width"]
    lost: int
    """Frames that could not be aligned; their people are invalid."""
    flicker_before: float | None
    """As in `flicker`; None where no pixel is background in all frames."""
    flicker_after: float | None


def aligned_to_background(
    value: Float[np.ndarray, "samples height width"],
    sigma: Float[np.ndarray, "samples height width"],
    valid: Bool[np.ndarray, "samples height width"],
    background: tuple[
        Float[np.ndarray, "height width"], Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]
    ],
    person_mask: Bool[np.ndarray, "samples height width"],
) -> Alignment:
    """People keep the depth of their own frame, aligned; all else has the depth of the background image.

    Args:
        value: Depth of each frame, up to a scale and offset of its own.
        sigma: Its standard deviation.
        valid: Where it is valid.
        background: Value, standard deviation and validity of the background image.
        person_mask: Pixels that show people.
    """
    still = background[2] & ~person_mask.any(0)
    aligned = Alignment(
        value.copy(), sigma.copy(), valid.copy(), 0, flicker(value, still) if still.any() else None, None
    )
    lost = 0
    for sample, people in enumerate(person_mask):
        line = fitted_line(value[sample], background[0], background[2] & ~people)
        if line is None:
            lost += 1
            aligned.valid[sample] = False
            line = (1.0, 0.0)
        aligned.value[sample] = np.where(people, line[0] * value[sample] + line[1], background[0])
        aligned.sigma[sample] = np.where(people, line[0] * sigma[sample], background[1])
        aligned.valid[sample] = np.where(people, aligned.valid[sample], background[2])
    after = flicker(aligned.value, still) if still.any() else None
    return replace(aligned, lost=lost, flicker_after=after)


def fitted_line(
    value: Float[np.ndarray, "..."],
    reference: Float[np.ndarray, "..."],
    chosen: Bool[np.ndarray, "..."],
    *,
    least: int = 60,
) -> tuple[float, float] | None:
    """Scale and offset that bring `value` to `reference` over the chosen pixels, robustly (reweighted least squares).

    Returns None where fewer than `least` pixels are chosen, or no positive scale fits.
    """
    x, y = value[chosen].astype(np.float64), reference[chosen].astype(np.float64)
    if x.size < least or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    weight = np.ones_like(x)
    scale, offset = 1.0, 0.0
    for _ in range(_ROUNDS):
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        spread = np.average((x - mean_x) ** 2, weights=weight)
        scale = float(np.average((x - mean_x) * (y - mean_y), weights=weight) / max(spread, 1e-12))
        offset = float(mean_y - scale * mean_x)
        miss = np.abs(scale * x + offset - y)
        limit = _HUBER * max(float(np.median(miss)) / 0.6745, 1e-9)
        weight = np.minimum(1.0, limit / np.maximum(miss, 1e-12))
    return (scale, offset) if scale > 0 else None


def flicker(values: Iterable[Float[np.ndarray, "height width"]], still: Bool[np.ndarray, "height width"]) -> float:
    """Median over still pixels of the deviation over time, as a share of the range of values in the clip."""
    stack = np.stack([value[still] for value in values]).astype(np.float64)
    low, high = np.percentile(stack, [2, 98])
    return float(np.median(stack.std(0)) / max(high - low, 1e-12))
