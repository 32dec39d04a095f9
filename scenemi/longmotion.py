"""In-betweening of motions of any length: windows, seeded by each other, joined without a seam (paper 8.2).

A seam cannot pop: frames shared by two windows are cross-faded, so the first shared frame is the old window's, the
last one the new window's, and a prior that keeps its seed exactly leaves them unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi.prior import InbetweeningPrior, InterpolationPrior, KeyframeWindow, WindowMotion
from scenemi.windows import OVERLAP_FRAMES, WINDOW_FRAMES, WindowSpan, plan_windows, split_long_gaps
from video2anim.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.clip import FPS

if TYPE_CHECKING:
    from scenemi.scene.geometry import SceneGeometry
    from video2anim.body.shaped_body import ShapedBody

    Scene = SdfGrid | SceneGeometry


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeMotion:
    """A motion of which some frames are given, in the world frame (meters)."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    translation_world_m: Float[np.ndarray, "frames 3"]
    is_keyframe: Bool[np.ndarray, "frames"]
    rest_joints_m: Float[np.ndarray, "22 3"]
    fps: float = FPS
    body: ShapedBody | None = None
    """Whose skin meets the scene, for priors that look at it."""
    noise_level: float = 0.0
    """Paper's l of the keyframes (`KeyframeWindow.noise_level`)."""
    noise: tuple[float, float] | Float[np.ndarray, "frames 2"] | None = None
    """How far keyframes are off, degrees and centimeters, where that is not one l for both; of each, or of all."""

    @property
    def frame_count(self) -> int:
        return len(self.is_keyframe)


@dataclass(frozen=True, slots=True, eq=False)
class LongMotion:
    """The filled motion. Frames before the first and after the last keyframe hold that keyframe's pose."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    translation_world_m: Float[np.ndarray, "frames 3"]
    spans: tuple[WindowSpan, ...]
    interpolated_index: Int[np.ndarray, "bridges"]
    """Frames made keyframes by interpolation, because no keyframe was given for a whole window."""


def inbetween(
    motion: KeyframeMotion,
    prior: InbetweeningPrior,
    *,
    scene: Scene | None = None,
    window: int = WINDOW_FRAMES,
    overlap: int = OVERLAP_FRAMES,
) -> LongMotion:
    """Fill a motion between its keyframes.

    Args:
        motion: keyframes and their poses.
        prior: fills one window.
        scene: handed to the prior.
        window, overlap: paper's N and v.

    Raises:
        ValueError: no keyframe.
    """
    bridged, bridges = _bridged(motion, window)
    keyframes = np.flatnonzero(bridged.is_keyframe)
    if isinstance(prior, InterpolationPrior):
        # It needs no windows; a spline through the dense seed of each would swing out, and farther in each window.
        spans = (WindowSpan(int(keyframes[0]), int(keyframes[-1]) + 1, int(keyframes[0])),)
    else:
        spans = plan_windows(keyframes, window, overlap)
    R_parent_joint = bridged.R_parent_joint.copy()
    translation_m = bridged.translation_world_m.copy()
    for span in spans:
        done = WindowMotion(R_parent_joint, translation_m)
        filled = _filled(span, bridged, done, prior, scene)
        R_parent_joint[span.start : span.stop] = filled.R_parent_joint
        translation_m[span.start : span.stop] = filled.translation_world_m
    first, last = keyframes[0], keyframes[-1]
    for array in (R_parent_joint, translation_m):
        array[:first] = array[first]
        array[last + 1 :] = array[last]
    return LongMotion(R_parent_joint, translation_m, spans, bridges)


def _bridged(motion: KeyframeMotion, window: int) -> tuple[KeyframeMotion, Int[np.ndarray, "bridges"]]:
    """The motion with keyframes added by interpolation in gaps longer than a window, and which those are."""
    keyframes = np.flatnonzero(motion.is_keyframe)
    if len(keyframes) == 0:
        raise ValueError("inbetween: the motion has no keyframe")
    bridges = split_long_gaps(keyframes, window - 1)
    if len(bridges) == 0:
        return motion, bridges
    inner = slice(keyframes[0], keyframes[-1] + 1)
    plain = InterpolationPrior().fill(
        KeyframeWindow(
            motion.R_parent_joint[inner], motion.translation_world_m[inner], motion.is_keyframe[inner],
            motion.rest_joints_m, motion.fps,
        )
    )  # fmt: skip
    R_parent_joint, translation_m = motion.R_parent_joint.copy(), motion.translation_world_m.copy()
    R_parent_joint[bridges] = plain.R_parent_joint[bridges - keyframes[0]]
    translation_m[bridges] = plain.translation_world_m[bridges - keyframes[0]]
    is_keyframe = motion.is_keyframe.copy()
    is_keyframe[bridges] = True
    bridged = replace(motion, R_parent_joint=R_parent_joint, translation_world_m=translation_m, is_keyframe=is_keyframe)
    return bridged, bridges


def _filled(
    span: WindowSpan, motion: KeyframeMotion, done: WindowMotion, prior: InbetweeningPrior, scene: Scene | None
) -> WindowMotion:
    given = _window(span, motion, done, scene)
    return _join(given, prior.fill(given))


def _window(span: WindowSpan, motion: KeyframeMotion, done: WindowMotion, scene: Scene | None) -> KeyframeWindow:
    """Keyframes of one span: frames done so far as they were synthesized, the rest as given."""
    frames, seed = slice(span.start, span.stop), span.seed_stop - span.start
    R_parent_joint, translation_m = motion.R_parent_joint[frames].copy(), motion.translation_world_m[frames].copy()
    R_parent_joint[:seed] = done.R_parent_joint[span.start : span.seed_stop]
    translation_m[:seed] = done.translation_world_m[span.start : span.seed_stop]
    is_keyframe = motion.is_keyframe[frames].copy()
    is_keyframe[:seed] = True
    return KeyframeWindow(
        R_parent_joint, translation_m, is_keyframe, motion.rest_joints_m, motion.fps, scene,
        seed_frames=seed, body=motion.body, noise_level=motion.noise_level,
        noise=None if motion.noise is None else np.broadcast_to(motion.noise, (motion.frame_count, 2))[frames].copy(),
    )  # fmt: skip


def _join(given: KeyframeWindow, filled: WindowMotion) -> WindowMotion:
    """Cross-fade the seed frames from the old window to the new one."""
    seed = given.seed_frames
    if seed == 0:
        return filled
    ramp = np.linspace(0.0, 1.0, seed + 1)[1:]
    weight = ramp * ramp * (3 - 2 * ramp)
    R_parent_joint, translation_m = filled.R_parent_joint.copy(), filled.translation_world_m.copy()
    old_q = quaternion_from_matrix(given.R_parent_joint[:seed])
    new_q = quaternion_from_matrix(filled.R_parent_joint[:seed])
    R_parent_joint[:seed] = matrix_from_quaternion(slerp(old_q, new_q, weight[:, None, None]))
    old_m, new_m = given.translation_world_m[:seed], filled.translation_world_m[:seed]
    translation_m[:seed] = old_m + weight[:, None] * (new_m - old_m)
    return WindowMotion(R_parent_joint, translation_m)
