"""How the fields of a typed value lie on disk, said beside the field."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any


class Storage(StrEnum):
    """Form of a field inside a stage folder."""

    ARRAY = "array"
    """In the value's `.npz` (default for arrays)."""
    IMAGE = "image"
    """Its own PNG: uint8 RGB (H, W, 3), uint8 gray (H, W) or bool mask (H, W) as 0/255."""


def stored(storage: Storage) -> Any:
    """Dataclass field that is stored in the given form."""
    return field(metadata={"storage": storage})


@dataclass(frozen=True, slots=True)
class PayloadFile:
    """A file that belongs to a stage folder as it is (a video, a GLB)."""

    path: Path
    """Absolute once read or made; stored by name, relative to the stage folder."""
