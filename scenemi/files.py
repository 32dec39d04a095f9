"""Files of the command line: keyframes, scenes, motions, tables of numbers."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from scenemi.keyframes import FPS, Keyframes, checked_keyframes
from scenemi.scene_field import ScenePart, expect_scene
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.skeleton import JOINT_NAMES, PARENTS, forward_kinematics
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.motion import BodyShape

KEYFRAME_SUFFIXES = (".npz", ".json", ".bvh")
SCENE_SUFFIXES = (".glb", ".gltf", ".ply", ".obj", ".stl", ".npz")
_NOMINAL_CAMERA_M = (0.0, 1.2, -4.0)
"""Where the camera of a motion without one is said to stand; it looks along +Z."""
_NOMINAL_INTRINSICS = (600.0, 600.0, 319.5, 239.5, 640.0, 480.0)


def read_keyframes(path: Path, *, interval: int = 15, length: int | None = None) -> Keyframes:
    """Keyframes from `.npz` or `.json` (docs/scenemi.md), or taken at an interval from a whole motion.

    A file with `frame_index` says itself where its poses stand. A `motion.npz` and a `.bvh` hold a pose for every
    frame, of which every `interval`-th is taken. Poses without `frame_index` are `interval` frames apart.

    Args:
        path: the file.
        interval: frames between keyframes, where the file does not say it.
        length: how much of a whole motion is used.

    Raises:
        InputError: one line about what is wrong with the file.
    """
    if path.suffix.lower() not in KEYFRAME_SUFFIXES:
        raise InputError(f"{path}: want keyframes as {', '.join(KEYFRAME_SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such keyframe file")
    if path.suffix.lower() == ".bvh":
        return _from_bvh(path).every(interval, length)
    values = _npz(path) if path.suffix.lower() == ".npz" else _json(path)
    whole = "frame_index" not in values and ("T_world_root" in values or "frame_time_s" in values)
    found = _from_arrays(path, values, 1 if whole else interval)
    return found.every(interval, length) if whole else found


def _from_arrays(path: Path, values: Mapping[str, Any], interval: int) -> Keyframes:
    if "R_parent_joint" in values:
        R_parent_joint = _array(path, values, "R_parent_joint")
    elif "axis_angle" in values:
        axis_angle = _array(path, values, "axis_angle")
        if axis_angle.ndim != 3 or axis_angle.shape[1:] != (len(JOINT_NAMES), 3):
            raise InputError(f"{path}: axis_angle wants shape (K, {len(JOINT_NAMES)}, 3), got {axis_angle.shape}")
        R_parent_joint = matrix_from_axis_angle(axis_angle)
    else:
        raise InputError(f"{path}: want R_parent_joint (K, 22, 3, 3) or axis_angle (K, 22, 3), got {sorted(values)}")
    if "translation_m" in values:
        translation_m = _array(path, values, "translation_m")
    elif "T_world_root" in values:
        translation_m = _array(path, values, "T_world_root")[..., :3, 3]
    else:
        raise InputError(f"{path}: want translation_m (K, 3), got {sorted(values)}")
    if "fps" in values and abs(float(values["fps"]) - FPS) > 1e-3:
        raise InputError(f"{path}: want keyframes counted at {FPS:.0f} fps, got {float(values['fps']):g}")
    shape = _shape(path, values)
    rest_m = _array(path, values, "rest_joints_m") if "rest_joints_m" in values else shaped_body(shape).rest_joints_m
    given = "frame_index" in values
    frames = _array(path, values, "frame_index") if given else interval * np.arange(len(translation_m))
    if "valid" in values and len(values["valid"]) == len(frames):
        kept = _array(path, values, "valid").astype(bool)
        frames, R_parent_joint, translation_m = frames[kept], R_parent_joint[kept], translation_m[kept]
    return checked_keyframes(str(path), frames, R_parent_joint, translation_m, rest_m, shape)


def _shape(path: Path, values: Mapping[str, Any]) -> BodyShape:
    if "shape_model" not in values:
        return BodyShape("anny", dict(ADULT))
    model = str(values["shape_model"])
    names, numbers = values.get("shape_names", ()), values.get("shape_values", ())
    if len(names) != len(numbers):
        raise InputError(f"{path}: shape_names and shape_values want the same length, got {len(names)}, {len(numbers)}")
    return BodyShape(model, {str(name): float(value) for name, value in zip(names, numbers, strict=True)})


def _from_bvh(path: Path) -> Keyframes:
    from scenemi.data.bvh import read_bvh
    from scenemi.data.retarget import retarget

    shape = BodyShape("anny", dict(ADULT))
    body = shaped_body(shape)
    # The file's floor is kept: the scene is in the same world.
    motion = retarget(read_bvh(path, keep_floor=True), body)
    frames = np.arange(len(motion.translation_m))
    return checked_keyframes(str(path), frames, motion.R_parent_joint, motion.translation_m, body.rest_joints_m, shape)


def read_mapping(path: Path) -> dict[str, str]:
    """Names of joints from a JSON object, SMPL joint to joint of the file.

    Raises:
        InputError: not such an object.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such mapping file")
    values = _json(path)
    if not all(isinstance(value, str) for value in values.values()):
        raise InputError(f"{path}: want SMPL joint names with the names of the file's joints")
    return values


