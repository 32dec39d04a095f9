"""Two-bone inverse kinematics about the limb's own hinge: knees and elbows cannot flip when they are straight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.body.legs import Leg
from video2anim.geometry.rotations import matrix_from_axis_angle, rotations_between
from video2anim.geometry.two_bone import flexion_rad

_SOFT, _LONGEST = 0.995, 0.9995
"""Shares of the leg: where stretching begins to saturate, and where it ends."""
_STANDING = 0.998
"""Longest hip-ankle distance that a standing leg is given."""
_MAX_DROP = 0.12
"""Farthest a hip goes down for a foot, as a share of the leg: a foot that needs more stands wrongly."""
_SHORTEST = 0.17
"""Shortest distance from a limb's root to its end, as a share of the limb: 160 degrees of bend."""


@dataclass(frozen=True, slots=True, eq=False)
class LegBones:
    """Rest vectors of thigh and shin."""

    thigh_m: Float[np.ndarray, "3"]
    shin_m: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, rest_joints_m: Float[np.ndarray, "22 3"], leg: Leg) -> LegBones:
        """Bones of one leg of a body in the T-pose."""
        return cls(
            rest_joints_m[leg.knee] - rest_joints_m[leg.hip],
            rest_joints_m[leg.ankle] - rest_joints_m[leg.knee],
        )

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(self.thigh_m) + np.linalg.norm(self.shin_m))


def hip_drop(
    hip_m: Float[np.ndarray, "frames 3"], ankle_m: Float[np.ndarray, "frames 3"], bones: LegBones
) -> Float[np.ndarray, "frames"]:
    """How far the hip should go down for the ankle to be within reach, 0 where it is."""
    reach_m = _STANDING * bones.length_m
    across_m = np.linalg.norm((hip_m - ankle_m)[:, ::2], axis=-1)
    highest_m = ankle_m[:, 1] + np.sqrt(np.maximum(reach_m**2 - across_m**2, (0.3 * reach_m) ** 2))
    return np.clip(hip_m[:, 1] - highest_m, 0.0, _MAX_DROP * bones.length_m)


def bend_leg(
    R_world_hip: Float[np.ndarray, "frames 3 3"],
    hip_m: Float[np.ndarray, "frames 3"],
    ankle_m: Float[np.ndarray, "frames 3"],
    bones: LegBones,
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3 3"]]:
    """World orientations of hip and knee that bring the ankle to its place with the least turn of the thigh.

    Beyond 99.5 % of its length the leg yields softly and the ankle falls short.
    """
    aim_m = ankle_m - hip_m
    wanted = np.linalg.norm(aim_m, axis=-1)
    soft, longest = _SOFT * bones.length_m, _LONGEST * bones.length_m
    eased = soft + (longest - soft) * (1 - np.exp(-np.maximum(wanted - soft, 0.0) / (longest - soft)))
    distance = np.maximum(np.where(wanted > soft, eased, wanted), _SHORTEST * bones.length_m)
    flexion = _flexion_for(distance, bones)
    R_hip_knee = matrix_from_axis_angle(np.stack([flexion, 0 * flexion, 0 * flexion], -1))
    bent_m = (R_world_hip @ (bones.thigh_m + R_hip_knee @ bones.shin_m)[..., None])[..., 0]
    R_hip = rotations_between(bent_m, aim_m) @ R_world_hip
    return R_hip, R_hip @ R_hip_knee


def _flexion_for(distance_m: Float[np.ndarray, "frames"], bones: LegBones) -> Float[np.ndarray, "frames"]:
    """Turn of the shin about x at which hip and ankle are so far apart; bones need not lie in the plane of the turn.

    |thigh + R_x shin| squared is constant + A cos + B sin of the turn; where no turn gives the distance, the nearest.
    """
    (x, *thigh), (shin_x, *shin) = bones.thigh_m, bones.shin_m
    A, B = np.dot(thigh, shin), thigh[1] * shin[0] - thigh[0] * shin[1]
    fixed = np.dot(bones.thigh_m, bones.thigh_m) + np.dot(bones.shin_m, bones.shin_m) + 2 * x * shin_x
    cosine = (distance_m**2 - fixed) / (2 * np.hypot(A, B))
    return np.arctan2(B, A) + np.arccos(np.clip(cosine, -1.0, 1.0))


def move_wrist(
    R_world_shoulder: Float[np.ndarray, "frames 3 3"],
    R_world_elbow: Float[np.ndarray, "frames 3 3"],
    arm_m: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]],
    elbow_axis: Float[np.ndarray, "3"],
    shift_m: Float[np.ndarray, "frames 3"],
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3 3"]]:
    """World orientations of shoulder and elbow that displace the wrist, as far as the arm reaches.

    `arm_m` holds the rest vectors of upper arm and forearm, `elbow_axis` the axis of flexion in the shoulder's frame.
    """
    upper, fore = (float(np.linalg.norm(bone)) for bone in arm_m)
    upper_m, fore_m = R_world_shoulder @ arm_m[0], R_world_elbow @ arm_m[1]
    present_m = upper_m + fore_m
    present = np.linalg.norm(present_m, axis=-1)
    longest = np.maximum(_LONGEST * (upper + fore), present)
    wanted = np.clip(np.linalg.norm(present_m + shift_m, axis=-1), _SHORTEST * (upper + fore), longest)
    turn = flexion_rad(upper, fore, wanted) - flexion_rad(upper, fore, present)
    R_bend = matrix_from_axis_angle((R_world_shoulder @ elbow_axis) * turn[:, None])
    bent_m = upper_m + (R_bend @ fore_m[..., None])[..., 0]
    R_turn = rotations_between(bent_m, present_m + shift_m)
    return R_turn @ R_world_shoulder, R_turn @ R_bend @ R_world_elbow
