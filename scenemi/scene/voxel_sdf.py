"""Signed distances to what stands on the floor, from voxels, from a scan, or from distances that include the floor.

Scans are open: their triangles have no inside. As voxels they get one, and a body can be told how deep it is in them.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, map_coordinates

from video2anim.errors import InputError
from video2anim.geometry.sampling import surface_samples
from video2anim.geometry.sdf import SdfGrid

SCANNED_FLOOR_M = 0.15
"""A scan's floor lies within this of y = 0."""
FLOOR_BAND_M = 0.05
"""What a capture has below this height is its floor; ours is the plane y = 0."""
_BELOW_M = 0.5
"""Objects go on below the floor by this: nobody leaves them through their bottom."""


def voxel_sdf(solid: Bool[np.ndarray, "x y z"], low_m: Float[np.ndarray, "3"], voxel_m: float) -> SdfGrid:
    """Distances at the centers of voxels to the nearest solid one, inside to the nearest free one; nothing is around
    the grid. Exact at level faces, up to 0.4 voxels too far at edges and corners.

    Args:
        solid: +Y up; what lies below `FLOOR_BAND_M` is taken for the floor y = 0 and left out.
        low_m: lowest corner of voxel (0, 0, 0).
        voxel_m: edge of a voxel.

    Raises:
        InputError: no voxel above the floor is solid.
    """
    first = max(0, math.ceil((FLOOR_BAND_M - low_m[1]) / voxel_m - 0.5))
    standing = solid[:, first:]
    if not standing.any():
        raise InputError("scene: nothing stands on the floor; check the file, or give the clips without their scene")
    below = math.ceil(_BELOW_M / voxel_m)
    standing = np.concatenate([np.repeat(standing[:, :1], below, 1), standing], 1)
    low_m = np.asarray(low_m, np.float64) + voxel_m * np.array([-0.5, first - below - 0.5, -0.5])
    standing = np.pad(standing, 1)
    free_m = np.asarray(distance_transform_edt(~standing, sampling=voxel_m), np.float32)
    depth_m = np.asarray(distance_transform_edt(standing, sampling=voxel_m), np.float32)
    half_m = np.float32(0.5 * voxel_m)
    return SdfGrid(np.where(standing, half_m - depth_m, free_m - half_m), low_m, voxel_m)


def scan_sdf(triangles_m: Float[np.ndarray, "faces 3 3"], voxel_m: float, depth_m: float) -> SdfGrid:
    """A scan, +Y up with the floor near y = 0: solid from its faces to some depth behind them, to half a voxel.

    What faces the scanner is in front, as in every scan; if level faces near the floor look down, all are turned.

    Raises:
        InputError: no triangle, or one that is not finite.
    """
    if not len(triangles_m) or not np.isfinite(triangles_m).all():
        raise InputError("scan: want at least one triangle and finite corners; clean the file")
    normal = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    level = np.abs(normal[:, 1]) > np.hypot(normal[:, 0], normal[:, 2])
    floor = level & (np.abs(triangles_m[:, :, 1].mean(1)) < SCANNED_FLOOR_M)
    if normal[floor, 1].sum() < 0:
        unit = -unit
    samples_m, face = surface_samples(triangles_m, voxel_m)
    low_m, high_m = (f(triangles_m.reshape(-1, 3), axis=0) for f in (np.min, np.max))
    low_m = low_m - depth_m - voxel_m
    solid = np.zeros(np.ceil((high_m + depth_m + voxel_m - low_m) / voxel_m).astype(int), bool)
    # The first layer lies half a voxel behind the surface: voxels then begin there on average.
    for behind_m in np.arange(0.5 * voxel_m, max(depth_m, voxel_m), voxel_m):
        solid[tuple(((samples_m - behind_m * unit[face] - low_m) / voxel_m).astype(int).T)] = True
    return voxel_sdf(solid, low_m, voxel_m)


def standing_sdf(
    sdf_m: Float[np.ndarray, "x y z"], low_m: Float[np.ndarray, "3"], step_m: Float[np.ndarray, "3"]
) -> SdfGrid:
    """The same from distances that include the floor: kept as they are where something is nearer than the floor.

    Args:
        sdf_m: +Y up, floor near y = 0, negative in solids.
        low_m: place of node (0, 0, 0).
        step_m: between nodes along each axis; the largest is the spacing of the result.

    Raises:
        InputError: nothing stands on the floor.
    """
    spacing_m = float(step_m.max())
    shape = np.floor((np.array(sdf_m.shape) - 1) * step_m / spacing_m + 1e-6).astype(int) + 1
    axes = [np.arange(n) * spacing_m / step for n, step in zip(shape, step_m, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij")).astype(np.float32)
    known_m = map_coordinates(np.asarray(sdf_m, np.float32), nodes, order=1, mode="nearest")
    found = voxel_sdf(known_m < 0, low_m - 0.5 * spacing_m, spacing_m)
    x, y, z = np.rint((low_m - found.origin_m) / spacing_m).astype(int)
    cut = max(0, -y)
    known_m, heights_m = known_m[:, cut:], low_m[1] + spacing_m * np.arange(cut, shape[1], dtype=np.float32)[:, None]
    inner = found.sdf_m[x : x + shape[0], y + cut : y + shape[1], z : z + shape[2]]
    nearer = (known_m < heights_m - spacing_m) & (heights_m > FLOOR_BAND_M)
    inner[nearer] = known_m[nearer]
    return found
