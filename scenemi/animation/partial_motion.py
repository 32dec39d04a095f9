"""Motion that meets partial keyframes: places of joints, a path of the root, pinned feet.

The prior takes whole poses only. So partial keyframes are met by the least-squares solve over root and joints that ends
every sampling, twice: the motion between the whole poses is solved, and its poses where something was asked for become
noisy keyframes of the prior, which makes the motion around them natural (a walk along the path instead of a body moved
along it). The solve then meets what was asked for. Chosen by `benchmarks/scenemi/partial.py`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from scenemi.longmotion import KeyframeMotion, inbetween
from scenemi.postprocess.in_scene import OBSERVED, put_in_scene
from scenemi.postprocess.partial import LEVEL, MISS_M, ROOT, PartialKeyframes
from scenemi.prior import InbetweeningPrior, KeyframeWindow, WindowMotion
from video2anim.body.legs import LEGS
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_NAMES, forward_kinematics

SOLVED_NOISE = (5.0, 2.0)
"""Degrees and centimeters that solved poses are said to be off, as keyframes of the prior. Less is no better; with 10
and 5 the jerk is a quarter larger (`benchmarks/scenemi/partial.py`)."""
PATH_FRAMES = round(FPS)
"""From keyframe to keyframe along a path, a second: denser ones would hold the gait of the first estimate."""


def meet(
    made: WindowMotion,
    given: KeyframeMotion,
    whole: KeyframeWindow,
    prior: InbetweeningPrior,
    partial: PartialKeyframes,
) -> WindowMotion:
    """A motion between whole poses, changed so that it meets partial keyframes too.

    Args:
        made: the motion, of any length.
        given: its whole poses.
        whole: the same as one window, with frames that are held; scene and body are taken from it.
        prior: made the motion, and makes it again.
        partial: what is asked of its frames.
    """
    solved = put_in_scene(made, whole, OBSERVED, partial)
    frames = _key_frames(partial) & ~whole.is_keyframe
    if not frames.any():
        return solved
    noise = np.where(frames[:, None], SOLVED_NOISE, given.noise_level)
    again = replace(
        given,
        R_parent_joint=np.where(frames[:, None, None, None], solved.R_parent_joint, given.R_parent_joint),
        translation_world_m=np.where(frames[:, None], solved.translation_world_m, given.translation_world_m),
        is_keyframe=given.is_keyframe | frames,
        noise=noise,
    )
    filled = inbetween(again, prior, scene=whole.scene)
    return put_in_scene(WindowMotion(filled.R_parent_joint, filled.translation_world_m), whole, OBSERVED, partial)


def missed(made: WindowMotion, given: KeyframeMotion, partial: PartialKeyframes) -> list[str]:
    """Sentences on what the motion does not meet: out of reach, in a solid, or against whole poses."""
    joints_m, _ = forward_kinematics(made.R_parent_joint, made.translation_world_m, given.rest_joints_m)
    joints_m = joints_m[: len(partial.path_m)]
    notes = []
    for frame, joint in np.argwhere(np.isfinite(partial.position_m).any(2)):
        off_m = float(np.sqrt(np.nansum((joints_m[frame, joint] - partial.position_m[frame, joint]) ** 2)))
        if off_m > MISS_M["joint"]:
            notes.append(f"{JOINT_NAMES[joint]} is {off_m:.2f} m from its place at frame {frame}")
    off_m = np.nan_to_num(np.linalg.norm(joints_m[:, ROOT][:, LEVEL] - partial.path_m, axis=1))
    if off_m.max() > MISS_M["path"]:
        notes.append(f"the pelvis is {off_m.max():.2f} m from its path at frame {off_m.argmax()}")
    for pin in partial.pinned:
        leg = LEGS[pin.side]
        foot_m = joints_m[pin.first_frame : pin.last_frame + 1][:, [leg.ankle, leg.toe]][..., LEVEL]
        slides_m = float(np.linalg.norm(np.ptp(foot_m, axis=0), axis=-1).max())
        if slides_m > MISS_M["foot"]:
            side = ("left", "right")[pin.side]
            notes.append(f"the {side} foot slides by {slides_m:.2f} m in frames {pin.first_frame} to {pin.last_frame}")
    return notes


def _key_frames(partial: PartialKeyframes) -> Bool[np.ndarray, "frames"]:
    """Frames whose solved poses the prior is given: those of places, and some of the path."""
    chosen = np.zeros(len(partial.path_m), bool)
    chosen[np.isfinite(partial.position_m).any((1, 2))] = True
    on_path = np.flatnonzero(np.isfinite(partial.path_m).all(1))
    chosen[on_path[PATH_FRAMES // 2 :: PATH_FRAMES]] = True
    chosen[on_path[-1:]] = True
    return chosen
