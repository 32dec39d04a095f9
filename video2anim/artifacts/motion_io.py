"""`motion.npz`: one person's motion, with the same keys in every stage that makes one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from video2anim.body.skeleton import JOINT_NAMES, PARENTS
from video2anim.errors import ArtifactError
from video2anim.types.camera import Intrinsics
from video2anim.types.motion import BodyMotion, BodyShape

_SHAPES = {
    "frame_time_s": (), "valid": (), "T_world_root": (4, 4), "R_parent_joint": (22, 3, 3),
    "T_world_camera": (4, 4), "contact": (22,), "joints_world_m": (22, 3),
}  # fmt: skip
"""Trailing axes of the arrays that have one row per frame."""


def motion_arrays(motion: BodyMotion) -> dict[str, np.ndarray]:
    """The arrays of a `motion.npz` (keys: docs/scene_folder.md)."""
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


def write_motion(path: Path, motion: BodyMotion) -> None:
    """Write a motion as `.npz`. Never pickled."""
    arrays = motion_arrays(motion)
    np.savez(path, allow_pickle=False, **arrays)


def read_motion(path: Path) -> BodyMotion:
    """Read a `motion.npz`.

    Raises:
        ArtifactError: the file is missing, unreadable, lacks a key, has a wrong shape or holds NaN.
    """
    try:
        # Opened here: where the archive is damaged, `np.load` would leave its own handle open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except (OSError, ValueError, EOFError, KeyError) as error:
        raise ArtifactError(f"motion file: want a readable .npz, got {error} at {path}") from error
    except Exception as error:  # zipfile and zlib raise classes of their own
        raise ArtifactError(f"motion file: damaged ({error}) at {path}") from error
    try:
        return _motion_from(arrays, path)
    except KeyError as error:
        raise ArtifactError(f"motion file: want key {error}, got {sorted(arrays)} at {path}") from error


def _motion_from(arrays: dict[str, np.ndarray], path: Path) -> BodyMotion:
    frames = len(arrays["frame_time_s"])
    for key, trailing in _SHAPES.items():
        if arrays[key].shape != (frames, *trailing):
            raise ArtifactError(f"{key}: want shape {(frames, *trailing)}, got {arrays[key].shape} in {path}")
        if arrays[key].dtype.kind == "f" and not np.isfinite(arrays[key]).all():
            raise ArtifactError(f"{key}: want finite numbers, got NaN or infinity in {path}")
    fx, fy, cx, cy, width, height = (float(x) for x in arrays["intrinsics"])
    names = [str(x) for x in arrays["shape_names"]]
    values = [float(x) for x in arrays["shape_values"]]
    return BodyMotion(
        person_id=int(arrays["person_id"]),
        frame_time_s=arrays["frame_time_s"],
        valid=arrays["valid"].astype(bool),
        T_world_root=arrays["T_world_root"],
        R_parent_joint=arrays["R_parent_joint"],
        T_world_camera=arrays["T_world_camera"],
        intrinsics=Intrinsics(fx, fy, cx, cy, round(width), round(height)),
        contact=arrays["contact"],
        shape=BodyShape(str(arrays["shape_model"]), dict(zip(names, values, strict=True))),
        rest_joints_m=arrays["rest_joints_m"],
        joints_world_m=arrays["joints_world_m"],
    )
