"""Fixed sample patterns: every pixel of a 4 x 4 tile samples another part of a light or of the hemisphere.

A 4 x 4 box filter (`denoise`) then averages over all parts, so that a few rays per pixel give soft shadows without
noise. With a static camera the pattern is the same in every frame.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float, Int

TILE = 4
_ORDER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
"""Ordered-dither ranks: neighbors in the tile get distant samples."""
_R3 = np.array([0.8191725134, 0.6710436067, 0.5497004779])
"""Steps of the R3 low-discrepancy sequence (Roberts 2018)."""


def tile_of(pixel: Int[np.ndarray, "pixels"], width: int) -> Int[np.ndarray, "pixels"]:
    """Index in the 4 x 4 tile of pixels given by flat index."""
    return _ORDER[(pixel // width) % TILE, (pixel % width) % TILE]


@functools.lru_cache(maxsize=16)
def sample_points(samples: int) -> Float[np.ndarray, "tiles samples 3"]:
    """Evenly distributed points of the unit cube for each pixel of the tile."""
    index = np.arange(TILE * TILE * samples).reshape(TILE * TILE, samples, 1)
    return ((0.5 + index * _R3) % 1.0).astype(np.float32)


def disc(unit_points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 2"]:
    """Points uniformly distributed on the unit disc, from points of the unit cube."""
    radius, angle = np.sqrt(unit_points[..., 0]), 2 * np.pi * unit_points[..., 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1).astype(np.float32)


def cosine_lobe(unit_points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Cosine-weighted unit directions about +z, from points of the unit cube."""
    flat = disc(unit_points)
    up = np.sqrt(np.maximum(1 - (flat * flat).sum(-1, keepdims=True), 0))
    return np.concatenate([flat, up], -1).astype(np.float32)


def frame_about(
    axis: Float[np.ndarray, "points 3"],
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"]]:
    """Two unit vectors that form a right-handed orthonormal frame with each unit axis (Duff et al. 2017)."""
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    sign = np.where(z >= 0, np.float32(1), np.float32(-1))
    a = -1 / (sign + z)
    b = x * y * a
    return (
        np.stack([1 + sign * x * x * a, sign * b, -sign * x], -1),
        np.stack([b, sign + y * y * a, -y], -1),
    )
