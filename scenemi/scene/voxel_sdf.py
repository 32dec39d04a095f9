"""Signed distances of what is published as voxels, as a scan, or as another distance grid.

Scans are open: their triangles have no inside. As voxels they get one, and a body can be told how deep it is in them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, map_coordinates

from video2anim.errors import InputError
from video2anim.geometry.sdf import SdfGrid, surface_samples

_LEVEL = 0.8
"""Vertical part of the unit normal of a triangle that counts as level."""
_FLOOR_BAND_M = 0.15


def voxel_sdf(solid: Bool[np.ndarray, "x y z"], low_m: Float[np.ndarray, "3"], voxel_m: float) -> SdfGrid:
    """Distances at the centers of voxels to the nearest solid one, inside to the nearest free one; nothing is around
    the grid. Exact at level faces, at most a fifth of a voxel too far at edges and corners.

    Args:
        solid: the voxels.
        low_m: lowest corner of voxel (0, 0, 0).
        voxel_m: edge of a voxel.

    Raises:
        InputError: no voxel is solid.
    """
    if not solid.any():
        raise InputError("scene voxels: none is solid; check the file, or give the clips without their scene")
    solid = np.pad(solid, 1)
    free_m = np.asarray(distance_transform_edt(~solid, sampling=voxel_m), np.float32)
    depth_m = np.asarray(distance_transform_edt(solid, sampling=voxel_m), np.float32)
    half_m = np.float32(0.5 * voxel_m)
    return SdfGrid(np.where(solid, half_m - depth_m, free_m - half_m), np.asarray(low_m) - half_m, voxel_m)


def scan_sdf(triangles_m: Float[np.ndarray, "faces 3 3"], voxel_m: float, depth_m: float) -> SdfGrid:
    """A scan, +Y up with the floor near y = 0: solid from its faces to some depth behind them, or half a voxel more.

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
    low_m, high_m = (f(triangles_m.reshape(-1, 3), axis=0) for f in (np.min, np.max))
    low_m = low_m - depth_m - voxel_m
    solid = np.zeros(np.ceil((high_m + depth_m + voxel_m - low_m) / voxel_m).astype(int), bool)
    # The first layer lies half a voxel behind the surface: voxels then begin there on average.
    for behind_m in np.arange(0.5 * voxel_m, max(depth_m, voxel_m), voxel_m):
        solid[tuple(((samples_m - behind_m * unit[face] - low_m) / voxel_m).astype(int).T)] = True
    return voxel_sdf(solid, low_m, voxel_m)


def regular_sdf(
    sdf_m: Float[np.ndarray, "x y z"], low_m: Float[np.ndarray, "3"], step_m: Float[np.ndarray, "3"]
) -> SdfGrid:
    """A grid whose axes have steps of their own, with one spacing (the largest of them).

    Args:
        sdf_m: signed distances, negative in solids.
        low_m: place of node (0, 0, 0).
        step_m: between nodes along each axis.
    """
    spacing_m = float(step_m.max())
    shape = np.floor((np.array(sdf_m.shape) - 1) * step_m / spacing_m + 1e-6).astype(int) + 1
    axes = [np.arange(n) * spacing_m / step for n, step in zip(shape, step_m, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij")).astype(np.float32)
    values = map_coordinates(np.asarray(sdf_m, np.float32), nodes, order=1, mode="nearest")
    return SdfGrid(values, np.asarray(low_m, np.float64), spacing_m)


def above(grid: SdfGrid, y_m: float) -> SdfGrid:
    """What of the solids lies above a height; outside, distances are exact above it and too small below."""
    heights_m = grid.origin_m[1] + grid.spacing_m * np.arange(grid.sdf_m.shape[1], dtype=np.float32)
    return SdfGrid(np.maximum(grid.sdf_m, (y_m - heights_m)[:, None]), grid.origin_m, grid.spacing_m)
