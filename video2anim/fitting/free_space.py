"""What the body's path says about the scene: where it goes is free, where it rests is solid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.body.anny_body import ShapedBody
from video2anim.body.skeleton import JOINT_INDEX, forward_kinematics
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.motion import BodyMotion

_MAY_BE_INSIDE = ("left_ankle", "right_ankle", "left_foot", "right_foot", "left_wrist", "right_wrist")
"""Parts that touch things and whose place is least certain."""
_SOLE_M = 0.03
"""Skin of a foot no higher than this above its lowest is its sole."""


def posed_vertices(
    motion: BodyMotion, body: ShapedBody, index: Int[np.ndarray, "chosen"], frames: Int[np.ndarray, "some"]
) -> Float[np.ndarray, "some chosen 3"]:
    """World positions of chosen vertices at chosen frames."""
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint[frames], motion.T_world_root[frames, :3, 3], motion.rest_joints_m
    )
    return body.vertices(R_world_joint, joints_m, index).astype(np.float64)


def passed_through(
    solid: SdfGrid, motion: BodyMotion, body: ShapedBody, *, deep_m: float, share: float
) -> Bool[np.ndarray, "frames"]:
    """Frames in which a fair share of the body is deep inside a solid; hands and feet are not asked.

    Every second valid frame is looked at.
    """
    asked = [JOINT_INDEX[name] for name in _MAY_BE_INSIDE]
    index = np.flatnonzero(~np.isin(body.vertex_part, asked))[::12]
    inside = np.zeros(motion.frame_count, dtype=bool)
    frames = np.flatnonzero(motion.valid)[::2]
    if len(frames) == 0:
        return inside
    depth_m = -solid.sample(posed_vertices(motion, body, index, frames))
    inside[frames] = (depth_m > deep_m).mean(1) > share
    return inside


def _standing_feet(
    motion: BodyMotion, body: ShapedBody
) -> Iterator[tuple[Int[np.ndarray, "some"], Float[np.ndarray, "some chosen 3"]]]:
    """Frames in which a foot is in contact, and its skin there, in the world; for each side that ever is."""
    for side in ("left", "right"):
        parts = [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]
        frames = np.flatnonzero(motion.valid & (motion.contact[:, parts].max(1) > 0.5))
        if len(frames):
            index = np.flatnonzero(np.isin(body.vertex_part, parts))[::4]
            yield frames, posed_vertices(motion, body, index, frames)


def stood_inside(solid: SdfGrid, motion: BodyMotion, body: ShapedBody, *, deep_m: float) -> Bool[np.ndarray, "frames"]:
    """Frames in which a foot in contact has most of its lower skin deeper in a solid than `deep_m`."""
    inside = np.zeros(motion.frame_count, dtype=bool)
    for frames, foot_m in _standing_feet(motion, body):
        sole = foot_m[..., 1] < foot_m[..., 1].min(1, keepdims=True) + _SOLE_M
        deep = (-solid.sample(foot_m) > deep_m) & sole
        inside[frames] |= deep.sum(1) > 0.5 * sole.sum(1)
    return inside


def walked_inside_m(solid: SdfGrid, motion: BodyMotion) -> float:
    """Horizontal way that the pelvis makes inside a solid: nobody walks in furniture."""
    pelvis_m = motion.joints_world_m[:, JOINT_INDEX["pelvis"]].astype(np.float64)
    inside = motion.valid & (solid.sample(pelvis_m) < 0)
    step_m = np.linalg.norm(np.diff(pelvis_m[:, [0, 2]], axis=0), axis=-1)
    return float(step_m[inside[1:] & inside[:-1]].sum())


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """A raised surface on which feet rested."""

    low_m: Float[np.ndarray, "2"]
    high_m: Float[np.ndarray, "2"]
    """Corners of the footprint in world x and z."""
    top_m: float
    frames: int
    """Foot-frames of contact that speak for it."""


def supports_from_feet(
    motion: BodyMotion,
    body: ShapedBody,
    *,
    least_height_m: float = 0.3,
    level_gap_m: float = 0.2,
    least_frames: int = 8,
    margin_m: float = 0.2,
) -> list[Support]:
    """Surfaces above the floor that must be there because feet rested on them, lowest first.

    Heights of single contacts are uncertain by several centimetres, so low steps are not claimed.
    """
    places = [
        np.concatenate([foot_m.mean(1)[:, [0, 2]], foot_m[..., 1].min(1, keepdims=True)], 1)
        for _, foot_m in _standing_feet(motion, body)
    ]
    if not places:
        return []
    touched = np.concatenate(places)
    touched = touched[touched[:, 2] > least_height_m]
    touched = touched[np.argsort(touched[:, 2])]
    levels = np.split(touched, np.flatnonzero(np.diff(touched[:, 2]) > level_gap_m) + 1)
    return [
        Support(
            level[:, :2].min(0) - margin_m, level[:, :2].max(0) + margin_m, float(np.median(level[:, 2])), len(level)
        )
        for level in levels
        if len(level) >= least_frames
    ]
