"""The local view of a scene: offsets from points of the skin to the nearest solid (Basis Point Sets, paper 3.1)."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float, Int

from scenemi.scene.geometry import SceneGeometry
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.motion import BodyShape

BPS_ANCHORS = 64
"""Of the paper (3.1)."""
BPS_REACH_M = 1.0
"""Longer offsets are shortened to this."""


def anchor_vertices(body: ShapedBody, count: int = BPS_ANCHORS) -> Int[np.ndarray, "anchors"]:
    """Vertices spread over the T-posed skin by farthest-point sampling, the same for every shape of a body model.

    Anny's are chosen on its middle adult; another model's on the body given. The first is the vertex farthest from
    the pelvis, so the first n of a larger count are the n anchors.

    Raises:
        ValueError: more anchors than vertices.
    """
    if body.shape.model == "anny":
        return _anny_anchors(count).copy()
    return _spread(_t_pose_m(body), count)


@functools.lru_cache(maxsize=4)
def _anny_anchors(count: int) -> Int[np.ndarray, "anchors"]:
    return _spread(_t_pose_m(shaped_body(BodyShape("anny", dict(ADULT)))), count)


def _t_pose_m(body: ShapedBody) -> Float[np.ndarray, "vertices 3"]:
    upright = np.broadcast_to(np.eye(3), (1, 22, 3, 3))
    return body.vertices(upright, body.rest_joints_m[None])[0].astype(np.float64)


def _spread(points_m: Float[np.ndarray, "points 3"], count: int) -> Int[np.ndarray, "chosen"]:
    """Farthest-point sampling from the point farthest from the origin; ties go to the lower index."""
    if not 0 < count <= len(points_m):
        raise ValueError(f"anchor_vertices: want between 1 and {len(points_m)} anchors, got {count}")
    # Equal distances of the mirrored half must not be told apart by the last bits.
    points_m = np.round(points_m, 6)
    chosen = [int(np.round((points_m**2).sum(1), 9).argmax())]
    gap2 = np.full(len(points_m), np.inf)
    while len(chosen) < count:
        gap2 = np.minimum(gap2, np.round(((points_m - points_m[chosen[-1]]) ** 2).sum(1), 9))
        chosen.append(int(gap2.argmax()))
    return np.array(chosen)


def bps(
    scene: SceneGeometry, anchors_m: Float[np.ndarray, "frames anchors 3"], R_world_canonical: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "frames anchors 3"]:
    """Offsets from anchors (world) to the nearest solid point, in canonical axes, meters, at most 1 m long."""
    return shortened((scene.nearest(anchors_m) - anchors_m) @ R_world_canonical)


def shortened(offsets_m: Float[np.ndarray, "... 3"], reach_m: float = BPS_REACH_M) -> Float[np.ndarray, "... 3"]:
    """Vectors of at most that length, directions kept."""
    length_m = np.linalg.norm(offsets_m, axis=-1, keepdims=True)
    return offsets_m * np.minimum(1.0, reach_m / np.maximum(length_m, 1e-12))
