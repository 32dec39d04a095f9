"""AMASS-style npz (Mahmood et al. 2019): SMPL-H pose vectors that motion datasets and their loaders use.

AMASS is +Z up, so root orientation and translation are turned by +90 degrees about X: (x, y, z) -> (x, -z, y).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from video2anim.export.frames import ZUP_FROM_YUP
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.types import BodyMotion

SMPLH_JOINTS = 52
BETAS = 16
NOTE = (
    "betas are zero because no SMPL shape was estimated (see shape_*); hands are at rest; trans is the pelvis "
    "joint: subtract the rest pelvis of your SMPL-H body from it; rows with valid == False are not measured"
)


def write_amass(path: Path, motion: BodyMotion) -> None:
    """Write one person's motion.

    Keys: `poses` (T, 156) axis-angle in radians, `trans` (T, 3) metres, `betas` (16,) zeros, `gender`,
    `mocap_framerate`; beside AMASS's own: `valid`, `joints_m` (T, 22, 3) +Z up, `betas_estimated`, `shape_model`,
    `shape_names`, `shape_values`, `note`.
    """
    R_zup_root = ZUP_FROM_YUP @ motion.R_parent_joint[:, 0]
    body = axis_angle_from_matrix(motion.R_parent_joint[:, 1:]).reshape(motion.frame_count, -1)
    poses = np.zeros((motion.frame_count, 3 * SMPLH_JOINTS))
    poses[:, :3] = axis_angle_from_matrix(R_zup_root)
    poses[:, 3 : 3 + body.shape[1]] = body
    pelvis_m = motion.T_world_root[:, :3, 3] + motion.rest_joints_m[0]
    names = sorted(motion.shape.parameters)
    np.savez_compressed(
        path,
        poses=poses,
        trans=pelvis_m @ ZUP_FROM_YUP.T,
        betas=np.zeros(BETAS),
        gender=np.array("neutral"),
        mocap_framerate=np.array(_fps(motion)),
        valid=motion.valid,
        joints_m=motion.joints_world_m @ ZUP_FROM_YUP.T,
        betas_estimated=np.array(False),
        shape_model=np.array(motion.shape.model),
        shape_names=np.array(names, dtype=np.str_),
        shape_values=np.array([motion.shape.parameters[name] for name in names], dtype=np.float64),
        note=np.array(NOTE),
    )


def _fps(motion: BodyMotion) -> float:
    if motion.frame_count < 2:
        return 30.0
    return float(np.round((motion.frame_count - 1) / (motion.frame_time_s[-1] - motion.frame_time_s[0]), 3))
