"""Voxels as something solid: what occupancy grids, distance grids and scans of rooms become.

They have an inside, unlike the triangles of an open scan, so a body can be told to be in them and how deep.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from video2anim.errors import InputError
from video2anim.geometry.sdf import surface_samples

_NEIGHBORS = 4
"""Voxel centers looked at: the nearest center need not be that of the nearest voxel."""
_LEVEL = 0.8
"""Vertical part of the unit normal of a triangle that counts as level."""
_FLOOR_BAND_M = 0.15


class VoxelSolid:
    """Upright voxels, solid or free, and nothing around the grid.

    Distances are to the nearest voxel as a box, so they are as exact as the voxels themselves (tests: 2 % of a voxel).
    """

    def __init__(
        self, solid: Bool[np.ndarray, "x y z"], low_m: Float[np.ndarray, "3"], voxel_m: Float[np.ndarray, "3"]
    ) -> None:
        """
        Args:
            solid: the voxels.
            low_m: lowest corner of voxel (0, 0, 0).
            voxel_m: edges of a voxel.

        Raises:
            InputError: no voxel is solid.
        """
        if not solid.any():
            raise InputError("scene voxels: none is solid; check the file, or give the clips without their scene")
        self.solid, self.voxel_m = np.pad(solid, 1), np.asarray(voxel_m, np.float64)
        self.low_m = np.asarray(low_m, np.float64) - self.voxel_m

    @classmethod
    def of_scan(cls, triangles_m: Float[np.ndarray, "faces 3 3"], voxel_m: float, depth_m: float) -> VoxelSolid:
        """A scan, +Y up with the floor near y = 0: solid from its faces to some depth behind them.

        What faces the scanner is in front, as in every scan; if level faces near the floor look down, all are turned.

        Raises:
            InputError: no triangle, or one that is not finite.
        """
        if not len(triangles_m) or not np.isfinite(triangles_m).all():
            raise InputError("scan: want at least one triangle and finite corners; clean the file")
        normal = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
        unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        floor = (np.abs(unit[:, 1]) > _LEVEL) & (np.abs(triangles_m[:, :, 1].mean(1)) < _FLOOR_BAND_M)
        if normal[floor, 1].sum() < 0:
            unit = -unit
        samples_m, face = surface_samples(triangles_m, voxel_m)
        low_m = triangles_m.reshape(-1, 3).min(0) - depth_m - voxel_m
        shape = np.ceil((triangles_m.reshape(-1, 3).max(0) + depth_m + voxel_m - low_m) / voxel_m).astype(int)
        solid = np.zeros(shape, bool)
        # From half a voxel behind the surface: voxels then reach as often before it as they end behind it.
        for behind_m in np.arange(0.5 * voxel_m, max(depth_m, voxel_m), voxel_m):
            index = ((samples_m - behind_m * unit[face] - low_m) / voxel_m).astype(int)
            solid[tuple(index.T)] = True
        return cls(solid, low_m, np.full(3, voxel_m))

    def above(self, y_m: float) -> VoxelSolid:
        """Without the voxels whose center is lower.

        Raises:
            InputError: nothing is left.
        """
        centers_m = self.low_m[1] + self.voxel_m[1] * (np.arange(self.solid.shape[1]) + 0.5)
        return VoxelSolid(self.solid & (centers_m >= y_m)[None, :, None], self.low_m, self.voxel_m)

    @property
    def bounds_m(self) -> Float[np.ndarray, "2 3"]:
        """Lowest and highest corner of the grid."""
        return np.stack([self.low_m, self.low_m + self.voxel_m * self.solid.shape])

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """See `scenemi.scene.geometry.Solid`."""
        inside = self.contains(points_m)
        found_m, gap_m = points_m.copy(), np.where(inside, 0.0, np.inf)
        rows = np.flatnonzero(~inside)
        found_m[rows], gap_m[rows] = self._nearest_voxel(self._skin, points_m[rows], reach_m)
        return found_m, gap_m

    def signed_distance(self, points_m: Float[np.ndarray, "... 3"], reach_m: float) -> Float[np.ndarray, "..."]:
        """Distance to the nearest solid voxel, inside minus that to the nearest free one; within +-`reach_m`."""
        flat = np.asarray(points_m, np.float64).reshape(-1, 3)
        inside = self.contains(flat)
        distance_m = np.empty(len(flat))
        for sign, rows, tree in ((1, ~inside, self._skin), (-1, inside, self._lining)):
            distance_m[rows] = sign * np.minimum(self._nearest_voxel(tree, flat[rows], reach_m)[1], reach_m)
        return distance_m.reshape(np.shape(points_m)[:-1])

    def contains(self, points_m: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
        """Whether each point lies in a solid voxel."""
        index = np.floor((points_m - self.low_m) / self.voxel_m)
        within = ((index >= 0) & (index < self.solid.shape)).all(1)
        found = np.zeros(len(points_m), bool)
        found[within] = self.solid[tuple(index[within].astype(int).T)]
        return found

    def _nearest_voxel(
        self, tree: KDTree, points_m: np.ndarray, reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """Nearest point of the voxels of a tree, and its distance; the point itself and infinity beyond reach."""
        count = min(_NEIGHBORS, tree.n)
        half_m = 0.5 * self.voxel_m
        _, index = tree.query(points_m, count, distance_upper_bound=reach_m + float(np.linalg.norm(half_m)))
        index = np.asarray(index).reshape(len(points_m), count)
        best_m, best_gap_m = points_m.copy(), np.full(len(points_m), np.inf)
        for column in index.T:
            rows = np.flatnonzero(column < tree.n)
            center_m = tree.data[column[rows]]
            found_m = np.clip(points_m[rows], center_m - half_m, center_m + half_m)
            gap_m = np.linalg.norm(found_m - points_m[rows], axis=1)
            closer = gap_m < np.minimum(best_gap_m[rows], reach_m)
            best_m[rows[closer]], best_gap_m[rows[closer]] = found_m[closer], gap_m[closer]
        return best_m, best_gap_m

    @functools.cached_property
    def _skin(self) -> KDTree:
        """Centers of solid voxels with a free neighbor."""
        return self._tree(self.solid & _touching(~self.solid))

    @functools.cached_property
    def _lining(self) -> KDTree:
        """Centers of free voxels with a solid neighbor."""
        return self._tree(~self.solid & _touching(self.solid))

    def _tree(self, chosen: Bool[np.ndarray, "x y z"]) -> KDTree:
        index: Int[np.ndarray, "voxels 3"] = np.argwhere(chosen)
        return KDTree(self.low_m + self.voxel_m * (index + 0.5), balanced_tree=False, compact_nodes=False)


def _touching(voxels: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Voxels that share a face, an edge or a corner with one of these."""
    for axis in range(3):
        wider = voxels.copy()
        ends: Sequence[slice] = (slice(1, None), slice(None, -1))
        for a, b in (ends, ends[::-1]):
            target, source = [slice(None)] * 3, [slice(None)] * 3
            target[axis], source[axis] = a, b
            wider[tuple(target)] |= voxels[tuple(source)]
        voxels = wider
    return voxels
