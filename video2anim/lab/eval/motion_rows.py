"""Evaluation group `motion`: one person's motion after each motion stage."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from scenemi import metrics
from video2anim.geometry.projection import transform_points
from video2anim.lab.eval.alignment import FrameMatch
from video2anim.lab.eval.model import Curve, Group, make_group
from video2anim.types import BodyMotion
from video2anim.types.quality import Quality
from video2anim.types.skeleton import FEET

CONTACT_PROBABILITY = 0.5
_SHORT = "too few common frames"
MOTION = (
    Quality("covered", math.nan, "ratio", "higher"),
    Quality("mpjpe", math.nan, "m", "lower"),
    Quality("pa_mpjpe", math.nan, "m", "lower"),
    Quality("w_mpjpe", math.nan, "m", "lower"),
    Quality("wa_mpjpe", math.nan, "m", "lower"),
    Quality("rte", math.nan, "%", "lower"),
    Quality("root_error", math.nan, "m", "lower"),
    Quality("root_depth_bias", math.nan, "ratio", "near_1"),
    Quality("bridged_mpjpe", math.nan, "m", "lower"),
    Quality("acceleration_error", math.nan, "m/s^2", "lower"),
    Quality("jerk", math.nan, "m/s^3", "near_truth"),
    Quality("skating_gmd", math.nan, "ratio", "lower"),
    Quality("skating_kimodo", math.nan, "ratio", "lower"),
    Quality("skating_rohm", math.nan, "ratio", "lower"),
    Quality("contact_precision", math.nan, "ratio", "higher"),
    Quality("contact_recall", math.nan, "ratio", "higher"),
    Quality("contact_f1", math.nan, "ratio", "higher"),
    Quality("contact_f1_motion", math.nan, "ratio", "higher"),
    Quality("contact_ratio", math.nan, "ratio", "near_truth"),
)

_UNDEFINED = dict.fromkeys((measure.key for measure in MOTION), _SHORT) | {
    "rte": "the true root does not move",
    "bridged_mpjpe": "every frame of the span was measured",
    "skating_kimodo": "no toe is on the floor",
    "contact_precision": "no contact was predicted",
    "contact_recall": "the feet never touch",
    "contact_f1": "no contact in ground truth or estimate",
    "contact_f1_motion": "no foot stands in either",
}


@dataclass(frozen=True, slots=True, eq=False)
class CommonFrames:
    """Frames of one person in which all stages are compared, as rows of the estimate and of the truth."""

    measured: Int[np.ndarray, "measured"]
    """Rows with a measurement in the first stage and a true pose."""
    span: Int[np.ndarray, "span"]
    """All rows with a true frame from the first to the last measured one, for differences over time."""
    bridged: Bool[np.ndarray, "span"]
    """Rows of the span without a measurement, but with a true pose."""
    true_index: Int[np.ndarray, "frames"]
    true_frames: int
    """Number of frames in which the truth has a pose."""


def common_frames(first: BodyMotion, truth: BodyMotion, frames: FrameMatch) -> CommonFrames:
    """Frames in which a person is compared; `first` is the motion of its earliest stage."""
    true_pose = frames.known & truth.valid[frames.true_index]
    measured = np.flatnonzero(first.valid & true_pose)
    span = np.zeros(0, np.int64)
    if len(measured):
        span = np.arange(measured[0], measured[-1] + 1)
        span = span[frames.known[span]]
    bridged = ~first.valid[span] & true_pose[span]
    return CommonFrames(measured, span, bridged, frames.true_index, int(truth.valid.sum()))


def motion_group(
    stages: Mapping[str, BodyMotion | str],
    truth: BodyMotion,
    common: CommonFrames,
    T_true_estimate: Float[np.ndarray, "4 4"],
    fps: float,
    person_id: int,
) -> Group:
    """Accuracy, smoothness and contact of each stage; a text in place of a motion says why it is absent."""
    columns = {
        name: motion if isinstance(motion, str) else _numbers(motion, truth, common, T_true_estimate, fps)
        for name, motion in stages.items()
    }
    true = _true_numbers(truth, common, fps)
    return make_group("motion", "Motion", MOTION, columns, undefined=_UNDEFINED, truth=true, person_id=person_id)


def _numbers(
    motion: BodyMotion, truth: BodyMotion, common: CommonFrames, T_true_estimate: np.ndarray, fps: float
) -> dict[str, float | str]:
    true_rows = common.true_index[common.measured]
    estimate_m, true_m = motion.joints_world_m[common.measured], truth.joints_world_m[true_rows]
    if len(estimate_m) < 2:
        return {measure.key: _SHORT for measure in MOTION} | {"covered": len(estimate_m) / max(1, common.true_frames)}
    # By the shared camera, so an error of the estimated up direction does not rotate the pose.
    in_truth_m = transform_points(T_true_estimate, estimate_m)
    root = metrics.ROOT
    camera_z_m = motion.joints_camera_m[common.measured, root, 2]
    true_z_m = truth.joints_camera_m[true_rows, root, 2]
    span_m, true_span_m = motion.joints_world_m[common.span], truth.joints_world_m[common.true_index[common.span]]
    span_in_truth_m = transform_points(T_true_estimate, span_m)
    bridged = common.bridged
    contact = metrics.binary_scores(
        motion.contact[common.measured][:, FEET] > CONTACT_PROBABILITY, truth.contact[true_rows][:, FEET] > 0.5
    )
    standing = metrics.standing_feet(motion.joints_world_m[common.measured], fps)[:, FEET] > 0
    return {
        "covered": len(common.measured) / max(1, common.true_frames),
        "mpjpe": metrics.root_relative_mpjpe(in_truth_m, true_m),
        "pa_mpjpe": metrics.pa_mpjpe(estimate_m, true_m),
        "w_mpjpe": metrics.w_mpjpe(estimate_m, true_m),
        "wa_mpjpe": metrics.wa_mpjpe(estimate_m, true_m),
        "rte": 100 * metrics.rte(estimate_m[:, root], true_m[:, root]),
        "root_error": float(np.linalg.norm(in_truth_m[:, root] - true_m[:, root], axis=-1).mean()),
        "root_depth_bias": float(np.median(camera_z_m / true_z_m)),
        "bridged_mpjpe": (
            metrics.root_relative_mpjpe(span_in_truth_m[bridged], true_span_m[bridged]) if bridged.any() else np.nan
        ),
        "acceleration_error": metrics.acceleration_error_m_s2(span_in_truth_m, true_span_m, fps),
        **_own_numbers(span_m, fps),
        "contact_precision": contact.precision,
        "contact_recall": contact.recall,
        "contact_f1": contact.f1,
        # Labels are carried from stage to stage; whether the feet of this motion stand is another question.
        "contact_f1_motion": metrics.binary_scores(standing, truth.contact[true_rows][:, FEET] > 0.5).f1,
        "contact_ratio": float((motion.contact[common.measured][:, FEET] > CONTACT_PROBABILITY).mean()),
    }


def _own_numbers(joints_m: np.ndarray, fps: float) -> dict[str, float]:
    """Numbers that need no truth, in the world of the motion (floor at y = 0)."""
    return {
        "jerk": metrics.jerk_m_s3(joints_m, fps),
        "skating_gmd": metrics.foot_skating_gmd(joints_m, fps),
        "skating_kimodo": metrics.foot_skating_kimodo(joints_m, fps),
        "skating_rohm": metrics.foot_skating_rohm(joints_m, fps),
    }


def _true_numbers(truth: BodyMotion, common: CommonFrames, fps: float) -> dict[str, float]:
    if not len(common.span):
        return {}
    rows = common.true_index[common.span]
    contact = truth.contact[common.true_index[common.measured]][:, FEET] > 0.5
    return {**_own_numbers(truth.joints_world_m[rows], fps), "contact_ratio": float(contact.mean())}


def motion_curves(
    stages: Mapping[str, BodyMotion],
    truth: BodyMotion,
    common: CommonFrames,
    T_true_estimate: Float[np.ndarray, "4 4"],
    fps: float,
) -> tuple[Curve, ...]:
    """Errors and jerk over time in the common span."""
    rows = common.span
    if len(rows) < 4:
        return ()
    true_m = truth.joints_world_m[common.true_index[rows]]
    time_s = tuple(float(t) for t in truth.frame_time_s[common.true_index[rows]])
    root = metrics.ROOT
    local: dict[str, np.ndarray] = {}
    place: dict[str, np.ndarray] = {}
    jerk: dict[str, np.ndarray] = {"truth": _jerk_curve(true_m, fps)}
    for name, motion in stages.items():
        estimated_m = transform_points(T_true_estimate, motion.joints_world_m[rows])
        offset_m = estimated_m - true_m
        local[name] = np.linalg.norm(offset_m - offset_m[:, [root]], axis=-1).mean(1)
        place[name] = np.linalg.norm(offset_m[:, root], axis=-1)
        jerk[name] = _jerk_curve(motion.joints_world_m[rows], fps)
    return (
        Curve("Joint error, root-relative", "m", time_s, _plain_series(local)),
        Curve("Root error, absolute", "m", time_s, _plain_series(place)),
        Curve("Jerk", "m/s³", time_s, _plain_series(jerk)),
    )


def _jerk_curve(joints_m: np.ndarray, fps: float) -> np.ndarray:
    curve = np.full(len(joints_m), np.nan)
    curve[2:-1] = np.linalg.norm(np.diff(joints_m, n=3, axis=0), axis=-1).mean(1) * fps**3
    return curve


def _plain_series(series: Mapping[str, np.ndarray]) -> dict[str, tuple[float | None, ...]]:
    return {
        name: tuple(round(float(x), 5) if np.isfinite(x) else None for x in values) for name, values in series.items()
    }
