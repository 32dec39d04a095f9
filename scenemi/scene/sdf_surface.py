"""Nearest solid points of a signed-distance grid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from video2anim.errors import InputError
from video2anim.geometry.sdf import SdfGrid

_STEPS = 4
"""Walks along the gradient until the distance is used up."""
_RESIDUAL = 0.05
"""Share of the spacing that may be left for a walk to count as arrived."""


class SdfSolid:
    """The part of a grid where the distance is negative.

    A point walks down the gradient by its distance until it reaches the surface; where a walk does not arrive (edges,
    outside the grid) the nearest crossing of a grid edge by the surface stands in, and so it does where it is nearer.
    Faces are exact. Edges and corners are as round as the grid makes them: against boxes with a spacing of 5 cm the
    distance is up to 4 cm too large at corners (95 % of points: below 1 cm), see tests.
    """

    def __init__(self, grid: SdfGrid) -> None:
        if not np.isfinite(grid.sdf_m).all():
            raise InputError("scene distance grid: NaN or infinity in it; build it again")
        crossings_m = _edge_crossings(grid)
        if not len(crossings_m):
            raise InputError("scene distance grid: no surface in it; give no scene where nothing is known")
        self._grid, self._crossings_m, self._tree = grid, crossings_m, KDTree(crossings_m)

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """See `scenemi.scene.geometry.Solid`."""
        value_m = self._grid.sample(points_m)
        found_m, gap_m = points_m.copy(), np.where(value_m <= 0, 0.0, np.inf)
        rows = np.flatnonzero((value_m > 0) & (value_m <= reach_m + self._grid.spacing_m))
        if len(rows):
            gap_m[rows], index = self._tree.query(points_m[rows], workers=-1)
            found_m[rows] = self._crossings_m[index]
            walked_m = self._walked(points_m[rows])
            walked_gap_m = np.linalg.norm(walked_m - points_m[rows], axis=-1)
            arrived = np.abs(self._grid.sample(walked_m)) < _RESIDUAL * self._grid.spacing_m
            closer = np.flatnonzero(arrived & (walked_gap_m < gap_m[rows]))
            found_m[rows[closer]], gap_m[rows[closer]] = walked_m[closer], walked_gap_m[closer]
        far = gap_m > reach_m
        found_m[far], gap_m[far] = points_m[far], np.inf
        return found_m, gap_m

    def _walked(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        step_m = 0.25 * self._grid.spacing_m
        for _ in range(_STEPS):
            slopes = [
                self._grid.sample(points_m + step_m * axis) - self._grid.sample(points_m - step_m * axis)
                for axis in np.eye(3)
            ]
            gradient = np.stack(slopes, -1)
            gradient /= np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-9)
            points_m = points_m - self._grid.sample(points_m)[:, None] * gradient
        return points_m


def _edge_crossings(grid: SdfGrid) -> Float[np.ndarray, "crossings 3"]:
    """Where the distance passes through zero on the edges of the grid, by linear interpolation."""
    found_m = []
    sdf_m = np.asarray(grid.sdf_m, np.float64)
    for axis in range(3):
        low, high = (np.take(sdf_m, range(s, sdf_m.shape[axis] - 1 + s), axis) for s in (0, 1))
        node = np.argwhere((low <= 0) != (high <= 0))
        if not len(node):
            continue
        a, b = low[tuple(node.T)], high[tuple(node.T)]
        place = node.astype(np.float64)
        place[:, axis] += a / (a - b)
        found_m.append(grid.origin_m + grid.spacing_m * place)
    return np.concatenate(found_m) if found_m else np.zeros((0, 3))
