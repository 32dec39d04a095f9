"""Any scene as a grid of signed distances around a path."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.voxels import VOXEL_M
from video2anim.geometry.sdf import SdfGrid

SPACING_M = VOXEL_M / 2
"""Of nodes."""
AROUND_M = 0.5
"""How far from the path solids are known."""
REACH_M = 0.6
"""Solids farther from a point than this (an arm's length) count as absent."""


def canonical_grid(
    scene: SdfGrid | SceneGeometry, path_m: Float[np.ndarray, "points 3"], T_world_canonical: Float[np.ndarray, "4 4"]
) -> SdfGrid:
    """The scene around a path, both in the canonical frame of a window: a motion turns with its scene.

    Args:
        scene: in the world.
        path_m: canonical points that the body is expected at.
        T_world_canonical: of the window.
    """
    low_m, high_m = path_m.min(0) - AROUND_M, path_m.max(0) + AROUND_M
    if isinstance(scene, SceneGeometry):
        return distance_grid(scene.transformed(np.linalg.inv(T_world_canonical)), low_m, high_m)
    nodes = _nodes(low_m, high_m, SPACING_M)
    world_m = nodes @ T_world_canonical[:3, :3].T + T_world_canonical[:3, 3]
    return SdfGrid(scene.sample(world_m).astype(np.float32), low_m, SPACING_M)


def distance_grid(
    scene: SceneGeometry, low_m: Float[np.ndarray, "3"], high_m: Float[np.ndarray, "3"], spacing_m: float = SPACING_M
) -> SdfGrid:
    """Signed distances to any scene in a box: outside exact up to 0.6 m, inside to half a spacing."""
    nodes = _nodes(low_m, high_m, spacing_m)
    gap_m = scene.nearest_within(nodes.reshape(-1, 3), REACH_M)[1].reshape(nodes.shape[:3])
    solid = gap_m <= 0
    inside = np.asarray(distance_transform_edt(solid)) - 0.5
    return SdfGrid(np.where(solid, -spacing_m * inside, np.minimum(gap_m, REACH_M)), low_m, spacing_m)


def _nodes(low_m: np.ndarray, high_m: np.ndarray, spacing_m: float) -> Float[np.ndarray, "x y z 3"]:
    shape = np.ceil((high_m - low_m) / spacing_m).astype(int) + 1
    return np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1) * spacing_m + low_m
