"""Depth of a still camera's clip without flicker: every picture's answer brought to that of the empty background
image."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

_ROUNDS = 8
_HUBER = 1.5
"""Residuals beyond so many deviations weigh less."""


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
