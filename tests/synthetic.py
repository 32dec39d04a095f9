"""A synthetic walk with planted feet on a real body: known truth for motion and scene tests."""

from __future__ import annotations

import numpy as np
import torch
from leg_ik import move_ankles

from video2anim.body.anny_body import ADULT, anny_model, shaped_body
from video2anim.body.legs import LEGS
from video2anim.geometry.projection import invert_rigid
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.humans.landmarks import with_landmarks
from video2anim.types import BodyMotion, BodyShape, Intrinsics
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

FPS = 30.0
STEP_S = 0.5
"""Time from one heel strike to the next of the other foot."""
SWING_RATIO = 0.8
"""Share of a step in which a foot is in the air."""


def rotation(axis: str, angle_rad: np.ndarray) -> np.ndarray:
    """Rotation matrices (T, 3, 3) about a coordinate axis."""
    vector = np.zeros((*np.shape(angle_rad), 3))
    vector[..., "xyz".index(axis)] = angle_rad
    return matrix_from_axis_angle(vector)


def planted_walk(frames: int = 150, *, speed_m_s: float = 0.8, person_id: int = 1) -> BodyMotion:
    """A person walking along +Z from the origin, soles on the floor, feet exactly still in stance."""
    shape = BodyShape("anny", dict(ADULT))
    body = shaped_body(shape)
    rest = body.rest_joints_m
    sole_m = float(body.vertices(np.tile(np.eye(3), (1, 22, 1, 1)), rest[None])[..., 1].min())
    time_s = np.arange(frames) / FPS
    phase = np.pi * time_s / STEP_S
    R_parent_joint = np.tile(np.eye(3), (frames, 22, 1, 1))
    for name, axis, angle in (
        ("left_shoulder", "z", -1.2 + 0 * phase), ("right_shoulder", "z", 1.2 + 0 * phase),
        ("left_elbow", "y", -0.4 - 0.2 * np.sin(phase)), ("right_elbow", "y", 0.4 - 0.2 * np.sin(phase)),
        ("left_hip", "x", -0.3 + 0 * phase), ("right_hip", "x", -0.3 + 0 * phase),
        ("left_knee", "x", 0.6 + 0 * phase), ("right_knee", "x", 0.6 + 0 * phase),
        ("left_ankle", "x", -0.3 + 0 * phase), ("right_ankle", "x", -0.3 + 0 * phase),
        ("spine2", "y", 0.08 * np.sin(phase)),
    ):  # fmt: skip
        R_parent_joint[:, JOINT_INDEX[name]] = rotation(axis, angle)
    height_m = -sole_m - 0.09 + 0.012 * np.cos(2 * phase)
    translation_m = np.stack([0.02 * np.sin(phase), height_m, speed_m_s * time_s], -1)
    contact = np.zeros((frames, 22))
    for side, leg in enumerate(LEGS):
        ankle_m, planted = _ankle_path(time_s, speed_m_s, side, rest[leg.ankle], rest[leg.ankle, 1] - sole_m)
        R_parent_joint = move_ankles(R_parent_joint, translation_m, rest, leg, ankle_m)
        contact[:, [leg.ankle, leg.toe]] = planted[:, None]
    joints_world_m, _ = forward_kinematics(R_parent_joint, translation_m, rest)
    T_world_root = np.tile(np.eye(4), (frames, 1, 1))
    T_world_root[:, :3, :3], T_world_root[:, :3, 3] = R_parent_joint[:, 0], translation_m
    return BodyMotion(
        person_id=person_id,
        frame_time_s=time_s,
        valid=np.ones(frames, bool),
        T_world_root=T_world_root,
        R_parent_joint=R_parent_joint,
        T_world_camera=np.tile(side_camera(0.5 * speed_m_s * time_s[-1]), (frames, 1, 1)),
        intrinsics=Intrinsics.centered(500.0, 640, 360),
        contact=contact,
        shape=shape,
        rest_joints_m=rest,
        joints_world_m=joints_world_m,
    )


def _ankle_path(
    time_s: np.ndarray, speed_m_s: float, side: int, rest_ankle_m: np.ndarray, height_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ankle positions (T, 3) of a walk: still in stance, a smooth arc in swing; and the stance frames."""
    stride_s, swing_s = 2 * STEP_S, SWING_RATIO * STEP_S
    cycle = (time_s + side * STEP_S) / stride_s
    count, within_s = np.floor(cycle), (cycle - np.floor(cycle)) * stride_s
    swing = np.clip(within_s / swing_s, 0.0, 1.0)
    ease = swing**3 * (10 - 15 * swing + 6 * swing**2)
    stride_m = speed_m_s * stride_s
    # A foot lands ahead of the root and leaves as far behind it.
    z_m = (count + ease - side * 0.5 - 1) * stride_m + 0.5 * speed_m_s * (stride_s + swing_s)
    y_m = height_m + 0.15 * np.maximum(np.sin(np.pi * swing), 0.0) ** 1.5
    x_m = np.full_like(z_m, rest_ankle_m[0])
    return np.stack([x_m, y_m, z_m], -1), (swing == 0) | (swing == 1)


def side_camera(along_m: float) -> np.ndarray:
    """Level OpenCV camera 4 m to the body's left of the path, 1.2 m up, looking along -X."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.array([[0, 0, -1.0], [0, -1.0, 0], [-1.0, 0, 0]])
    T_world_camera[:3, 3] = [4.0, 1.2, along_m]
    return T_world_camera


def with_root_shift(motion: BodyMotion, shift_m: np.ndarray) -> BodyMotion:
    """The same poses with the root displaced by (T, 3)."""
    return motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + shift_m, R_parent_joint=motion.R_parent_joint
    )


def world_to_camera(motion: BodyMotion, frame: int) -> np.ndarray:
    """T_camera_world of one frame."""
    return invert_rigid(motion.T_world_camera[frame])


def true_keypoints(motion: BodyMotion) -> np.ndarray:
    """Keypoints (T, K, 3) of a motion in the world, where landmarks are on the body."""
    shape = {name: torch.tensor(value) for name, value in motion.shape.parameters.items()}
    rest = with_landmarks(anny_model().rest_skeleton(shape))
    _, R = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    return rest.keypoints_m(torch.from_numpy(motion.joints_world_m).float(), torch.from_numpy(R).float()).numpy()
