"""Inverse kinematics of the arms: hands reach their goals, and the forearm takes part of the wrist's twist."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
    slerp,
)
from video2anim.lab.synth.acting.curves import axis_rotation, smooth_lift, steady, window, yaw_rotation
from video2anim.lab.synth.acting.limbs import arm_rotations
from video2anim.lab.synth.acting.measure import ARM, LEG
from video2anim.lab.synth.acting.script import HandGoal, Script
from video2anim.types.skeleton import forward_kinematics

_MAX_REACH, _MAX_REACH_BAND = 0.96, 0.035
"""Shoulder-to-wrist distance, as a share of the arm's length, above which it saturates, and how much it may still
grow."""
_CLEAR_REACH = 0.55
"""A wrist nearer to the shoulder than this share of the arm's length is moved ahead of the body."""
_MIN_REACH, _MIN_REACH_BAND = 0.42, 0.1
"""The same two numbers for the lower limit of shoulder-to-wrist distance."""
_FREE_WRIST_RAD, _WRIST_SLACK_RAD = 1.0, 0.45
"""Angle above which the bend of the wrist saturates, and how much it may still grow."""
_FOREARM_SHARE = 0.6
"""Share of the wrist's twist that the forearm takes."""


def place_hands(
    script: Script,
    t: Float[np.ndarray, "frames"],
    pelvis_m: Float[np.ndarray, "frames 3"],
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    heading_rad: Float[np.ndarray, "frames"],
) -> Float[np.ndarray, "frames 22 3 3"]:
    """Local rotations with the hands at the script's goals; an arm without goals keeps its rotations.

    Args:
        script: The hand goals and the body.
        t: Time of each frame in seconds.
        pelvis_m: World position of the pelvis.
        R_parent_joint: Local rotations before the arms are solved.
        heading_rad: Heading of the pelvis about +Y.
    """
    R, rest = R_parent_joint.copy(), script.size.rest_m
    joints, R_world = forward_kinematics(R, pelvis_m, rest)
    for side, (collar, shoulder, elbow, wrist) in enumerate(ARM):
        goals = [goal for goal in script.hands if goal.side == side]
        if not goals:
            continue
        target, pole = joints[:, wrist].copy(), _elbow_direction(joints, shoulder, elbow, wrist)
        turn, fixed = np.broadcast_to([1.0, 0, 0, 0], (len(t), 4)), np.zeros((len(t), 1))
        world = quaternion_from_matrix(R_world[:, wrist])
        for goal in goals:
            weight = window(t, goal.start_s, goal.touch_s, goal.leave_s, goal.end_s)[:, None]
            place, R_hand = _goal(goal, t, joints, pelvis_m, heading_rad)
            target = target + weight * (place - target)
            out = np.array([1.0 if side == 0 else -1.0, 1.0, 1.0]) * np.array(goal.elbow)
            towards = R_world[:, 0] @ (out / np.linalg.norm(out))
            pole = pole + weight * (towards - pole)
            if R_hand is not None:
                world = slerp(world, quaternion_from_matrix(R_hand), weight)
                fixed = np.maximum(fixed, weight)
        upper = np.linalg.norm(rest[elbow] - rest[shoulder])
        fore = np.linalg.norm(rest[wrist] - rest[elbow])
        if side in script.hand_lift_m:
            target = target + script.hand_lift_m[side][:, None] * np.array([0.0, 1.0, 0.0])
        target = _around_shoulder(joints[:, shoulder], target, R_world[:, 0], side, float(upper + fore))
        target = _within_reach(joints[:, shoulder], target, float(upper + fore))
        R_upper, R_fore = arm_rotations(joints[:, shoulder], target, pole, float(upper), float(fore), side)
        R[:, shoulder] = np.swapaxes(R_world[:, collar], -1, -2) @ R_upper
        R[:, elbow] = np.swapaxes(R_upper, -1, -2) @ R_fore
        free = slerp(
            quaternion_from_matrix(np.swapaxes(R_fore, -1, -2) @ matrix_from_quaternion(world)), turn, 1 - fixed
        )
        R[:, elbow], R[:, wrist] = _pronated(R[:, elbow], matrix_from_quaternion(free))
    return R


