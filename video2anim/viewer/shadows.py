"""Contact shadows: the floor is darker where something is close above it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.types import Mesh

_CELL_M = 0.03
"""Resolution of the shadow, chosen by eye like the rest."""
_REACH_M = 0.35
"""What is higher casts no contact shadow: light comes from all sides."""
_SOFT_M = 0.07
"""Standard deviation of the blur."""
_DARKEST = 0.6
"""Share of the light that is taken away right under an object."""
_MAX_CELLS = 2000
"""Cells along a side at most."""


def contact_shaded(floor: Mesh, above_m: Sequence[Float[np.ndarray, "points 3"]]) -> UInt8[np.ndarray, "vertices 3"]:
    """Colors of the floor's vertices (y = 0), darkened by points of objects above it (world, m)."""
    if not len(floor.vertices_m) or not above_m:
        return floor.vertex_rgb
    flat = floor.vertices_m[:, [0, 2]].astype(np.float64)
    low, high = flat.min(0), flat.max(0)
    cell_m = max(_CELL_M, float((high - low).max()) / _MAX_CELLS)
    size = np.ceil((high - low) / cell_m).astype(int) + 1
    points_m = np.concatenate([np.asarray(one, np.float64) for one in above_m])
    cell = np.round((points_m[:, [0, 2]] - low) / cell_m).astype(int)
    within = ((cell >= 0) & (cell < size)).all(1) & (points_m[:, 1] < _REACH_M)
    shadow = np.zeros(tuple(size), np.float32)
    strength = 1 - np.clip(points_m[within, 1], 0, _REACH_M) / _REACH_M
    np.maximum.at(shadow, tuple(cell[within].T), strength.astype(np.float32))
    # Points of a surface lie farther apart than cells.
    shadow = cv2.morphologyEx(shadow, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    shadow = cv2.GaussianBlur(shadow, (0, 0), _SOFT_M / cell_m)
    at = np.clip(np.round((flat - low) / cell_m).astype(int), 0, size - 1)
    light = 1 - _DARKEST * shadow[tuple(at.T)]
    return np.round(floor.vertex_rgb * light[:, None]).astype(np.uint8)
