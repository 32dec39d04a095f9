"""Typed values to and from a folder that a person can open.

Scalars and structure go to `value.json`; numbers to `arrays.npz`; masks and bytes, compressed, to `masks.npz`;
images to PNG; meshes to PLY; motions to `motion.npz` / `motion_<id>.npz`; payload files stay as they are.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from pathlib import Path
from typing import Any

import numpy as np

from video2anim.artifacts.images import read_png, write_png
from video2anim.artifacts.meshes import read_ply, write_ply
from video2anim.artifacts.motion_io import read_motion, write_motion
from video2anim.errors import ArtifactError
from video2anim.types.motion import BodyMotion
from video2anim.types.scene import Mesh
from video2anim.types.storage import PayloadFile, Storage

_JSON, _ARRAYS, _MASKS = "value.json", "arrays.npz", "masks.npz"


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
            name = "motion.npz" if key.endswith("people.0") else f"motion_{value.person_id}.npz"
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
        np.savez(folder / _ARRAYS, allow_pickle=False, **typing.cast("dict[str, Any]", writer.arrays))
    if writer.masks:
        np.savez_compressed(folder / _MASKS, allow_pickle=False, **typing.cast("dict[str, Any]", writer.masks))
    (folder / _JSON).write_text(json.dumps(encoded, indent=1, allow_nan=True) + "\n")


class _Reader:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.arrays: dict[str, np.ndarray] = {}
        for name in (_ARRAYS, _MASKS):
            if (folder / name).exists():
                self.arrays |= _read_arrays(folder / name)

    def decode(self, data: Any, hint: Any) -> Any:
        if isinstance(data, dict) and "$array" in data:
            return self.arrays[data["$array"]]
        if isinstance(data, dict) and "$image" in data:
            return read_png(self.folder / data["$image"], np.dtype(data["dtype"]))
        if isinstance(data, dict) and "$file" in data:
            path = self.folder / data["$file"]
            if not path.is_file():
                raise FileNotFoundError(f"{path} is missing")
            return PayloadFile(path)
        if isinstance(data, dict) and "$motion" in data:
            return read_motion(self.folder / data["$motion"])
        if isinstance(data, dict) and "$mesh" in data:
            return read_ply(self.folder / data["$mesh"])
        if dataclasses.is_dataclass(hint):
            hints = typing.get_type_hints(hint)
            return hint(**{key: self.decode(item, hints[key]) for key, item in data.items()})  # type: ignore[operator]
        if typing.get_origin(hint) is tuple:
            kinds = typing.get_args(hint)
            if len(kinds) == 2 and kinds[1] is Ellipsis:
                return tuple(self.decode(item, kinds[0]) for item in data)
            return tuple(self.decode(item, kind) for item, kind in zip(data, kinds, strict=True))
        return data


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        # Opened here: where the archive is damaged, `np.load` would leave its own handle open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except Exception as error:  # zipfile and zlib raise classes of their own
        raise ValueError(f"{path.name} is damaged ({error})") from error


def _read_structure(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path.name} is damaged ({error})") from error


def read_value(kind: type, folder: Path) -> Any:
    """Read a dataclass of the given type from a stage folder.

    Raises:
        ArtifactError: a file is missing, damaged or does not fit the type.
    """
    stage = folder.name.split("_", 1)[-1]
    remedy = f"make it again with `video2anim stage {folder.parent.parent} {stage} --discard-edits`"
    try:
        return _Reader(folder).decode(_read_structure(folder / _JSON), kind)
    except ArtifactError as error:
        raise ArtifactError(f"{error}; {remedy}") from error
    except Exception as error:  # damaged zip, PNG, PLY and JSON raise many classes
        detail = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ArtifactError(
            f"stage folder: want a readable {kind.__name__}, got {detail} in {folder}; {remedy}"
        ) from error
