"""How far away a person was at each pixel where they were seen: objects there are farther away."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import posed_vertices
from video2anim.geometry.line_of_sight import surface_points
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.types.camera import Intrinsics
from video2anim.types.motion import BodyMotion

_MAX_FRAMES = 60
"""Frames that are used, spread over the clip; bounds the time."""
_VOTES = 3
"""Frames that must agree on the depth at a pixel: one or two may have a wrong mask or pose."""


def person_coverage(
    body: BodyMotion,
    frames: np.ndarray,
    masks: Bool[np.ndarray, "frames height width"],
    intrinsics: Intrinsics,
) -> Float[np.ndarray, "height width"]:
    """Largest depth of a person at each pixel (m), reached in at least `_VOTES` frames; 0 where they were not seen.

    A moving camera gives 0 everywhere.

    Args:
        body: The person.
        frames: Frame numbers of the masks.
        masks: Pixels that show the person.
        intrinsics: At the size of the masks.
    """
    farthest_m = np.zeros((_VOTES, *masks.shape[1:]), np.float32)
    first = body.view().T_world_camera
    still = np.allclose(body.T_world_camera[frames], first)
    chosen = np.flatnonzero(body.valid[frames]) if still else np.zeros(0, np.int64)
    if len(chosen) < _VOTES:
        return farthest_m[0]
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _MAX_FRAMES).round().astype(int))]
    at = frames[chosen]
    shaped = shaped_body(body.shape)
    skins_m = posed_vertices(body, shaped, None, at)
    T_camera_world = invert_rigid(first)
    for skin_m, mask in zip(skins_m, masks[chosen], strict=True):
        camera_m = transform_points(T_camera_world, skin_m)
        there_m = _depth_of(camera_m, shaped.faces, intrinsics)
        own_m = np.where(mask, there_m, 0.0)
        # The largest depths in ascending order; the smallest of them is replaced.
        farthest_m[0] = np.maximum(farthest_m[0], own_m)
        farthest_m.sort(axis=0)
    return farthest_m[0]


def _depth_of(camera_m: np.ndarray, faces: np.ndarray, intrinsics: Intrinsics) -> Float[np.ndarray, "height width"]:
    """Depth of the visible side of a body per pixel, 0 beside it."""
    height, width = intrinsics.height_px, intrinsics.width_px
    points_m = surface_points(camera_m, faces)
    column, row = np.floor(project(points_m, intrinsics) + 0.5).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    nearest_m = np.full((height, width), np.inf, np.float32)
    np.minimum.at(nearest_m, (row[inside], column[inside]), points_m[inside, 2])
    # Surface points of near people are sparse in pixels: each pixel takes the least depth of its neighbors.
    nearest_m = cv2.erode(np.where(np.isfinite(nearest_m), nearest_m, 1e6), np.ones((3, 3)))
    return np.where(nearest_m < 1e6, nearest_m, 0.0)
