"""Analytic inverse kinematics of two-bone limbs: legs to ankles, arms to wrists."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.acting.curves import axis_rotation

_STRAIGHTEST = 0.9995


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def middle_joint(
    start_m: np.ndarray, end_m: np.ndarray, pole: np.ndarray, first_m: float, second_m: float
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 3"]]:
    """World position of the knee or elbow, which points towards `pole`, and of the end, clamped to the limb's
    length."""
    aim = end_m - start_m
    wanted = np.linalg.norm(aim, axis=-1)
    distance = np.clip(wanted, abs(first_m - second_m) + 0.05 * second_m, _STRAIGHTEST * (first_m + second_m))
    ahead = _unit(aim)
    side = _unit(pole - (pole * ahead).sum(-1, keepdims=True) * ahead)
    along = (first_m**2 + distance**2 - second_m**2) / (2 * distance)
    off = np.sqrt(np.maximum(first_m**2 - along**2, 0.0))
    return start_m + along[:, None] * ahead + off[:, None] * side, start_m + distance[:, None] * ahead


def leg_rotations(
    hip_m: np.ndarray, ankle_m: np.ndarray, pole: np.ndarray, thigh_m: float, shin_m: float
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3"]]:
    """World orientations of hip and knee joints, and the knee's position. The knee is a hinge about the thigh's x."""
    knee, ankle = middle_joint(hip_m, ankle_m, pole, thigh_m, shin_m)
    up = _unit(hip_m - ankle)
    x = _unit(np.cross(up, pole))
    frames = [np.stack([x, bone, np.cross(x, bone)], -1) for bone in (_unit(hip_m - knee), _unit(knee - ankle))]
    return frames[0], frames[1], knee


def arm_rotations(
    shoulder_m: np.ndarray, wrist_m: np.ndarray, pole: np.ndarray, upper_m: float, fore_m: float, side: int
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3 3"]]:
    """World orientations of shoulder and elbow. The elbow is a hinge about the upper arm's y and points towards
    `pole`."""
    elbow, wrist = middle_joint(shoulder_m, wrist_m, pole, upper_m, fore_m)
    sign = 1.0 if side == 0 else -1.0
    ahead = _unit(wrist - shoulder_m)
    y = sign * _unit(np.cross(pole, ahead)) * -1.0
    frames = []
    for bone in (_unit(elbow - shoulder_m), _unit(wrist - elbow)):
        x = sign * bone
        frames.append(np.stack([x, y, np.cross(x, y)], -1))
    return frames[0], frames[1]


def keyed_arm(
    flex: np.ndarray, abd: np.ndarray, twist: np.ndarray, elbow: np.ndarray, side: int
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3 3"]]:
    """Local rotations of shoulder (in the chest's frame) and elbow from angles in radians; all 0 = arm straight
    down."""
    sign = 1.0 if side == 0 else -1.0
    down = axis_rotation(2, sign * (abd - 0.5 * np.pi))
    shoulder = axis_rotation(0, -flex) @ down @ axis_rotation(0, twist)
    return shoulder, axis_rotation(1, -sign * elbow)
