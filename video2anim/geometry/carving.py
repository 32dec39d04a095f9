"""A solid from one view with depth: everything in a thing's box that the camera does not see to be free.

Space carving (Kutulakos and Seitz 2000) with a depth map for the free space; furniture is mostly mirror-symmetric, so
what is free on one side is free on the other where the seen surface does not speak against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.upright_box import UprightBox
from video2anim.types.camera import Intrinsics

_SYMMETRY_BROKEN = 0.06
"""Mirrored surface in free space, as a share of the seen surface, from which a thing is not symmetric."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectView:
    """One picture of a thing, at the size of the depth map."""

    depth_m: Float[np.ndarray, "height width"]
    known: Bool[np.ndarray, "height width"]
    """Pixels whose depth counts; the others hide whatever is behind them."""
    own: Bool[np.ndarray, "height width"]
    """The thing's visible pixels."""
    floor: Bool[np.ndarray, "height width"]
    """Pixels that show the floor: nothing stands before it there, however near."""
    T_world_camera: Float[np.ndarray, "4 4"]
    intrinsics: Intrinsics
    shows: Bool[np.ndarray, "height width"] | None = None
    """Those of its pixels that show the thing itself, not what is behind it; all of them where that is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Cubes in axes of a box; cube (i, j, k) has its lowest corner at origin + spacing * (i, j, k)."""

    filled: Bool[np.ndarray, "x y z"]
    surface: Bool[np.ndarray, "x y z"]
    """Cubes that hold seen points."""
    origin_m: Float[np.ndarray, "3"]
    spacing_m: float
    mirrored: tuple[str, ...]
    """Axes about whose middle the thing is taken to be symmetric."""


def carve(
    box: UprightBox,
    view: ObjectView,
    points_world_m: Float[np.ndarray, "points 3"],
    *,
    most_along: int = 40,
    blur_m: float = 0.0,
) -> Voxels:
    """Cubes of the box that are not seen to be free.

    Args:
        box: Around the thing.
        view: What the camera sees.
        points_world_m: The thing's seen points; their cubes stay.
        most_along: Cubes along the longest side.
        blur_m: How far off depth may be: nothing nearer than this to the thing's own surface is called free, nor nearer
            than half of it to what is seen beside the thing.
    """
    spacing_m = float(max(box.size_m.max() / most_along, 0.01))
    count = np.maximum(np.ceil(box.size_m / spacing_m - 1e-6).astype(int), 1)
    origin_m = box.middle_m - 0.5 * spacing_m * count
    origin_m[1] = box.low_m[1]
    centre = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in count), indexing="ij"), -1) * spacing_m + origin_m
    free = _seen_free(centre.reshape(-1, 3) @ box.R_world_box.T, view, spacing_m, blur_m).reshape(count)
    surface = np.zeros(tuple(count), bool)
    index = np.floor((box.to_box(points_world_m) - origin_m) / spacing_m - 1e-9).astype(int)
    index = np.where(index == -1, 0, index)
    index = index[((index >= 0) & (index < count)).all(1)]
    surface[tuple(index.T)] = True
    free &= ~surface
    mirrored = []
    for axis, name in ((0, "x"), (2, "z")):
        if box.measured[axis] and surface.any():
            broken = (np.flip(surface, axis) & _well_inside(free)).sum() / surface.sum()
            if broken < _SYMMETRY_BROKEN:
                free |= np.flip(free, axis) & ~surface
                mirrored.append(name)
    filled = _main_piece(~free, surface)
    return Voxels(filled, surface, origin_m, spacing_m, tuple(mirrored))


def _seen_free(
    centres_world_m: np.ndarray, view: ObjectView, spacing_m: float, blur_m: float
) -> Bool[np.ndarray, "cubes"]:
    """Cubes in front of what the camera sees in their pixel."""
    camera_m = transform_points(invert_rigid(view.T_world_camera), centres_world_m)
    z = camera_m[:, 2]
    pixel = np.round(project(np.column_stack([camera_m[:, :2], np.maximum(z, 0.05)]), view.intrinsics)).astype(int)
    height, width = view.depth_m.shape
    inside = (z > 0.05) & (pixel >= 0).all(1) & (pixel < [width, height]).all(1)
    free = np.zeros(len(z), bool)
    column, row = pixel[inside].T
    own, depth = view.own[row, column], view.depth_m[row, column]
    # A cube's middle is up to half its diagonal from its nearest part; beside the thing that part is seen to be free.
    margin = np.where(own, 0.87 * spacing_m + blur_m, 0.5 * spacing_m + 0.5 * blur_m)
    margin[view.floor[row, column]] = 0.0
    free[inside] = view.known[row, column] & (z[inside] < depth - margin)
    return free


def _well_inside(free: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Free cubes without their outermost layer, which a slightly wrong middle would bring onto the surface."""
    return np.asarray(ndimage.binary_erosion(free, np.ones((3, 3, 3)), border_value=1), bool)


def _main_piece(filled: np.ndarray, surface: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Pieces that hold a good part of the seen surface; all of them if none does."""
    pieces = np.zeros(filled.shape, np.int32)
    count = int(ndimage.label(filled, np.ones((3, 3, 3)), output=pieces))  # type: ignore[arg-type]
    if count < 2 or not surface.any():
        return filled
    seen = np.bincount(pieces[surface], minlength=count + 1)[1:]
    return np.isin(pieces, 1 + np.flatnonzero(seen >= 0.05 * seen.max()))
