"""Poses between frames, for many windows at once.

Cubic (Catmull-Rom) in time for the root and for the components of quaternions, which are then brought to length 1.
Unlike slerp between two frames this leaves no kink at each frame: warped clips keep the jerk of the original.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, Shaped


def nearest_rows(position: Float[np.ndarray, "*batch"], count: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
    """Frame nearest to a position, in [0, count)."""
    return np.clip(np.rint(position).astype(np.int64), 0, count - 1)


def cubic_taps(
    position: Float[np.ndarray, "*batch"], count: Int[np.ndarray, "*batch"]
) -> tuple[Int[np.ndarray, "*batch 4"], Float[np.ndarray, "*batch 4"]]:
    """Four frames in [0, count) and their weights for each position in [0, count - 1]; positions outside are held."""
    position = np.clip(position, 0.0, count - 1.0)
    below = np.floor(position).astype(np.int64)
    u = (position - below)[..., None]
    weights = 0.5 * np.concatenate(
        [u * (-1 + u * (2 - u)), 2 + u * u * (3 * u - 5), u * (1 + u * (4 - 3 * u)), u * u * (u - 1)], -1
    )
    rows = below[..., None] + np.arange(-1, 3)
    return np.clip(rows, 0, np.asarray(count)[..., None] - 1), weights


def blended(
    values: Shaped[np.ndarray, "rows *shape"], rows: Int[np.ndarray, "*batch 4"], weights: Float[np.ndarray, "*batch 4"]
) -> Shaped[np.ndarray, "*batch *shape"]:
    """Weighted sum of four rows of `values` each."""
    shape = (*rows.shape[:-1], *([1] * (values.ndim - 1)))
    weights = weights.astype(values.dtype)
    total = values[rows[..., 0]] * weights[..., 0].reshape(shape)
    for tap in range(1, 4):
        total += values[rows[..., tap]] * weights[..., tap].reshape(shape)
    return total


def unit(quaternion: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Quaternions of length 1."""
    return quaternion / np.sqrt(np.einsum("...i,...i->...", quaternion, quaternion))[..., None]
