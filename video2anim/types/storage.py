"""How the fields of a typed value lie on disk, said beside the field."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any


class Storage(StrEnum):
    """Form of a field inside a stage folder, other than arrays in the value's `.npz`."""

    IMAGE = "image"
    """Its own PNG: uint8 RGB (H, W, 3), uint8 gray (H, W) or bool mask (H, W) as 0/255."""


class Holds(StrEnum):
    """What an array or mesh holds beyond its shape, said in its annotation: `Annotated[Float[...], Holds.RIGID]`.

    Readers refuse a file that does not. Numbers are finite unless `GAPS` is said.
    """

    GAPS = "numbers, NaN where nothing is known"
    ROTATION = "rotation matrices (orthonormal, determinant 1)"
    RIGID = "rigid transforms (a rotation, a translation within 10 km, last row 0 0 0 1)"
    DIRECTION = "vectors of length 1"
    RISING = "numbers that rise from row to row"
    FRAMES = "numbers of frames of the clip that rise from 0 or later"
    SHARES = "numbers from 0 to 1"
    FROM_ORIGIN = "the origin in the first row, points within 10 km"
    TEXT = "text"
    SOMETHING = "at least one pixel or triangle"


@dataclass(frozen=True, slots=True)
class OnePer:
    """Mark of a tuple: as many items as another field of the same value; none where it has a default."""

    field: str


@dataclass(frozen=True, slots=True)
class IdsOf:
    """Mark of a tuple of numbers: each is the `person_id` of an item of another field."""

    field: str


def stored(storage: Storage) -> Any:
    """Dataclass field that is stored in the given form."""
    return field(metadata={"storage": storage})


@dataclass(frozen=True, slots=True)
class PayloadFile:
    """A file that belongs to a stage folder as it is (a video, a GLB)."""

    path: Path
    """Absolute once read or made; stored by name, relative to the stage folder."""