def read_scene(path: Path) -> tuple[ScenePart, ...]:
    """A scene in the world frame (+Y up, metres): all meshes and points of a file.

    An `.npz` holds `vertices_m` and `faces`, or `points_m`.

    Raises:
        InputError: the file is missing, cannot be read, or has no geometry.
    """
    if path.suffix.lower() not in SCENE_SUFFIXES:
        raise InputError(f"{path}: want a scene as {', '.join(SCENE_SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such scene file")
    if path.suffix.lower() == ".npz":
        values = _npz(path)
        name = next((key for key in ("vertices_m", "points_m") if key in values), None)
        if name is None:
            raise InputError(f"{path}: want vertices_m and faces, or points_m, got {sorted(values)}")
        faces = np.asarray(values.get("faces", np.zeros((0, 3))), np.int64)
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise InputError(f"{path}: faces wants shape (F, 3), got {faces.shape}")
        points_m = np.asarray(_array(path, values, name), np.float64)
        return expect_scene(str(path), (ScenePart(points_m, faces),))
    return expect_scene(str(path), _mesh_file(path))


def _mesh_file(path: Path) -> tuple[ScenePart, ...]:
    import trimesh

    try:
        loaded = trimesh.load_scene(path)
    except Exception as error:  # each format's reader raises classes of its own
        raise InputError(f"{path}: cannot be read as a scene: {' '.join(str(error).split())[:200]}") from error
    parts = []
    for found in loaded.dump():
        vertices_m = np.asarray(getattr(found, "vertices", np.zeros((0, 3))), np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(found, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3)
        parts.append(ScenePart(vertices_m, faces))
    return tuple(parts)


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
    parameters = keyframes.shape.parameters
    _replace(
        path,
        lambda stream: np.savez(
            stream,
            allow_pickle=False,
            joint_names=np.array(JOINT_NAMES),
            parents=PARENTS,
            frame_time_s=np.arange(frames) / FPS,
            valid=np.ones(frames, bool),
            T_world_root=T_world_root,
            R_parent_joint=R_parent_joint,
            joints_world_m=joints_m,
            joints_camera_m=(joints_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3],
            T_world_camera=np.tile(T_world_camera, (frames, 1, 1)),
            intrinsics=np.array(_NOMINAL_INTRINSICS),
            camera_is_nominal=np.array(True),
            contact=contact,
            is_keyframe=is_keyframe,
            shape_model=np.array(keyframes.shape.model),
            shape_names=np.array(list(parameters)),
            shape_values=np.array(list(parameters.values()), np.float64),
            rest_joints_m=keyframes.rest_joints_m,
            person_id=np.array(0),
        ),
    )


def write_json(path: Path, values: Any) -> None:
    """Numbers as JSON; NaN becomes null. Written aside and renamed."""
    text = json.dumps(_plain(values), indent=1, allow_nan=False) + "\n"
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


def file_digest(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def expect_writable(path: Path) -> None:
    """Refuse before the work what could not be written after it.

    Raises:
        InputError: the folder is absent or may not be written, or the path is a folder.
    """
    folder = path.absolute().parent
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
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


def _array(path: Path, values: Mapping[str, Any], name: str) -> np.ndarray:
    try:
        found = np.asarray(values[name])
        return found if found.dtype.kind in "biuf" else found.astype(np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: {name} wants numbers in rows of equal length: {error}") from error


def _npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as stream:
            members = np.load(stream, allow_pickle=False)
            if not isinstance(members, np.lib.npyio.NpzFile):
                raise InputError(f"{path}: a single array, want an archive (.npz)")
            return {name: members[name] for name in members.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(f"{path}: cannot be read as .npz: {' '.join(str(error).split())}") from error


def _json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: want a JSON object, got {type(values).__name__}")
    return values
