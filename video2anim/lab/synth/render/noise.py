"""Smooth periodic noise on the plane, interpolated in a table by OpenCV (10 ms for a million points)."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt32

_CELLS, _SIZE = 64, 512
_ROW = 4096


@functools.lru_cache(maxsize=1)
def _table() -> np.ndarray:
    """(512, 512) float32 noise of 64 cells per axis; a quarter of the values are below 0.25, a quarter above 0.75."""
    lattice = np.random.default_rng(20260).standard_normal((_CELLS, _CELLS)).astype(np.float32)
    wrapped = np.pad(lattice, 4, mode="wrap")
    smooth = cv2.resize(wrapped, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)[32:-32, 32:-32]
    spread = smooth / (1.5 * smooth.std())
    return np.ascontiguousarray(0.5 + 0.5 * np.tanh(spread)).astype(np.float32)


def noise(u: Float[np.ndarray, "points"], v: Float[np.ndarray, "points"], seed: int = 0) -> Float[np.ndarray, "points"]:
    """Noise in 0 to 1 with mean 0.5 and a feature size of about 1. `seed` shifts the pattern."""
    count = len(u)
    if not count:
        return np.zeros(0, np.float32)
    row_length = min(count, _ROW)
    rows = -(-count // row_length)
    at = np.zeros((2, rows * row_length), np.float32)
    shift_u, shift_v = (seed * 0.7548776662) % 1.0 * _CELLS, (seed * 0.5698402910) % 1.0 * _CELLS
    for row, value, shift in ((0, u, shift_u), (1, v, shift_v)):
        np.mod((value + np.float32(shift)) * np.float32(_SIZE / _CELLS), _SIZE, out=at[row, :count])
    at[at >= _SIZE] = 0
    shape = (rows, row_length)
    found = cv2.remap(_table(), at[0].reshape(shape), at[1].reshape(shape), cv2.INTER_LINEAR, None, cv2.BORDER_WRAP)
    return found.reshape(-1)[:count]


def fractal(
    u: Float[np.ndarray, "points"],
    v: Float[np.ndarray, "points"],
    footprint: Float[np.ndarray, "points"],
    seed: int = 0,
    octaves: int = 4,
) -> Float[np.ndarray, "points"]:
    """Fractal noise (scales 1, 1/2, 1/4...) with mean 0.5, without scales finer than two pixel footprints."""
    total = np.full(len(u), 0.5, np.float32)
    size, weight = 1.0, 0.5
    for octave in range(octaves):
        fade = detail_weight(footprint, size)
        if not fade.any():
            break
        total += weight * fade * (noise(u / size, v / size, seed + 13 * octave) - 0.5)
        size, weight = 0.5 * size, 0.6 * weight
    return np.clip(total, 0, 1)


def detail_weight(footprint: Float[np.ndarray, "points"], size: float) -> Float[np.ndarray, "points"]:
    """Weight of a detail of this size after averaging over a pixel: 1 above 4 pixels, 0 below 1.3."""
    return np.clip(1.5 - 2.0 * footprint / size, 0, 1).astype(np.float32)


def cell_values(index: Int[np.ndarray, "points"], seed: int = 0) -> Float[np.ndarray, "points"]:
    """A pseudo-random number in 0 to 1 for every integer (of a tile or plank), by an integer hash."""
    x: UInt32[np.ndarray, "points"] = (index.astype(np.int64) + 374761393 * (seed + 1)).astype(np.uint32)
    for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39)):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    x = x ^ (x >> np.uint32(15))
    return (x >> np.uint32(8)).astype(np.float32) / np.float32(1 << 24)
