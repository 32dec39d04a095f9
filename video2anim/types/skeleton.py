"""The 22-joint skeleton in SMPL order, and forward kinematics."""

from __future__ import annotations

from typing import Any

import numpy as np

JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
"""SMPL order (Loper et al. 2015); `left_foot` is the ball of the foot."""

PARENTS: np.ndarray = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19])
"""Index of each joint's parent, -1 for the root. Parents come first."""

JOINT_INDEX: dict[str, int] = {name: index for index, name in enumerate(JOINT_NAMES)}


def other_side(name: str) -> str:
    """The name with left and right exchanged."""
    side, _, rest = name.partition("_")
    return {"left": f"right_{rest}", "right": f"left_{rest}"}.get(side, name)


MIRROR_JOINT: np.ndarray = np.array([JOINT_INDEX[other_side(name)] for name in JOINT_NAMES])
"""For each joint the one of the other side."""

FEET: tuple[int, ...] = tuple(JOINT_INDEX[n] for n in ("left_ankle", "right_ankle", "left_foot", "right_foot"))

TOUCHING_PARTS: dict[str, tuple[int, ...]] = {
    name: tuple(JOINT_INDEX[joint] for joint in joints)
    for name, joints in {
        "seat": ("pelvis",),
        "back": ("spine3",),
        "left hand": ("left_wrist",),
        "right hand": ("right_wrist",),
        "left foot": ("left_ankle", "left_foot"),
        "right foot": ("right_ankle", "right_foot"),
    }.items()
}
"""Joints of each part that touches as one. If heel and toe were pulled to a surface separately, a foot with a slightly
wrong pitch would be pressed into it."""


def forward_kinematics(R_parent_joint: Any, translation_m: Any, rest_joints_m: Any) -> tuple[Any, Any]:
    """Joints (..., 22, 3) and their orientations R_world_joint (..., 22, 3, 3). numpy or torch.

    Args:
        R_parent_joint: (..., 22, 3, 3) local rotations; joint 0 holds the root orientation in the world.
        translation_m: (..., 3) translation of the root: joint 0 is at translation_m + rest_joints_m[0].
        rest_joints_m: (22, 3) or (..., 22, 3) T-pose joints.
    """
    orientations = [R_parent_joint[..., 0, :, :]]
    positions = [translation_m + rest_joints_m[..., 0, :]]
    for joint in range(1, len(PARENTS)):
        parent = int(PARENTS[joint])
        bone = rest_joints_m[..., joint, :] - rest_joints_m[..., parent, :]
        positions.append(positions[parent] + (orientations[parent] @ bone[..., None])[..., 0])
        orientations.append(orientations[parent] @ R_parent_joint[..., joint, :, :])
    if isinstance(R_parent_joint, np.ndarray):
        return np.stack(positions, -2), np.stack(orientations, -3)
    import torch

    return torch.stack(positions, -2), torch.stack(orientations, -3)
