"""Two-bone leg inverse kinematics: move ankles, keep bone lengths, knee direction and foot orientation."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.body.legs import Leg
from video2anim.geometry.rotations import matrix_from_axis_angle, rotations_between
from video2anim.geometry.two_bone import flexion_rad
from video2anim.types.skeleton import PARENTS, forward_kinematics

_STRAIGHTEST = 0.999
"""Longest hip-ankle distance a correction may ask for, as a share of the leg: beyond it the knee would snap."""
_HINT = 1e-3
"""Weight of the hip's x axis in the knee's bending axis; it decides for a straight leg only."""


def move_ankles(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_world_m: Float[np.ndarray, "frames 3"],
    rest_joints_m: Float[np.ndarray, "22 3"],
    leg: Leg,
    ankle_world_m: Float[np.ndarray, "frames 3"],
) -> Float[np.ndarray, "frames 22 3 3"]:
    """Local rotations that bring one leg's ankle to `ankle_world_m`; foot orientation in the world is kept.

    Where the target is out of reach, the leg points at it and stretches to 99.9 % of its length (or keeps the length
    it had, if that was more).
    """
    joints_m, R_world_joint = forward_kinematics(R_parent_joint, translation_world_m, rest_joints_m)
    hip_m, knee_m, ankle_m = joints_m[:, leg.hip], joints_m[:, leg.knee], joints_m[:, leg.ankle]
    thigh_m, shin_m, aim_m = knee_m - hip_m, ankle_m - knee_m, ankle_world_m - hip_m
    thigh, shin = _length(thigh_m), _length(shin_m)
    present = _length(ankle_m - hip_m)
    longest = np.maximum(present, _STRAIGHTEST * (thigh + shin))
    shortest = np.minimum(present, np.abs(thigh - shin) + 0.1 * np.minimum(thigh, shin))
    wanted = np.clip(_length(aim_m), shortest, longest)

    bend_axis = np.cross(thigh_m, shin_m) + _HINT * (thigh * shin)[:, None] * R_world_joint[:, leg.hip, :, 0]
    bend_axis /= _length(bend_axis)[:, None]
    turn = flexion_rad(thigh, shin, wanted) - flexion_rad(thigh, shin, present)
    R_knee = matrix_from_axis_angle(bend_axis * turn[:, None])
    bent_m = thigh_m + _apply(R_knee, shin_m)
    R_hip = rotations_between(bent_m, aim_m)

    R_world_hip = R_hip @ R_world_joint[:, leg.hip]
    R_world_knee = R_hip @ R_knee @ R_world_joint[:, leg.knee]
    solved = R_parent_joint.copy()
    solved[:, leg.hip] = _transposed(R_world_joint[:, int(PARENTS[leg.hip])]) @ R_world_hip
    solved[:, leg.knee] = _transposed(R_world_hip) @ R_world_knee
    solved[:, leg.ankle] = _transposed(R_world_knee) @ R_world_joint[:, leg.ankle]
    return solved


def _length(vector: np.ndarray) -> Float[np.ndarray, "frames"]:
    return np.linalg.norm(vector, axis=-1)


def _apply(rotation: np.ndarray, vector: np.ndarray) -> Float[np.ndarray, "frames 3"]:
    return np.einsum("tij,tj->ti", rotation, vector)


def _transposed(rotation: np.ndarray) -> np.ndarray:
    return np.swapaxes(rotation, -1, -2)
