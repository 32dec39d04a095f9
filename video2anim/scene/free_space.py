"""Free space by the body: solids that it passes through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from video2anim.body.contact import posed_vertices
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.motion import BodyMotion
from video2anim.types.skeleton import JOINT_INDEX

_MAY_BE_INSIDE = ("left_ankle", "right_ankle", "left_foot", "right_foot", "left_wrist", "right_wrist")
"""Parts that touch objects and whose positions are least certain."""


def passed_through(
    solid: SdfGrid, motion: BodyMotion, body: ShapedBody, *, deep_m: float, share: float, resting: Sequence[int] = ()
) -> Bool[np.ndarray, "frames"]:
    """Frames in which more than a share of the body is deep inside a solid, without hands, feet and `resting` joints.

    Every second valid frame is tested.
    """
    left_out = [*(JOINT_INDEX[name] for name in _MAY_BE_INSIDE), *resting]
    index = np.flatnonzero(~np.isin(body.vertex_part, left_out))[::12]
    inside = np.zeros(motion.frame_count, dtype=bool)
    frames = np.flatnonzero(motion.valid)[::2]
    if len(frames) == 0:
        return inside
    depth_m = -solid.sample(posed_vertices(motion, body, index, frames))
    inside[frames] = (depth_m > deep_m).mean(1) > share
    return inside


def path_length_inside_m(solid: SdfGrid, motion: BodyMotion) -> float:
    """Length of the pelvis' horizontal path inside a solid."""
    pelvis_m = motion.joints_world_m[:, JOINT_INDEX["pelvis"]].astype(np.float64)
    inside = motion.valid & (solid.sample(pelvis_m) < 0)
    step_m = np.linalg.norm(np.diff(pelvis_m[:, [0, 2]], axis=0), axis=-1)
    return float(step_m[inside[1:] & inside[:-1]].sum())
