"""Numbers of one window and of many: means, and intervals by the bootstrap over windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import butter, sosfiltfilt

from scenemi import metrics
from scenemi.evaluation.windows import FPS, EvaluationWindow
from scenemi.prior import WindowMotion
from video2anim.types.skeleton import forward_kinematics

SKIN_VERTICES = 1500
"""About how many vertices of the skin are tested against the scene (every k-th one)."""
BOOTSTRAP_DRAWS = 1000
"""As many as intervals want (Efron and Tibshirani 1993)."""
FEET = [*metrics.ANKLES, *metrics.TOES]
_CUTOFF_HZ = 8.0
"""Cutoffs for gait are 4 to 8 Hz (Winter 2009)."""


@dataclass(frozen=True, slots=True)
class WindowScores:
    """One motion of one window against the truth. NaN where a number has nothing to be measured on.

    Collisions are with the scene without its floor: the soles stand on the floor, so with it every frame would count.
    """

    mjpe_all_m: float
    mjpe_key_m: float
    jerk_m_s3: float
    jerk_8hz_m_s3: float
    """Of the same joints low-passed at 8 Hz: captured motion has marker noise above, which no model should learn."""
    skating_gmd: float
    contact_f1: float
    """Feet that stand (low and slow) in this motion against those of the true one."""
    floor_depth_m: float
    """Deepest skin vertex under y = 0."""
    collision_frame_ratio: float = float("nan")
    collision_frame_ratio_1cm: float = float("nan")
    collision_vertex_ratio: float = float("nan")
    penetration_max_m: float = float("nan")
    close_frames: int = 0
    """Frames in which the true body is within 8 cm of the scene; all that begins with `close_` is over them."""
    close_collision_frames: int = 0
    close_collision_frames_1cm: int = 0
    close_collision_vertex_ratio: float = float("nan")
    close_penetration_max_m: float = float("nan")


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean and the 95 % interval of it."""

    mean: float
    low: float
    high: float
    count: int


class WindowEvaluator:
    """Measures motions against one window; what belongs to the truth is computed once."""

    def __init__(self, window: EvaluationWindow) -> None:
        self.window = window
        self.skin_index = skin_sample(len(window.body.rest_vertices_m))
        self.standing: Bool[np.ndarray, "frames 4"] = metrics.standing_feet(window.joints_m, FPS)[:, FEET] > 0
        self.close: Bool[np.ndarray, "frames"] = np.zeros(len(window.translation_m), bool)
        if window.obstacles is not None:
            distance_m = window.obstacles.signed_distance(self.skin_m(window.R_parent_joint, window.translation_m))
            self.close = distance_m.min(axis=1) < metrics.CLOSE_PROXIMITY_M

    def scores(self, motion: WindowMotion, is_keyframe: Bool[np.ndarray, "frames"]) -> WindowScores:
        """Numbers of a motion of this window."""
        window = self.window
        joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_world_m, window.body.rest_joints_m)
        skin_m = self.skin_m(motion.R_parent_joint, motion.translation_world_m)
        distance_m = None if window.obstacles is None else window.obstacles.signed_distance(skin_m)
        scores = WindowScores(
            mjpe_all_m=metrics.mpjpe(joints_m, window.joints_m),
            mjpe_key_m=metrics.mpjpe(joints_m[is_keyframe], window.joints_m[is_keyframe]),
            jerk_m_s3=metrics.jerk_m_s3(joints_m, FPS),
            jerk_8hz_m_s3=metrics.jerk_m_s3(low_passed(joints_m), FPS),
            skating_gmd=metrics.foot_skating_gmd(joints_m, FPS),
            contact_f1=metrics.binary_scores(metrics.standing_feet(joints_m, FPS)[:, FEET] > 0, self.standing).f1,
            floor_depth_m=float(max(0.0, -skin_m[..., 1].min())),
        )
        return scores if distance_m is None else replace(scores, **self._collisions(distance_m))

    def truth(self) -> WindowScores:
        """Numbers of the true motion."""
        window = self.window
        every = np.ones(len(window.translation_m), bool)
        return self.scores(WindowMotion(window.R_parent_joint, window.translation_m), every)

    def _collisions(self, distance_m: Float[np.ndarray, "frames skin"]) -> dict[str, Any]:
        near_m = distance_m[self.close]
        depth_m, near_depth_m = distance_m.min(axis=1), near_m.min(axis=1, initial=np.inf)
        count = len(near_m)
        nan = float("nan")
        zero_m, centimetre_m = metrics.COLLISION_TAUS_M
        return {
            "collision_frame_ratio": float((depth_m < -zero_m).mean()),
            "collision_frame_ratio_1cm": float((depth_m < -centimetre_m).mean()),
            "collision_vertex_ratio": metrics.collision_vertex_ratio(distance_m),
            "penetration_max_m": metrics.penetration_max_m(distance_m),
            "close_frames": count,
            "close_collision_frames": int((near_depth_m < -zero_m).sum()),
            "close_collision_frames_1cm": int((near_depth_m < -centimetre_m).sum()),
            "close_collision_vertex_ratio": metrics.collision_vertex_ratio(near_m) if count else nan,
            "close_penetration_max_m": metrics.penetration_max_m(near_m) if count else nan,
        }

    def skin_m(
        self, R_parent_joint: Float[np.ndarray, "frames 22 3 3"], translation_m: Float[np.ndarray, "frames 3"]
    ) -> Float[np.ndarray, "frames skin 3"]:
        """The sampled skin of a motion of the window's body."""
        body = self.window.body
        joints_m, R_world_joint = forward_kinematics(R_parent_joint, translation_m, body.rest_joints_m)
        return body.vertices(R_world_joint, joints_m, self.skin_index).astype(np.float64)


