"""Occlusion order of a person and objects: what the person is seen in front of is farther away than the person.

The depth of an object comes from a network, that of a person from body size and feet; where they contradict the
occlusion, the image decides. The opposite evidence (an object that occludes a person is nearer) is not used, because
person masks often lack limbs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

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


@dataclass(frozen=True, slots=True, eq=False)
class PersonCoverage:
    """Pixels that a person covered during the clip."""

    depth_m: Float[np.ndarray, "height width"]
    """Largest depth of the person where they were seen; 0 elsewhere."""
    seen: Int[np.ndarray, "height width"]
    """Frames in which the body covers the pixel and the mask has it."""
    hidden: Int[np.ndarray, "height width"]
    """Frames in which the body covers the pixel and the mask does not have it."""


def person_coverage(
    body: BodyMotion,
    frames: np.ndarray,
    masks: Bool[np.ndarray, "frames height width"],
    intrinsics: Intrinsics,
) -> PersonCoverage:
    """Pixels that a person covered; none if the camera moves.

    The depth of a pixel is the largest one that `_VOTES` frames reach.

    Args:
        body: The person.
        frames: Frame numbers of the masks.
        masks: Pixels that show the person.
        intrinsics: At the size of the masks.
    """
    farthest_m = np.zeros((_VOTES, *masks.shape[1:]), np.float32)
    seen, hidden = np.zeros(masks.shape[1:], np.int32), np.zeros(masks.shape[1:], np.int32)
    first = body.view().T_world_camera
    still = np.allclose(body.T_world_camera[frames], first)
    chosen = np.flatnonzero(body.valid[frames]) if still else np.zeros(0, np.int64)
    if len(chosen) < _VOTES:
        return PersonCoverage(farthest_m[0], seen, hidden)
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _MAX_FRAMES).round().astype(int))]
    at = frames[chosen]
    shaped = shaped_body(body.shape)
    skins_m = posed_vertices(body, shaped, None, at)
    T_camera_world = invert_rigid(first)
    for skin_m, mask in zip(skins_m, masks[chosen], strict=True):
        camera_m = transform_points(T_camera_world, skin_m)
        there_m = _depth_of(camera_m, shaped.faces, intrinsics)
        own_m = np.where(mask, there_m, 0.0)
        inner = cv2.erode((there_m > 0).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
        seen += inner & mask
        hidden += inner & ~cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        # The largest depths in ascending order; the smallest of them is replaced.
        farthest_m[0] = np.maximum(farthest_m[0], own_m)
        farthest_m.sort(axis=0)
    return PersonCoverage(farthest_m[0], seen, hidden)


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
