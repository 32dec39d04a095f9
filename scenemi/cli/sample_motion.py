"""From keyframes and a scene to a whole motion: what `scenemi sample` does between reading and writing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from scenemi.animation.partial_motion import meet, missed
from scenemi.data.keyframes import FPS, Keyframes
from scenemi.longmotion import LongMotion, inbetween
from scenemi.metrics import standing_feet
from scenemi.postprocess.in_scene import put_in_scene
from scenemi.postprocess.partial import PartialKeyframes
from scenemi.prior import InbetweeningPrior, KeyframeWindow, WindowMotion
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.grid import AROUND_M, distance_grid
from scenemi.windows import WINDOW_FRAMES
from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import UsageError
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.skeleton import forward_kinematics

_BODY_TOLERANCE_M = 1e-3
"""Joints as near as this to those of a shape are its own: files hold them in single precision (not measured)."""


@dataclass(frozen=True, slots=True, eq=False)
class SampledMotion:
    """A motion of `Keyframes.to_motion` length."""

    motion: LongMotion
    is_keyframe: Bool[np.ndarray, "frames"]
    contact: Float[np.ndarray, "frames 22"]
    """1 where an ankle or a toe is low and slow, else 0."""
    notes: tuple[str, ...]


def sample_motion(
    keyframes: Keyframes,
    prior: InbetweeningPrior,
    *,
    scene: SceneGeometry | None = None,
    length: int | None = None,
    noise: float = 0.0,
    partial: PartialKeyframes | None = None,
) -> SampledMotion:
    """Fill keyframes to a motion.

    Args:
        keyframes: checked poses.
        prior: fills windows.
        scene: in the world frame, floor included.
        length: frames of the result; after the last keyframe its pose is held.
        noise: paper's l, how inexact the keyframes are; 0 = they are met.
        partial: what else is asked of the motion, over `keyframes.frame_count` frames or more.

    Raises:
        InputError: a length that leaves keyframes out.
        UsageError: impossible noise.
    """
    given = replace(keyframes.to_motion(length), body=body_of(keyframes), noise_level=expect_noise(noise))
    several = partial is None and prior.name == "scenemi" and keyframes.frame_count > WINDOW_FRAMES
    solid = _around(keyframes, scene) if scene is not None and several else scene
    filled = inbetween(given, prior, scene=solid)
    notes = []
    if len(filled.interpolated_index):
        frames = ", ".join(str(frame) for frame in filled.interpolated_index)
        notes.append(f"gaps longer than a window were bridged by interpolation at frames {frames}")
    first, last = int(keyframes.frame_index[0]), int(keyframes.frame_index[-1])
    if first > 0:
        notes.append(f"frames 0 to {first - 1} hold the first keyframe's pose")
    if last + 1 < len(given.is_keyframe):
        notes.append(f"frames {last + 1} to {len(given.is_keyframe) - 1} hold the last keyframe's pose")
    if prior.name == "scenemi" or partial is not None:
        made = WindowMotion(filled.R_parent_joint, filled.translation_world_m)
        held = np.arange(len(given.is_keyframe))
        whole = KeyframeWindow(
            made.R_parent_joint, made.translation_world_m, given.is_keyframe | (held <= first) | (held >= last),
            given.rest_joints_m, given.fps, solid, body=given.body, noise_level=given.noise_level,
        )  # fmt: skip
        if partial is None:
            made = put_in_scene(made, whole)
        else:
            made = meet(made, given, whole, prior, partial.over(len(held)))
            notes += missed(made, given, partial)
        filled = replace(filled, R_parent_joint=made.R_parent_joint, translation_world_m=made.translation_world_m)
    joints_m, _ = forward_kinematics(filled.R_parent_joint, filled.translation_world_m, keyframes.rest_joints_m)
    return SampledMotion(filled, given.is_keyframe, standing_feet(joints_m, FPS), tuple(notes))


def _around(keyframes: Keyframes, scene: SceneGeometry) -> SdfGrid:
    """The scene around the keyframes, asked once for all windows and the solve."""
    joints_m, _ = forward_kinematics(keyframes.R_parent_joint, keyframes.translation_m, keyframes.rest_joints_m)
    points_m = joints_m.reshape(-1, 3)
    return distance_grid(scene, points_m.min(0) - 2 * AROUND_M, points_m.max(0) + 2 * AROUND_M)


def expect_noise(level: float) -> float:
    """The paper's l as it is.

    Raises:
        UsageError: impossible noise.
    """
    if not 0 <= level <= 100:
        raise UsageError(f"noise: want degrees and centimeters from 0 to 100, got {level}")
    return level


def body_of(keyframes: Keyframes) -> ShapedBody | None:
    """The body whose skeleton the keyframes have; None where theirs is another, and the prior finds one like it."""
    if keyframes.shape.model != "anny":
        return None
    body = shaped_body(keyframes.shape)
    alike = np.abs(body.rest_joints_m - keyframes.rest_joints_m).max() <= _BODY_TOLERANCE_M
    return body if alike else None
