"""What keyframes are moved by, what lies between them, and a motion moved so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator

from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types import BodyMotion


@dataclass(frozen=True, slots=True, eq=False)
class RootMoves:
    """Moves of one body at some frames."""

    displacement_m: Float[np.ndarray, "frames 3"]
    """Of the root, world frame."""
    yaw_rad: Float[np.ndarray, "frames"]
    """Turn about the vertical through the root, positive from +Z to +X."""

    def at_all_frames(self, keyframes: Int[np.ndarray, "keyframes"], frame_count: int) -> RootMoves:
        """Moves of keyframes carried over to a whole clip."""
        moves = np.concatenate([self.displacement_m, self.yaw_rad[:, None]], axis=1)
        between = between_keyframes(keyframes, moves, frame_count)
        return RootMoves(between[:, :3], between[:, 3])

    def apply(self, motion: BodyMotion) -> BodyMotion:
        """The motion with its roots moved; frames with no turn keep their rotations to the bit."""
        R_parent_joint = motion.R_parent_joint
        turning = self.yaw_rad != 0
        if turning.any():
            about_y = np.zeros((int(turning.sum()), 3))
            about_y[:, 1] = self.yaw_rad[turning]
            R_parent_joint = R_parent_joint.copy()
            R_parent_joint[turning, 0] = matrix_from_axis_angle(about_y) @ R_parent_joint[turning, 0]
        return motion.with_pose(
            translation_world_m=motion.T_world_root[:, :3, 3] + self.displacement_m, R_parent_joint=R_parent_joint
        )


def between_keyframes(
    keyframes: Int[np.ndarray, "keyframes"], moves: Float[np.ndarray, "keyframes dims"], frame_count: int
) -> Float[np.ndarray, "frames dims"]:
    """Moves of every frame: monotone cubic between keyframes (no overshoot), constant beyond them."""
    if len(keyframes) == 1:
        return np.tile(moves, (frame_count, 1))
    frames = np.clip(np.arange(frame_count), keyframes[0], keyframes[-1])
    return PchipInterpolator(keyframes, moves)(frames)


def turned_about_y(points_m: Any, root_m: Any, yaw_rad: Any) -> Any:
    """Points (..., 3) turned about the verticals through their roots (..., 3) by angles (..., 1). numpy or torch.

    Positive from +Z to +X, as a rotation vector along +Y turns.
    """
    if isinstance(points_m, np.ndarray):
        cosine, sine, join = np.cos(yaw_rad), np.sin(yaw_rad), np.concatenate
    else:
        import torch

        cosine, sine, join = torch.cos(yaw_rad), torch.sin(yaw_rad), torch.cat
    from_root_m = points_m - root_m
    x, y, z = from_root_m[..., :1], from_root_m[..., 1:2], from_root_m[..., 2:]
    return root_m + join([cosine * x + sine * z, y, cosine * z - sine * x], -1)
