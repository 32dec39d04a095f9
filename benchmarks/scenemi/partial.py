"""Errors of motions from partial keyframes, and the choice of the settings of their solve.

    python benchmarks/scenemi/partial.py --motion cmu.npz --split split.json [--part val] [--every 8]

Windows of captured motion with whole poses at frames 0, 60 and 120. Hands, the path or standing feet are also given,
from the truth, so that the error over all joints shows whether they help. Columns: error (cm), jerk (m/s^3), skating,
and the largest residual of the partial keyframes (cm; mean and maximum over windows). Rows: no partial keyframes, the
solve alone, and the two rounds of `scenemi.animation.partial_motion` with several noise levels of the solved poses.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from scenemi import metrics
from scenemi.animation import partial_motion
from scenemi.data.container import MotionArchive, read_split
from scenemi.evaluation.windows import EvaluationWindow, cut_windows
from scenemi.longmotion import KeyframeMotion
from scenemi.model.choice import load_prior_by_name
from scenemi.postprocess.in_scene import OBSERVED, put_in_scene
from scenemi.postprocess.partial import LEVEL, ROOT, PartialKeyframes, PinnedFoot
from scenemi.prior import InbetweeningPrior, KeyframeWindow, WindowMotion
from scenemi.scene.geometry import SceneGeometry
from video2anim.body.legs import LEGS
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

POSES, HANDS, PATH_EVERY, STANDS = (0, 60, 120), (30, 90), 15, 10
"""Frames of whole poses and of both hands; frames between path points; minimum frames of a pinned stance."""
NOISES = ((20.0, 5.0), (10.0, 5.0), (5.0, 2.0), (2.0, 1.0))
WRISTS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]


def main() -> None:
    """Measure all rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="+", required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--part", default="val")
    parser.add_argument("--every", type=int, default=8)
    given = parser.parse_args()
    archives = [MotionArchive.read(path) for path in given.motion]
    windows = cut_windows(archives, read_split(given.split)[given.part])[:: given.every]
    prior = load_prior_by_name("small")
    ways = {"nothing": None, "solve": None} | {f"two rounds, {a:g} deg {b:g} cm": (a, b) for a, b in NOISES}
    for asked in ("hands", "path", "feet"):
        for way, noise in ways.items():
            partial_motion.SOLVED_NOISE = noise or partial_motion.SOLVED_NOISE
            found = np.array([row(one, asked, way, prior) for one in windows])
            mean, largest = np.nanmean(found, 0), np.nanmax(found[:, 3])
            sys.stdout.write(
                f"{asked:6} {way:26} {mean[0]:6.2f} {mean[1]:7.1f} {mean[2]:6.3f} {mean[3]:7.2f} {largest:7.2f}\n"
            )
            sys.stdout.flush()


def row(window: EvaluationWindow, asked: str, way: str, prior: InbetweeningPrior) -> tuple[float, ...]:
    """Error, jerk, skating and largest residual of one window."""
    whole_poses = np.isin(np.arange(len(window.translation_m)), POSES)
    rest_m = window.body.rest_joints_m
    motion = window.R_parent_joint, window.translation_m, whole_poses, rest_m
    given = KeyframeMotion(*motion, FPS, body=window.body)
    whole = KeyframeWindow(*motion, FPS, SceneGeometry.floor(), body=window.body)
    partial = partial_of(window, asked)
    made: WindowMotion = prior.fill(whole)
    if way == "nothing":
        made = put_in_scene(made, whole)
    elif way == "solve":
        made = put_in_scene(made, whole, OBSERVED, partial)
    else:
        made = partial_motion.meet(made, given, whole, prior, partial)
    joints_m, _ = forward_kinematics(made.R_parent_joint, made.translation_world_m, rest_m)
    error_cm = 100 * float(np.linalg.norm(joints_m - window.joints_m, axis=-1).mean())
    miss_cm = 100 * max(misses_m(joints_m, partial), default=np.nan)
    return error_cm, metrics.jerk_m_s3(joints_m, FPS), metrics.foot_skating_gmd(joints_m, FPS), miss_cm


def partial_of(window: EvaluationWindow, asked: str) -> PartialKeyframes:
    """Partial keyframes taken from the true motion."""
    frames = len(window.translation_m)
    position_m, path_m, pins = np.full((frames, 22, 3), np.nan), np.full((frames, 2), np.nan), []
    if asked == "hands":
        position_m[np.ix_(HANDS, WRISTS)] = window.joints_m[np.ix_(HANDS, WRISTS)]
    elif asked == "path":
        points = np.arange(0, frames, PATH_EVERY)
        curve = Akima1DInterpolator(points, window.translation_m[points][:, LEVEL], method="makima")
        path_m = curve(np.arange(frames))
    else:
        for side, leg in enumerate(LEGS):
            stands = np.concatenate([[False], window.contact[:, [leg.ankle, leg.toe]].all(1), [False]])
            edges = np.flatnonzero(np.diff(stands))
            pins += [
                PinnedFoot(side, int(first), int(stop) - 1)
                for first, stop in zip(edges[::2], edges[1::2], strict=True)
                if stop - first > STANDS
            ]
    return PartialKeyframes(position_m, path_m, tuple(pins))


def misses_m(joints_m: np.ndarray, partial: PartialKeyframes) -> Iterator[float]:
    """Residuals of the partial keyframes in meters."""
    placed = np.isfinite(partial.position_m).all(2)
    yield from np.linalg.norm(joints_m[placed] - partial.position_m[placed], axis=-1)
    off_m = np.linalg.norm(joints_m[:, ROOT][:, LEVEL] - partial.path_m, axis=1)
    yield from off_m[np.isfinite(off_m)]
    for pin in partial.pinned:
        for joint in (LEGS[pin.side].ankle, LEGS[pin.side].toe):
            foot_m = joints_m[pin.first_frame : pin.last_frame + 1, joint][:, LEVEL]
            yield float(np.linalg.norm(np.ptp(foot_m, axis=0)))


if __name__ == "__main__":
    main()
