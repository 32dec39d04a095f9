"""Quality numbers of a final motion, and the share of frames that the prior changed."""

from __future__ import annotations

import numpy as np

from scenemi import metrics
from video2anim.body.anny_body import shaped_body
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.geometry.sdf import SdfGrid
from video2anim.motion.keyframe_points import POINTS
from video2anim.motion.observation import image_distance_ratio
from video2anim.types import BodyMotion
from video2anim.types.clip import FPS
from video2anim.types.quality import Unit
from video2anim.types.skeleton import forward_kinematics

_DIFFERENT_RAD = np.deg2rad(3.0)
"""Rotations of a joint that differ by less count as equal."""


def shaped_by_prior(refined: BodyMotion, without: BodyMotion) -> float:
    """Share of the valid frames in which the rotation of some joint differs from that without the prior."""
    turn = axis_angle_from_matrix(without.R_parent_joint.swapaxes(-1, -2) @ refined.R_parent_joint)
    return float((np.linalg.norm(turn, axis=-1).max(1) > _DIFFERENT_RAD)[refined.valid].mean())


def assess(motion: BodyMotion, observed: BodyMotion, field: SdfGrid) -> tuple[tuple[str, float, Unit], ...]:
    """Key, value and unit of its quality numbers, all the lower the better, from the first to the last valid frame.

    Args:
        motion: With at least one valid frame.
        observed: The same person as stage humans has it.
        field: Distance to the scene.
    """
    measured = np.flatnonzero(motion.valid)
    span = slice(int(measured[0]), int(measured[-1]) + 1)
    body = shaped_body(motion.shape)
    index = np.arange(0, len(body.rest_vertices_m), max(1, len(body.rest_vertices_m) // POINTS))
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint[span], motion.T_world_root[span, :3, 3], motion.rest_joints_m
    )
    distance_m = field.sample(body.vertices(R_world_joint, joints_m, index).astype(np.float64))
    collision_ratio = metrics.collision_frame_ratio(distance_m, metrics.COLLISION_TAUS_M[1])
    return (
        ("jerk", metrics.jerk_m_s3(joints_m, FPS), "m/s^3"),
        ("foot_skating_gmd", metrics.foot_skating_gmd(joints_m, FPS), "ratio"),
        ("penetration_max", metrics.penetration_max_m(distance_m), "m"),
        ("frames_in_collision_1cm", collision_ratio, "ratio"),
        ("image_distance_over_height", 100 * float(np.median(image_distance_ratio(motion, observed))), "%"),
    )
