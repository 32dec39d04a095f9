"""From keyframes and a scene to a whole motion: what `scenemi sample` does between reading and writing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from scenemi.keyframes import FPS, Keyframes
from scenemi.longmotion import KeyframeMotion, LongMotion, inbetween
from scenemi.metrics import standing_feet
from scenemi.model.scene_input import adult_like
from scenemi.postprocess.motion_solve import SceneMotion, solve_motions
from scenemi.postprocess.solids import Solids
from scenemi.prior import InbetweeningPrior
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.grid import distance_grid
from video2anim.body.anny_body import ShapedBody, shaped_body
from video2anim.body.skeleton import forward_kinematics
from video2anim.errors import UsageError

_BODY_TOLERANCE_M = 1e-3
_AROUND_M = 0.5
"""How far from the joints' box solids are looked for."""


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
) -> SampledMotion:
    """Fill keyframes to a motion.

    Args:
        keyframes: checked poses.
        prior: fills windows.
        scene: in the world frame, floor included.
        length: frames of the result; after the last keyframe its pose is held.
        noise: paper's l, how inexact the keyframes are; 0 = they are met.

    Raises:
        InputError: a length that leaves keyframes out.
        UsageError: impossible noise.
    """
    given = replace(keyframes.to_motion(length), body=body_of(keyframes), noise_level=expect_noise(noise))
    filled = inbetween(given, prior, scene=scene)
    notes = []
    if len(filled.bridged_index):
        frames = ", ".join(str(frame) for frame in filled.bridged_index)
        notes.append(f"gaps longer than a window were bridged by interpolation at frames {frames}")
    first, last = int(keyframes.frame_index[0]), int(keyframes.frame_index[-1])
    if first > 0:
        notes.append(f"frames 0 to {first - 1} hold the first keyframe's pose")
    if last + 1 < len(given.is_keyframe):
        notes.append(f"frames {last + 1} to {len(given.is_keyframe) - 1} hold the last keyframe's pose")
    if prior.name == "scenemi":
        filled = _in_scene(filled, given, scene)
    joints_m, _ = forward_kinematics(filled.R_parent_joint, filled.translation_world_m, keyframes.rest_joints_m)
    return SampledMotion(filled, given.is_keyframe, standing_feet(joints_m, FPS), tuple(notes))


def _in_scene(filled: LongMotion, given: KeyframeMotion, scene: SceneGeometry | None) -> LongMotion:
    """The motion with standing feet at rest and its skin out of solids; exact keyframes stay."""
    joints_m, _ = forward_kinematics(filled.R_parent_joint, filled.translation_world_m, given.rest_joints_m)
    solids = Solids(floor=False)
    if scene is not None:
        around_m = joints_m.reshape(-1, 3)
        solids = Solids(distance_grid(scene, around_m.min(0) - _AROUND_M, around_m.max(0) + _AROUND_M), floor=False)
    fixed = given.is_keyframe if given.noise_level == 0 else np.zeros(len(joints_m), bool)
    solved = solve_motions(
        [
            SceneMotion(
                filled.R_parent_joint, filled.translation_world_m, standing_feet(joints_m, FPS), given.rest_joints_m,
                given.body or adult_like(given.rest_joints_m), FPS, fixed,
            )
        ],
        solids,
    )  # fmt: skip
    return replace(filled, R_parent_joint=solved.R_parent_joint[0], translation_world_m=solved.translation_world_m[0])


def expect_noise(level: float) -> float:
    """The paper's l as it is.

    Raises:
        UsageError: impossible noise.
    """
    if not 0 <= level <= 100:
        raise UsageError(f"noise: want degrees and centimetres from 0 to 100, got {level}")
    return level


def body_of(keyframes: Keyframes) -> ShapedBody | None:
    """The body whose skeleton the keyframes have; None where theirs is another, and the prior finds one like it."""
    if keyframes.shape.model != "anny":
        return None
    body = shaped_body(keyframes.shape)
    alike = np.abs(body.rest_joints_m - keyframes.rest_joints_m).max() <= _BODY_TOLERANCE_M
    return body if alike else None
