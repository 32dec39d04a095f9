"""Before/after numbers of a motion in its scene, from the definitions in `scenemi.metrics`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scenemi import metrics
from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import CHUNK_FRAMES
from video2anim.geometry.sdf import sample_sdf
from video2anim.types import BodyMotion, SceneModel
from video2anim.types.quality import Quality, Unit
from video2anim.types.skeleton import forward_kinematics

VERTEX_STRIDE = 8
"""Every such vertex of the body is tested against the scene."""
_PICTURED_DEPTH_M = metrics.INSIDE_M
"""Shallower penetrations get no picture."""
_SHORTEST_SPAN = 4
"""Frames below which a third difference does not exist."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionQuality:
    """Numbers of one person's motion between its first and last measured frame, and the curves behind them."""

    numbers: tuple[Quality, ...]
    time_s: Float[np.ndarray, "span"]
    jerk_m_s3: Float[np.ndarray, "span"]
    """Mean over joints, centered on its four frames; NaN at the ends."""
    clearance_m: Float[np.ndarray, "span"]
    """Signed distance of the nearest (or deepest) body vertex to the scene; NaN without a scene."""
    skating_m_s: Float[np.ndarray, "span"]
    """Horizontal speed of the faster toe that is near the floor (`gmd`); NaN where neither is."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A frame to look at."""

    frame: int
    key: str
    value: float
    unit: Unit


def motion_quality(motion: BodyMotion, scene: SceneModel | None, span: slice, fps: float) -> MotionQuality:
    """Measure a motion over the frames `span` (see `measured_span`)."""
    joints_m = motion.joints_world_m[span]
    numbers = [
        Quality("jerk", metrics.jerk_m_s3(joints_m, fps), "m/s^3", "lower"),
        Quality("foot_skating_gmd", metrics.foot_skating_gmd(joints_m, fps), "ratio", "lower"),
        Quality("foot_skating_kimodo", metrics.foot_skating_kimodo(joints_m, fps), "ratio", "lower"),
        Quality("foot_skating_rohm", metrics.foot_skating_rohm(joints_m, fps), "ratio", "lower"),
    ]
    clearance_m = np.full(len(joints_m), np.nan)
    if scene is not None:
        distance_m = scene_distance_m(motion, scene, span)
        clearance_m = distance_m.min(1)
        numbers += [
            Quality("frames_in_collision", metrics.collision_frame_ratio(distance_m, 0.0), "ratio", "lower"),
            Quality("frames_in_collision_1cm", metrics.collision_frame_ratio(distance_m, 0.01), "ratio", "lower"),
            Quality("vertices_in_collision", metrics.collision_vertex_ratio(distance_m, 0.0), "ratio", "lower"),
            Quality("penetration_max", metrics.penetration_max_m(distance_m), "m", "lower"),
            Quality("floating", metrics.floating_m(distance_m), "m", "lower"),
        ]
    return MotionQuality(
        tuple(numbers), motion.frame_time_s[span], _jerk_curve(joints_m, fps), clearance_m,
        _skating_curve(joints_m, fps),
    )  # fmt: skip


def worst_moments(quality: MotionQuality, span: slice) -> tuple[Moment, ...]:
    """The deepest penetration, the fastest skating and the strongest jerk, where there is any."""
    found = []
    curves: tuple[tuple[str, np.ndarray, float, float, Unit], ...] = (
        ("penetration_max", quality.clearance_m, _PICTURED_DEPTH_M, -1.0, "m"),
        ("skating_max", quality.skating_m_s, metrics.KIMODO_SPEED_M_S, 1.0, "m/s"),
        ("jerk_max", quality.jerk_m_s3, 0.0, 1.0, "m/s^3"),
    )
    for key, curve, least, sign, unit in curves:
        bad = np.where(np.isfinite(curve), sign * curve, -np.inf)
        if len(bad) and bad.max() > least:
            found.append(Moment(span.start + int(bad.argmax()), key, float(bad.max()), unit))
    return tuple(found)


def measured_span(motion: BodyMotion) -> slice | None:
    """From the first to the last measured frame; None where that is too short to differentiate."""
    measured = np.flatnonzero(motion.valid)
    if len(measured) == 0 or measured[-1] - measured[0] + 1 < _SHORTEST_SPAN:
        return None
    return slice(int(measured[0]), int(measured[-1]) + 1)


def scene_distance_m(motion: BodyMotion, scene: SceneModel, span: slice) -> Float[np.ndarray, "span chosen"]:
    """Signed distance to the scene of every 8th body vertex, positive in free space."""
    body = shaped_body(motion.shape)
    index = np.arange(0, len(body.rest_vertices_m), VERTEX_STRIDE)
    distances = []
    for first in range(span.start, span.stop, CHUNK_FRAMES):
        chunk = slice(first, min(first + CHUNK_FRAMES, span.stop))
        joints_m, R_world_joint = forward_kinematics(
            motion.R_parent_joint[chunk], motion.T_world_root[chunk, :3, 3], motion.rest_joints_m
        )
        vertices_m = body.vertices(R_world_joint, joints_m, index)
        distances.append(sample_sdf(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m, vertices_m))
    return np.concatenate(distances)


def _jerk_curve(joints_m: np.ndarray, fps: float) -> np.ndarray:
    curve = np.full(len(joints_m), np.nan)
    curve[2:-1] = np.linalg.norm(np.diff(joints_m, n=3, axis=0), axis=-1).mean(1) * fps**3
    return curve


def _skating_curve(joints_m: np.ndarray, fps: float) -> np.ndarray:
    toes = joints_m[:, metrics.TOES]
    low = toes[..., metrics.UP] < metrics.TOE_CONTACT_M
    speed = np.linalg.norm(np.diff(toes[..., metrics.HORIZONTAL], axis=0), axis=-1) * fps
    speed = np.where(low[1:] & low[:-1], speed, -1.0).max(1, initial=-1.0)
    return np.concatenate([[np.nan], np.where(speed < 0, np.nan, speed)])[: len(joints_m)]
