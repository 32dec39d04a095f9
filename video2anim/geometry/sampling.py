"""Choosing points that represent others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def farthest_points(points_m: Float[np.ndarray, "points 3"], count: int) -> Int[np.ndarray, "chosen"]:
    """Farthest-point sampling from point 0; all points where there are no more than `count`."""
    if len(points_m) <= count:
        return np.arange(len(points_m))
    chosen = [0]
    nearest = np.linalg.norm(points_m - points_m[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points_m - points_m[chosen[-1]], axis=1))
    return np.array(chosen)
