"""Keyframes from files: `.npz` and `.json` by one model, BVH and GLB."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from scenemi.data.keyframes import FPS, JOINTS, Keyframes, checked_keyframes
from scenemi.data.plain_files import Numbers, OneNumber, Text, Texts, checked, read_arrays, read_json, shaped
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError, UsageError, expect_file
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.motion import BodyShape

if TYPE_CHECKING:
    from scenemi.data.source_clip import SourceClip
    from video2anim.body.shaped_body import ShapedBody

KEYFRAME_SUFFIXES = (".npz", ".json", ".bvh", ".glb")


class KeyframeValues(BaseModel):
    """The keys that are read of a keyframe file (docs/scenemi.md) or a `motion.npz`; others are left alone."""

    model_config = ConfigDict(arbitrary_types_allowed=True, frozen=True)

    frame_index: Numbers | None = None
    R_parent_joint: Annotated[Numbers, shaped(None, None, 3, 3, letters="KJ")] | None = None
    axis_angle: Annotated[Numbers, shaped(None, JOINTS, 3)] | None = None
    translation_m: Numbers | None = None
    T_world_root: Annotated[Numbers, shaped(None, 4, 4)] | None = None
    """Its translation is that of a motion without `translation_m`."""
    rest_joints_m: Numbers | None = None
    frame_time_s: Numbers | None = None
    """A file with it holds a pose for every frame."""
    valid: Annotated[Numbers, shaped(None)] | None = None
    fps: OneNumber | None = None
    shape_model: Text | None = None
    shape_names: Texts = ()
    shape_values: Annotated[Numbers, shaped(None, letters="S")] | None = None

    @property
    def whole_motion(self) -> bool:
        """Whether every frame has a pose."""
        return self.frame_index is None and (self.T_world_root is not None or self.frame_time_s is not None)

    def given(self) -> list[str]:
        """Names of the keys that the file has."""
        return sorted(name for name in self.model_fields_set if getattr(self, name) is not None)


def read_keyframes(path: Path, *, interval: int = 15, length: int | None = None) -> Keyframes:
    """Keyframes from `.npz` or `.json` (docs/scenemi.md), or taken at an interval from a whole motion.

    A file with `frame_index` says itself where its poses stand. A `motion.npz` and a `.bvh` hold a pose for every
    frame, of which every `interval`-th is taken. So does a `.glb`, unless its animation has keys only at some times:
    then those are the keyframes, counted from the first. Poses without `frame_index` are `interval` frames apart.

    Args:
        path: the file.
        interval: frames between keyframes, where the file does not say it.
        length: how much of a whole motion is used.

    Raises:
        InputError: one line about what is wrong with the file.
    """
    suffix = path.suffix.lower()
    if suffix not in KEYFRAME_SUFFIXES:
        raise InputError(f"{path}: want keyframes as {', '.join(KEYFRAME_SUFFIXES)}")
    expect_file(path, "keyframe file")
    if suffix == ".bvh":
        return _from_bvh(path).every(interval, length)
    if suffix == ".glb":
        return _from_glb(path, interval, length)
    found: dict[str, Any] = (
        read_json(path, "keyframe file")
        if suffix == ".json"
        else {**read_arrays(path, tuple(KeyframeValues.model_fields), "keyframe file")}
    )
    values = checked(KeyframeValues, str(path), found)
    keyframes = _keyframes(str(path), values, 1 if values.whole_motion else interval)
    return keyframes.every(interval, length) if values.whole_motion else keyframes


def shape_in(path: Path) -> BodyShape:
    """The body that a `.json` file names; the average adult where it names none.

    Raises:
        InputError: one line about what is wrong with the file.
    """
    return _shape(str(path), checked(KeyframeValues, str(path), read_json(path, "keyframe file")))


def _keyframes(where: str, values: KeyframeValues, interval: int) -> Keyframes:
    if values.R_parent_joint is not None:
        R_parent_joint = values.R_parent_joint
    elif values.axis_angle is not None:
        with np.errstate(all="ignore"):  # what overflows is found below
            R_parent_joint = matrix_from_axis_angle(values.axis_angle.astype(np.float64))
    else:
        raise InputError(f"{where}: want R_parent_joint (K, 22, 3, 3) or axis_angle (K, 22, 3), got {values.given()}")
    translation_m = values.translation_m
    if translation_m is None and values.T_world_root is not None:
        translation_m = values.T_world_root[:, :3, 3]
    if translation_m is None:
        raise InputError(f"{where}: want translation_m (K, 3), got {values.given()}")
    if values.fps is not None and not abs(values.fps - FPS) <= 1e-3:
        raise InputError(f"{where}: want keyframes counted at {FPS:.0f} fps, got {values.fps:g}")
    shape = _shape(where, values)
    rest_m = _rest_joints_m(where, shape) if values.rest_joints_m is None else values.rest_joints_m
    frames = interval * np.arange(len(R_parent_joint)) if values.frame_index is None else values.frame_index
    return checked_keyframes(where, frames, R_parent_joint, translation_m, rest_m, shape, valid=values.valid)


def _shape(where: str, values: KeyframeValues) -> BodyShape:
    if values.shape_model is None:
        return BodyShape("anny", dict(ADULT))
    names = values.shape_names
    numbers = np.zeros(0) if values.shape_values is None else values.shape_values
    if len(names) != len(numbers) or not np.isfinite(numbers).all():
        raise InputError(
            f"{where}: shape_names and shape_values want the same length and finite numbers, "
            f"got {len(names)} and {len(numbers)}"
        )
    return BodyShape(values.shape_model, dict(zip(names, map(float, numbers), strict=True)))


def _rest_joints_m(where: str, shape: BodyShape) -> np.ndarray:
    try:
        return shaped_body(shape).rest_joints_m
    except UsageError as error:
        raise InputError(f"{where}: {error}; or give rest_joints_m (22, 3)") from error


def _from_bvh(path: Path) -> Keyframes:
    from scenemi.data.bvh import read_bvh

    # The file's floor is kept: the scene is in the same world.
    return _retargeted(path, read_bvh(path, keep_floor=True), shaped_body(BodyShape("anny", dict(ADULT))))


def _from_glb(path: Path, interval: int, length: int | None) -> Keyframes:
    from scenemi.data.gltf_motion import read_gltf_motion

    found = read_gltf_motion(path)
    motion = _retargeted(path, found.clip, found.body)
    return motion.at(found.key_frames) if len(found.key_frames) else motion.every(interval, length)


def _retargeted(path: Path, clip: SourceClip, body: ShapedBody) -> Keyframes:
    """A pose for every frame."""
    from scenemi.data.retarget import retarget

    motion = retarget(clip, body)
    frames = np.arange(len(motion.translation_m))
    shape, rest_m = body.shape, body.rest_joints_m
    return checked_keyframes(str(path), frames, motion.R_parent_joint, motion.translation_m, rest_m, shape)


def read_mapping(path: Path) -> dict[str, str]:
    """Names of joints from a JSON object, SMPL joint to joint of the file.

    Raises:
        InputError: not such an object.
    """
    values = read_json(path, "mapping file")
    if not all(isinstance(value, str) for value in values.values()):
        raise InputError(f"{path}: want SMPL joint names with the names of the file's joints")
    return values
