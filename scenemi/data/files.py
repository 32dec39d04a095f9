"""Files that the command line writes: motions, tables of numbers; and tensors."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from scenemi.data.keyframes import FPS, Keyframes
from video2anim.errors import InputError
from video2anim.types import BodyMotion, Intrinsics
from video2anim.types.motion_arrays import motion_arrays
from video2anim.types.skeleton import forward_kinematics

_NOMINAL_CAMERA_M = (0.0, 1.2, -4.0)
"""Place of the camera that is written for a motion without one; it looks along +Z."""
_NOMINAL_INTRINSICS = Intrinsics.centered(600.0, 640, 480)
"""A usual lens, in pixels."""


def write_motion(
    path: Path,
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_m: Float[np.ndarray, "frames 3"],
    is_keyframe: Bool[np.ndarray, "frames"],
    contact: Float[np.ndarray, "frames 22"],
    keyframes: Keyframes,
) -> None:
    """A `motion.npz` with the keys of docs/scene_folder.md, and `is_keyframe`.

    There was no camera: the file says so (`camera_is_nominal`) and holds one that looks along +Z from 4 m behind the
    origin. The file is written aside and renamed.
    """
    joints_m, _ = forward_kinematics(R_parent_joint, translation_m, keyframes.rest_joints_m)
    frames = len(translation_m)
    T_world_root = np.tile(np.eye(4), (frames, 1, 1))
    T_world_root[:, :3, :3], T_world_root[:, :3, 3] = R_parent_joint[:, 0], translation_m
    T_world_camera = np.diag([-1.0, -1.0, 1.0, 1.0])
    T_world_camera[:3, 3] = _NOMINAL_CAMERA_M
    motion = BodyMotion(
        person_id=0, frame_time_s=np.arange(frames) / FPS, valid=np.ones(frames, bool), T_world_root=T_world_root,
        R_parent_joint=R_parent_joint, T_world_camera=np.tile(T_world_camera, (frames, 1, 1)),
        intrinsics=_NOMINAL_INTRINSICS, contact=contact, shape=keyframes.shape, rest_joints_m=keyframes.rest_joints_m,
        joints_world_m=joints_m,
    )  # fmt: skip
    arrays = motion_arrays(motion) | {"camera_is_nominal": np.array(True), "is_keyframe": is_keyframe}
    _replace(path, lambda stream: np.savez(stream, allow_pickle=False, **arrays))


def write_json(path: Path, values: Any) -> None:
    """Numbers as JSON; NaN becomes null. Written aside and renamed."""
    write_text(path, json.dumps(_plain(values), indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """A text file, written aside and renamed."""
    _replace(path, lambda stream: stream.write(text.encode()))


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Arrays and text of a safetensors file.

    Raises:
        InputError: missing or damaged.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"{path}: no such weights file")
    try:
        with safe_open(path, framework="np") as archive:
            return {name: archive.get_tensor(name) for name in archive.keys()}, dict(archive.metadata() or {})  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path}: damaged weights file: {error}") from error


def write_tensors(path: Path, tensors: Mapping[str, Any], header: Mapping[str, str]) -> None:
    """Tensors of torch and text as a safetensors file, written aside and renamed.

    Raises:
        InputError: the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save

    try:
        _replace(path, lambda stream: stream.write(save(dict(tensors), dict(header))))
    except SafetensorError as error:
        raise InputError(f"{path}: cannot be written: {error}") from error


def expect_writable(path: Path) -> None:
    """Refuse before the work what could not be written after it.

    Raises:
        InputError: the folder is absent or may not be written, or the path is a folder or device.
    """
    folder = path.absolute().parent
    if (path.exists() and not path.is_file()) or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"output: want a file in an existing folder that can be written, got {path}")


def _replace(path: Path, write: Any) -> None:
    aside = path.with_name(f".{path.name}.part")
    try:
        with aside.open("wb") as stream:
            write(stream)
        os.replace(aside, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        aside.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