def _around_shoulder(
    shoulder_m: np.ndarray, target_m: np.ndarray, R_pelvis: np.ndarray, side: int, arm_m: float
) -> Float[np.ndarray, "frames 3"]:
    """Targets (world, meters) moved ahead of the body where they come too near to the shoulder."""
    near = _CLEAR_REACH * arm_m - np.linalg.norm(target_m - shoulder_m, axis=1)
    away = R_pelvis @ np.array([0.5 if side == 0 else -0.5, 0.0, 0.85])
    return target_m + smooth_lift(near, 0.3)[:, None] * away


def _within_reach(shoulder_m: np.ndarray, target_m: np.ndarray, arm_m: float) -> Float[np.ndarray, "frames 3"]:
    """Targets (world, meters) with the distance to the shoulder saturated near both limits, so that elbows never
    snap."""
    aim = target_m - shoulder_m
    distance = np.linalg.norm(aim, axis=1, keepdims=True)
    share = distance / arm_m
    soft = np.where(
        share > _MAX_REACH, _MAX_REACH + _MAX_REACH_BAND * np.tanh((share - _MAX_REACH) / _MAX_REACH_BAND), share
    )
    soft = np.where(
        share < _MIN_REACH, _MIN_REACH - _MIN_REACH_BAND * np.tanh((_MIN_REACH - share) / _MIN_REACH_BAND), soft
    )
    return shoulder_m + aim * (soft / share)


def _elbow_direction(joints: np.ndarray, shoulder: int, elbow: int, wrist: int) -> Float[np.ndarray, "frames 3"]:
    aim = joints[:, wrist] - joints[:, shoulder]
    aim = aim / np.linalg.norm(aim, axis=1, keepdims=True)
    bone = joints[:, elbow] - joints[:, shoulder]
    off = bone - (bone * aim).sum(1, keepdims=True) * aim
    return off / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-9)


def _goal(
    goal: HandGoal, t: np.ndarray, joints: np.ndarray, pelvis_m: np.ndarray, heading_rad: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """World wrist position and orientation of a goal at every frame."""
    count = len(pelvis_m)
    if goal.frame == "world":
        R = None if goal.R_hand is None else np.broadcast_to(goal.R_hand, (count, 3, 3))
        if goal.slide is None:
            return np.broadcast_to(goal.offset_m, (count, 3)), R
        start, end, move_m = goal.slide
        return goal.offset_m + steady((t - start) / (end - start))[:, None] * move_m, R
    heading = yaw_rotation(heading_rad)
    R = None if goal.R_hand is None else heading @ goal.R_hand
    if goal.frame == "body":
        return pelvis_m + heading @ goal.offset_m, R
    hip, knee = LEG[goal.side][:2]
    along = joints[:, knee] - joints[:, hip]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    out = (1.0 if goal.side == 0 else -1.0) * heading[:, :, 0]
    up = np.cross(along, heading[:, :, 0])
    place = joints[:, hip] + goal.offset_m[0] * along + goal.offset_m[1] * up + goal.offset_m[2] * out
    return place, R


def _pronated(R_elbow: np.ndarray, R_wrist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Moves part of the twist about the forearm from the wrist to the elbow; the wrist then bends less than 83
    degrees."""
    q = quaternion_from_matrix(R_wrist)
    twist = 2.0 * np.arctan2(q[:, 1], q[:, 0])
    twist = (twist + np.pi) % (2 * np.pi) - np.pi
    share = axis_rotation(0, _FOREARM_SHARE * twist)
    rest = axis_angle_from_matrix(np.swapaxes(share, -1, -2) @ R_wrist)
    angle = np.maximum(np.linalg.norm(rest, axis=1, keepdims=True), 1e-9)
    beyond = _WRIST_SLACK_RAD * np.tanh((angle - _FREE_WRIST_RAD) / _WRIST_SLACK_RAD)
    allowed = np.where(angle > _FREE_WRIST_RAD, _FREE_WRIST_RAD + beyond, angle)
    return R_elbow @ share, matrix_from_axis_angle(rest * (allowed / angle))
