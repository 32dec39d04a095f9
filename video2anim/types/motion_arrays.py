"""The arrays of `motion.npz` (keys: docs/scene_folder.md), for all writers of such files."""

from __future__ import annotations

from typing import Any

import numpy as np

from video2anim.types.motion import BodyMotion
from video2anim.types.skeleton import JOINT_NAMES, PARENTS


def motion_arrays(motion: BodyMotion) -> dict[str, Any]:
    """Arrays by key. `joints_camera_m` is derived from the others."""
    k = motion.intrinsics
    return {
        "joint_names": np.array(JOINT_NAMES),
        "parents": PARENTS,
        "frame_time_s": motion.frame_time_s,
        "valid": motion.valid,
        "T_world_root": motion.T_world_root,
        "R_parent_joint": motion.R_parent_joint,
        "joints_world_m": motion.joints_world_m,
        "joints_camera_m": motion.joints_camera_m,
        "T_world_camera": motion.T_world_camera,
        "intrinsics": np.array([k.fx_px, k.fy_px, k.cx_px, k.cy_px, k.width_px, k.height_px]),
        "contact": motion.contact,
        "shape_model": np.array(motion.shape.model),
        "shape_names": np.array(list(motion.shape.parameters)),
        "shape_values": np.array(list(motion.shape.parameters.values()), dtype=np.float64),
        "rest_joints_m": motion.rest_joints_m,
        "person_id": np.array(motion.person_id),
    }
