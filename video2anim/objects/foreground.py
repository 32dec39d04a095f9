"""Foreground pixels of an object's mask.

Masks of networks also hold floor and wall, between the legs of a chair and along outlines. These pixels would stretch
the backprojected object to what is behind it. They are found by the depth of the room without its objects.
"""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.harmonic import harmonic_fill
from video2anim.geometry.projection import backproject, transform_points
from video2anim.objects.depth_regions import NEARER_RATIO
from video2anim.types.camera import View

_CELLS = 96
"""Resolution of the filled-in background, along the longer side."""
_MIXED_PX = 3
"""Pixels at an outline whose depths are mixed."""
_BACKGROUND = 0.75
"""Pixels of such an object at this share of the way to the background are background."""
_FLOOR_M = 0.03
_FLOOR_SHARE = 0.01
"""Height below which a pixel may be floor: `_FLOOR_M` plus this share of its distance."""
_LOWEST_SHARE = 0.2
"""Maximum share of an object's height that may be floor, so that low objects stay."""
_GRAZING = 0.12
"""Minimum cosine between ray and normal; below it pixels interpolate between two surfaces."""
_MIN_PIXELS = 30
_MIN_SHARE = 0.15
"""Minimum share of the pixels with depth that is kept; otherwise all are."""

_Meters = TypeVar("_Meters", float, np.ndarray)


def inverse_background(
    depth_m: Float[np.ndarray, "height width"],
    known: Bool[np.ndarray, "height width"],
    objects: Bool[np.ndarray, "height width"],
    floor: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"] | None:
    """Inverse depth of the background behind all objects, in 1/m; None where the image shows none of it.

    A plane's inverse depth is linear in the picture, so the gaps are filled with the harmonic function.

    Args:
        depth_m: Depth of the whole picture.
        known: Pixels whose depth counts.
        objects: Pixels of any object.
        floor: Pixels of the floor, which is no upright background.
    """
    near_objects, near_floor = (
        cv2.dilate(mask.astype(np.uint8), np.ones((2 * by_px + 1,) * 2, np.uint8)).astype(bool)
        for mask, by_px in ((objects, _MIXED_PX), (floor, 1))
    )
    shown = ~near_objects & ~near_floor & known & (depth_m > 0)
    height, width = depth_m.shape
    shrink = max(1.0, max(height, width) / _CELLS)
    size = (max(round(width / shrink), 1), max(round(height / shrink), 1))
    inverse = np.where(shown, 1 / np.where(shown, depth_m, 1.0), 0.0)
    share, total = (cv2.resize(f.astype(np.float32), size, interpolation=cv2.INTER_AREA) for f in (shown, inverse))
    told = share > 0.5
    if not told.any():
        return None
    filled = harmonic_fill(np.where(told, total / np.maximum(share, 1e-6), 0.0).astype(np.float64), told)
    return cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)


def foreground_mask(
    own: Bool[np.ndarray, "height width"],
    known: Bool[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    view: View,
    inverse_background_m: Float[np.ndarray, "height width"] | None,
) -> Bool[np.ndarray, "height width"]:
    """The pixels of `own` with depth that show the object; all of them where too few would be left.

    Left out are floor, pixels near the background (where the object stands free of it), and surfaces seen edge-on,
    which interpolate between two depths.
    """
    seen = own & known
    if seen.sum() < _MIN_PIXELS:
        return seen
    points_m = backproject(depth_m.astype(np.float64), view.intrinsics).reshape(-1, 3)
    world_m = transform_points(view.T_world_camera, points_m)
    world_m = world_m.reshape(*own.shape, 3)
    sight_m = world_m - view.T_world_camera[:3, 3]
    distance_m = np.linalg.norm(sight_m, axis=-1)
    top_m = max(float(np.percentile(world_m[seen][:, 1], 95)), 0.05)
    kept = seen & (world_m[..., 1] >= np.minimum(floor_band_m(distance_m), _LOWEST_SHARE * top_m))
    if inverse_background_m is not None and kept.sum() >= _MIN_PIXELS:
        share = depth_m * inverse_background_m
        front = float(np.percentile(share[kept], 25))
        if front < NEARER_RATIO:
            kept &= share < front + _BACKGROUND * (1 - front)
    facing = np.abs((_gentler_normals(world_m) * sight_m).sum(-1))
    kept &= facing > _GRAZING * distance_m
    return kept if kept.sum() >= max(_MIN_PIXELS, _MIN_SHARE * seen.sum()) else seen


def floor_band_m(distance_m: _Meters) -> _Meters:
    """Height below which depth cannot distinguish an object from the floor."""
    return _FLOOR_M + _FLOOR_SHARE * distance_m


def _gentler_normals(world_m: np.ndarray) -> Float[np.ndarray, "height width 3"]:
    """Normals by the shorter of both one-sided differences, which a depth step beside a surface does not tilt."""
    along = []
    for axis in (0, 1):
        step = np.diff(world_m, axis=axis)
        first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
        before, after = np.concatenate([first, step], axis), np.concatenate([step, last], axis)
        shorter = np.linalg.norm(before, axis=-1) < np.linalg.norm(after, axis=-1)
        along.append(np.where(shorter[..., None], before, after))
    normal = np.cross(*along)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
