"""Jerk where windows meet and at keyframes: does long motion pop there?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from scenemi.data.retarget import RetargetedMotion
from scenemi.evaluation.windows import FPS, adult_body
from scenemi.longmotion import KeyframeMotion, LongMotion
from scenemi.windows import select_keyframes
from video2anim.types.skeleton import forward_kinematics


@dataclass(frozen=True)
class SeamJerk:
    """Mean jerk of the joints over the motion's own median, in the third differences that reach over such a frame."""

    at_seams: Float[np.ndarray, "differences"]
    """Over the first and the last frame that two windows share."""
    at_keyframes: Float[np.ndarray, "differences"]
    """Over keyframes, less the first and the last."""


def keyframe_motion(clip: RetargetedMotion, interval: int, frames: int) -> KeyframeMotion:
    """The clip's first frames with a keyframe every ``interval`` frames, on the adult body."""
    body, is_keyframe = adult_body(), np.zeros(frames, bool)
    is_keyframe[select_keyframes(frames, interval)] = True
    return KeyframeMotion(
        clip.R_parent_joint[:frames], clip.translation_m[:frames], is_keyframe, body.rest_joints_m, FPS, body
    )


def seam_jerk(given: KeyframeMotion, filled: LongMotion) -> SeamJerk:
    """Jerk of a filled motion at its seams and keyframes."""
    joints_m, _ = forward_kinematics(filled.R_parent_joint, filled.translation_world_m, given.rest_joints_m)
    jerk_m_s3 = np.linalg.norm(np.diff(joints_m, n=3, axis=0), axis=-1).mean(1) * given.fps**3
    ratio = jerk_m_s3 / np.median(jerk_m_s3)
    seams = np.array([edge for span in filled.spans[1:] for edge in (span.start, span.seed_stop)], int)
    keyframes = np.flatnonzero(given.is_keyframe)[1:-1]
    return SeamJerk(ratio[_spanning(seams, len(ratio))], ratio[_spanning(keyframes, len(ratio))])


def _spanning(frames: Int[np.ndarray, "frames"], count: int) -> Int[np.ndarray, "differences"]:
    """Third differences that reach over one of the frames: entry i spans frames i to i + 3."""
    reached = np.unique(frames[:, None] - np.arange(4))
    return reached[(reached >= 0) & (reached < count)]
