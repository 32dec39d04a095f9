"""Typed values to and from a folder that a person can open.

Scalars and structure go to `value.json`; numbers to `arrays.npz`; masks and bytes, compressed, to `masks.npz`;
images to PNG; meshes to PLY; motions of `people` to `motion.npz` / `motion_<id>.npz`,
of other fields to files of the field's name; payload files stay as they are.

The types are the schema: `value.json` is checked whole before any other file is opened, then each file that it names
is held against the annotation of its field.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import typing
from collections import ChainMap
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, create_model

from video2anim.artifacts.arrays import CLIP_AXES, Archive, Axes, opened_archive
from video2anim.artifacts.images import read_png, write_png
from video2anim.artifacts.meshes import read_ply, write_ply
from video2anim.artifacts.motion_io import read_motion, write_motion
from video2anim.artifacts.stage_files import ARRAYS_NPZ, MASKS_NPZ, VALUE_JSON, member, read_json, shown
from video2anim.errors import ArtifactError
from video2anim.types.checks import annotation, count_fault, ids_fault, is_array
from video2anim.types.clip import VideoClip
from video2anim.types.motion import BodyMotion
from video2anim.types.scene import Mesh
from video2anim.types.storage import Holds, IdsOf, OnePer, PayloadFile, Storage

_STRICT = ConfigDict(strict=True, extra="forbid", frozen=True)


class _Writer:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.arrays: dict[str, np.ndarray] = {}
        self.masks: dict[str, np.ndarray] = {}

    def encode(self, value: Any, key: str, storage: Storage | None) -> Any:
        if isinstance(value, np.ndarray):
            return self._array(value, key, storage)
        if isinstance(value, PayloadFile):
            return {"$file": value.path.resolve().relative_to(self.folder.resolve()).as_posix()}
        if isinstance(value, BodyMotion):
            field, _, number = key.rpartition(".")
            stem = "motion" if field.endswith("people") else field
            name = f"{stem}.npz" if number == "0" else f"{stem}_{value.person_id}.npz"
            write_motion(self.folder / name, value)
            return {"$motion": name}
        if isinstance(value, Mesh):
            write_ply(self.folder / f"{key}.ply", value)
            return {"$mesh": f"{key}.ply"}
        if dataclasses.is_dataclass(value):
            return {
                f.name: self.encode(getattr(value, f.name), f"{key}.{f.name}".lstrip("."), f.metadata.get("storage"))
                for f in dataclasses.fields(value)
            }
        if isinstance(value, tuple | list):
            return [self.encode(item, f"{key}.{i}", None) for i, item in enumerate(value)]
        if isinstance(value, dict):
            return {str(k): self.encode(v, f"{key}.{k}", None) for k, v in value.items()}
        if isinstance(value, np.generic):
            return value.item()
        if value is None or isinstance(value, str | int | float | bool):
            return value
        raise TypeError(f"{key}: no form on disk for {type(value).__name__}")

    def _array(self, value: np.ndarray, key: str, storage: Storage | None) -> dict[str, str]:
        if storage is Storage.IMAGE:
            write_png(self.folder / f"{key}.png", value)
            return {"$image": f"{key}.png", "dtype": str(value.dtype)}
        kept = self.masks if value.dtype in (np.bool_, np.uint8) else self.arrays
        kept[key] = value
        return {"$array": key}


def write_value(value: Any, folder: Path) -> None:
    """Write a dataclass into an existing folder."""
    writer = _Writer(folder)
    encoded = writer.encode(value, "", None)
    if writer.arrays:
        np.savez(folder / ARRAYS_NPZ, allow_pickle=False, **typing.cast("dict[str, Any]", writer.arrays))
    if writer.masks:
        np.savez_compressed(folder / MASKS_NPZ, allow_pickle=False, **typing.cast("dict[str, Any]", writer.masks))
    (folder / VALUE_JSON).write_text(json.dumps(encoded, indent=1, allow_nan=True) + "\n")


class _Array(BaseModel):
    model_config = _STRICT
    name: str = Field(alias="$array")


class _Image(BaseModel):
    model_config = _STRICT
    name: str = Field(alias="$image")
    dtype: typing.Literal["bool", "uint8"]


class _File(BaseModel):
    model_config = _STRICT
    name: str = Field(alias="$file")


class _Motion(BaseModel):
    model_config = _STRICT
    name: str = Field(alias="$motion")


class _Mesh(BaseModel):
    model_config = _STRICT
    name: str = Field(alias="$mesh")


_FORMS: dict[Any, Any] = {PayloadFile: _File, BodyMotion: _Motion, Mesh: _Mesh}


@functools.cache
def _model(kind: type) -> type[BaseModel]:
    """What `value.json` of a dataclass must look like: its fields, with references to what other files hold."""
    hints = typing.get_type_hints(kind, include_extras=True)
    fields: dict[str, Any] = {}
    for f in dataclasses.fields(kind):
        form = _Image if f.metadata.get("storage") is Storage.IMAGE else _form(hints[f.name])
        fields[f.name] = (form, ... if f.default is dataclasses.MISSING else f.default)
    return create_model(kind.__name__, __config__=_STRICT, **fields)


def _form(hint: Any) -> Any:
    plain, _ = annotation(hint)
    if is_array(plain):
        return _Array
    if plain in _FORMS:
        return _FORMS[plain]
    if dataclasses.is_dataclass(plain):
        return _model(typing.cast("type", plain))
    if typing.get_origin(plain) is tuple:
        return tuple[tuple(item if item is Ellipsis else _form(item) for item in typing.get_args(plain))]  # type: ignore[misc]
    return hint


class _Reader:
    """Fetches what a checked `value.json` refers to."""

    def __init__(self, folder: Path, archives: list[Archive], axes: Axes) -> None:
        self._folder, self._archives, self._axes = folder, archives, axes

    def value(self, form: Any, hint: Any, axes: Axes) -> Any:
        """The value of a field.

        Args:
            form: as it stands in `value.json`.
            hint: its type.
            axes: named lengths of the dataclass that the field belongs to.
        """
        plain, marks = annotation(hint)
        match form:
            case _Array():
                if not self._archives:
                    raise ArtifactError(f"want {ARRAYS_NPZ} with {shown(form.name)}, found none in {self._folder}")
                archive = next((archive for archive in self._archives if form.name in archive), self._archives[0])
                return archive.read(form.name, hint, axes)
            case _Image():
                return read_png(member(self._folder, form.name), np.dtype(form.dtype), hint=hint, axes=axes)
            case _File():
                return PayloadFile(member(self._folder, form.name))
            case _Motion():
                return read_motion(member(self._folder, form.name), axes=self._axes)
            case _Mesh():
                return read_ply(member(self._folder, form.name), empty=Holds.SOMETHING not in marks)
            case BaseModel():
                return self._dataclass(form, plain)
            case tuple():
                kinds = typing.get_args(plain)
                kinds = kinds[:1] * len(form) if kinds[1:] == (Ellipsis,) else kinds
                return tuple(self.value(item, kind, self._scope()) for item, kind in zip(form, kinds, strict=True))
        return form

    def _scope(self) -> Axes:
        """Names of axes of one dataclass: those of the clip are shared, others are its own."""
        return _Scope({}, self._axes)

    def _dataclass(self, form: BaseModel, kind: type) -> Any:
        hints, axes = typing.get_type_hints(kind, include_extras=True), self._scope()
        found = {name: self.value(getattr(form, name), hints[name], axes) for name in type(form).model_fields}
        for name, hint in hints.items():
            for mark in annotation(hint)[1]:
                self._expect_counterparts(kind, name, mark, found)
        try:
            return kind(**found)
        except ValueError as error:
            raise ArtifactError(f"{error} in {self._folder}") from error

    def _expect_counterparts(self, kind: type, name: str, mark: Any, found: dict[str, Any]) -> None:
        """What one field must have in common with another."""
        if isinstance(mark, OnePer):
            fault = count_fault(kind, name, mark, len(found[name]), len(found[mark.field]))
        elif isinstance(mark, IdsOf):
            fault = ids_fault(found[mark.field], found[name])
        else:
            return
        if fault is not None:
            raise ArtifactError(f"{name}: {shown(fault)} in {self._folder}")


class _Scope(ChainMap[str, int]):
    """Axes of one dataclass over those of the clip."""

    def __setitem__(self, name: str, length: int) -> None:
        self.maps[1 if name in CLIP_AXES else 0][name] = length


def read_value(kind: type, folder: Path, clip: VideoClip | None = None) -> Any:
    """Read a dataclass of the given type from a stage folder. Edited files are taken where they are sound.

    Args:
        kind: the type that the stage makes.
        folder: of the stage.
        clip: the clip whose number of frames and size the value must have; without it they only must agree.

    Raises:
        ArtifactError: a file is missing, damaged, outside the folder, or does not fit the type.
    """
    axes: Axes = {}
    if clip is not None:
        axes |= {"frames": clip.frame_count, "height": clip.height_px, "width": clip.width_px}
    try:
        form = read_json(member(folder, VALUE_JSON), _model(kind))
        with ExitStack() as stack:
            names = [name for name in (ARRAYS_NPZ, MASKS_NPZ) if (folder / name).exists()]
            archives = [stack.enter_context(opened_archive(member(folder, name))) for name in names]
            return _Reader(folder, archives, axes).value(form, kind, axes)
    except ArtifactError as error:
        stage = folder.name.split("_", 1)[-1]
        raise ArtifactError(
            f"{error}; mend it or make it again with `video2anim stage {folder.parent.parent} {stage} --discard-edits`"
        ) from error
