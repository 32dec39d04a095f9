"""Feet that stand, brought onto the surface under them by leg inverse kinematics: optional part of the keyframes stage.

The root's displacement serves both feet, both hands and the pelvis at once, so a foot may still be a few centimeters
inside the step it stands on, or above it. Here each such foot is lifted or lowered, straight up or down: what a foot
stands on faces up, and the way to the nearest surface could as well lead out of a step's riser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.body.leg_ik import LEGS, Leg, move_ankles
from video2anim.body.skeleton import forward_kinematics
from video2anim.fitting.keyframe_moves import between_keyframes
from video2anim.fitting.keyframe_points import SkinPoints
from video2anim.geometry.sdf import SdfGrid
from video2anim.types import BodyMotion

_STEP_M = 0.005
"""Heights tried; between two of them the distance is taken as linear."""
_NEAR_ENOUGH_M = 0.003
"""A foot this near its surface is left as it is: scenes are no better known."""
_STRAIGHTEST = 0.99
"""A foot is not lowered to where its leg would be straighter than this share of its length: the last percent of reach
costs the knee 16 degrees, and costs them at once."""
_LEAST_GAP_FRAMES = 3
"""A correction does not change faster than between keyframes this far apart: those in between, which the edges of valid
stretches make, are not asked."""


@dataclass(frozen=True, slots=True, eq=False)
class PlantedFeet:
    """Result of `plant_feet`."""

    motion: BodyMotion
    moved: int
    """Touching feet at keyframes that were brought to their surface."""
    left: int
    """Those left off it: no surface within the limit, or out of the leg's reach."""
    largest_m: float
    """Longest correction."""


def plant_feet(
    motion: BodyMotion,
    keyframes: Int[np.ndarray, "keyframes"],
    skin: SkinPoints,
    scene: SdfGrid,
    *,
    contact_threshold: float,
    contact_points: int,
    limit_m: float,
) -> PlantedFeet:
    """Bring touching feet onto the surface they stand on; between keyframes the correction is interpolated.

    A foot is where the mean of its `contact_points` deepest vertices is. Bone lengths, the knee's direction and the
    foot's orientation in the world stay; so does, to the bit, every frame without a correction.

    Args:
        motion: with its roots already displaced.
        skin: its skin.
        limit_m: longest correction; a foot farther from an upward surface is left alone.
    """
    keyframes = _spaced(keyframes)
    R_parent_joint, moved, left, largest_m = motion.R_parent_joint, 0, 0, 0.0
    root_m = motion.T_world_root[:, :3, 3]
    for leg in LEGS:
        parts = (leg.ankle, leg.toe)
        touching = motion.contact[keyframes][:, parts] >= contact_threshold
        lift_m = np.zeros(len(keyframes))
        for row in np.flatnonzero(touching.any(axis=1)):
            down = [part for part, touches in zip(parts, touching[row], strict=True) if touches]
            sole_m = np.concatenate([skin.parts_m[part][keyframes[row]] for part in down])
            gap_m = _lift_to_surface(sole_m, scene, contact_points, limit_m)
            if np.isnan(gap_m) or not _reaches(motion.joints_world_m[keyframes[row]], leg, gap_m):
                left += 1
            elif gap_m:
                lift_m[row] = gap_m
                moved += 1
        everywhere_m = between_keyframes(keyframes, lift_m[:, None], motion.frame_count)[:, 0]
        R_parent_joint = _with_ankle_lifted(R_parent_joint, root_m, motion.rest_joints_m, leg, everywhere_m)
        largest_m = max(largest_m, float(np.abs(lift_m).max()))
    planted = motion.with_pose(translation_world_m=root_m, R_parent_joint=R_parent_joint) if moved else motion
    return PlantedFeet(planted, moved, left, largest_m)


def _spaced(keyframes: Int[np.ndarray, "keyframes"]) -> Int[np.ndarray, "chosen"]:
    chosen = [int(keyframes[0])]
    for frame in keyframes[1:]:
        if frame - chosen[-1] >= _LEAST_GAP_FRAMES:
            chosen.append(int(frame))
    return np.array(chosen)


def _lift_to_surface(sole_m: Float[np.ndarray, "vertices 3"], scene: SdfGrid, points: int, limit_m: float) -> float:
    """Shortest way up (or, negative, down) that puts a sole on an upward surface; 0 where it is near enough, NaN where
    no surface is within the limit."""
    count = max(1, round(limit_m / _STEP_M))
    height_m = np.linspace(-limit_m, limit_m, 2 * count + 1)
    lifted_m = sole_m + height_m[:, None, None] * np.array([0.0, 1.0, 0.0])
    distance_m = np.sort(scene.sample(lifted_m), axis=1)[:, :points].mean(axis=1)
    if abs(distance_m[count]) <= _NEAR_ENOUGH_M:
        return 0.0
    emerging = np.flatnonzero((distance_m[:-1] < 0) & (distance_m[1:] >= 0))
    if not len(emerging):
        return float("nan")
    share = distance_m[emerging] / (distance_m[emerging] - distance_m[emerging + 1])
    crossing_m = height_m[emerging] + share * np.diff(height_m)[emerging]
    return float(crossing_m[np.abs(crossing_m).argmin()])


def _reaches(joints_m: Float[np.ndarray, "22 3"], leg: Leg, lift_m: float) -> bool:
    """Whether the ankle can be moved so far without a straighter leg than it may have."""
    hip_m, knee_m, ankle_m = joints_m[leg.hip], joints_m[leg.knee], joints_m[leg.ankle]
    bones_m = np.linalg.norm(knee_m - hip_m) + np.linalg.norm(ankle_m - knee_m)
    longest_m = max(_STRAIGHTEST * bones_m, np.linalg.norm(ankle_m - hip_m))
    lifted_m = ankle_m + np.array([0.0, lift_m, 0.0])
    return bool(np.linalg.norm(lifted_m - hip_m) <= longest_m)


def _with_ankle_lifted(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    root_m: Float[np.ndarray, "frames 3"],
    rest_joints_m: Float[np.ndarray, "22 3"],
    leg: Leg,
    lift_m: Float[np.ndarray, "frames"],
) -> Float[np.ndarray, "frames 22 3 3"]:
    changed: Bool[np.ndarray, "frames"] = lift_m != 0
    if not changed.any():
        return R_parent_joint
    joints_m, _ = forward_kinematics(R_parent_joint[changed], root_m[changed], rest_joints_m)
    target_m = joints_m[:, leg.ankle]
    target_m[:, 1] += lift_m[changed]
    solved = R_parent_joint.copy()
    solved[changed] = move_ankles(R_parent_joint[changed], root_m[changed], rest_joints_m, leg, target_m)
    return solved
