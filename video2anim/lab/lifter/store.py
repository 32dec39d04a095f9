"""Dataclasses of arrays in a folder, whole or absent, memory-mapped when read."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from video2anim.artifacts.folder import atomic_directory

_KEY = "key.json"
_Arrays = TypeVar("_Arrays")


def keep(value: Any, folder: Path, key: dict[str, Any]) -> None:
    """Write the arrays; a folder that is there is replaced when the new one is whole.

    Args:
        key: what the arrays were made from.
    """
    with atomic_directory(folder) as aside:
        for field in fields(value):
            np.save(aside / f"{field.name}.npy", getattr(value, field.name), allow_pickle=False)
        (aside / _KEY).write_text(json.dumps(key) + "\n")


def kept(folder: Path, key: dict[str, Any]) -> bool:
    """Whether the folder holds arrays made from just this."""
    path = folder / _KEY
    return path.is_file() and json.loads(path.read_text()) == key


def mapped(kind: type[_Arrays], folder: Path) -> _Arrays:
    """The kept arrays, memory-mapped."""
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    return kind(*(np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in names))
