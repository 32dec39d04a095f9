"""Stores dataclasses of arrays in a folder that is complete or absent, and reads them memory-mapped."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from video2anim.artifacts.folder import atomic_directory

_KEY = "key.json"
_Arrays = TypeVar("_Arrays")


def write_arrays(value: Any, folder: Path, key: dict[str, Any]) -> None:
    """Write the arrays of a dataclass. An existing folder is replaced once the new one is complete.

    Args:
        value: Dataclass of arrays.
        folder: Folder to write.
        key: What the arrays were made from.
    """
    with atomic_directory(folder) as aside:
        for field in fields(value):
            np.save(aside / f"{field.name}.npy", getattr(value, field.name), allow_pickle=False)
        (aside / _KEY).write_text(json.dumps(key) + "\n")


def has_arrays(folder: Path, key: dict[str, Any]) -> bool:
    """Whether the folder holds arrays with this key."""
    path = folder / _KEY
    return path.is_file() and json.loads(path.read_text()) == key


def read_arrays(kind: type[_Arrays], folder: Path) -> _Arrays:
    """The arrays of a folder as a dataclass of type `kind`, memory-mapped."""
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    return kind(*(np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in names))