def low_passed(joints_m: Float[np.ndarray, "frames 22 3"]) -> Float[np.ndarray, "frames 22 3"]:
    """Joints without what is faster than 8 Hz (Butterworth of order 4, forward and back)."""
    filter_sos = butter(4, _CUTOFF_HZ, fs=FPS, output="sos")
    return np.asarray(sosfiltfilt(filter_sos, joints_m, axis=0))


def skin_sample(vertices: int) -> Int[np.ndarray, "chosen"]:
    """Evenly chosen vertices of a skin."""
    return np.arange(0, vertices, max(1, vertices // SKIN_VERTICES))


def column(scores: Sequence[WindowScores], name: str) -> Float[np.ndarray, "windows"]:
    """One number of all windows."""
    return np.array([getattr(row, name) for row in scores], dtype=np.float64)


def mean_of(scores: Sequence[WindowScores], name: str) -> float:
    """Mean over the windows that have the number; NaN where none has.

    `close_collision_frame_ratio` and its `_1cm` are ratios of sums: the share of all close frames.
    """
    if name.startswith("close_collision_frame_ratio"):
        suffix = name.removeprefix("close_collision_frame_ratio")
        frames = column(scores, "close_frames").sum()
        return float(column(scores, f"close_collision_frames{suffix}").sum() / frames) if frames else float("nan")
    values = column(scores, name)
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else float("nan")


def bootstrap(
    scores: Sequence[WindowScores], name: str, clips: Sequence[str] | None = None, *, seed: int = 0
) -> Interval:
    """Mean over windows and its 95 % interval: clips (windows where none are named) are drawn again with replacement,
    since windows of one clip resemble each other."""
    groups = np.unique(np.arange(len(scores)) if clips is None else np.asarray(clips), return_inverse=True)[1]
    members = [np.flatnonzero(groups == group) for group in range(groups.max() + 1)]
    rng = np.random.default_rng(seed)
    draws = []
    for index in rng.integers(0, len(members), (BOOTSTRAP_DRAWS, len(members))):
        value = mean_of([scores[i] for group in index for i in members[group]], name)
        if not np.isnan(value):
            draws.append(value)
    low, high = np.percentile(draws, [2.5, 97.5]) if draws else (float("nan"),) * 2
    return Interval(mean_of(scores, name), float(low), float(high), len(scores))


def over_seeds(values: Sequence[float]) -> Interval:
    """Mean of repeated runs and the 95 % interval of that mean (normal approximation, as the paper's Table 9)."""
    array = np.asarray(values, dtype=np.float64)
    if len(array) == 0 or np.isnan(array).any():
        nan = float("nan")
        return Interval(nan, nan, nan, len(array))
    half = 1.96 * float(array.std(ddof=1)) / np.sqrt(len(array)) if len(array) > 1 else float("nan")
    return Interval(float(array.mean()), float(array.mean() - half), float(array.mean() + half), len(array))
