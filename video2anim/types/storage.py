"""File formats of the fields of a typed value, and marks for their checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any


class Storage(StrEnum):
    """File format of a field in a stage folder, if it is not an array in the value's `.npz`."""

    IMAGE = "image"
    """Its own PNG: uint8 RGB (H, W, 3), uint8 gray (H, W) or bool mask (H, W) as 0/255."""


class Holds(StrEnum):
    """Constraint on the values of an array or mesh, as a mark in its annotation: `Annotated[Float[...], Holds.RIGID]`.

    Readers reject files that violate it. Numbers are finite unless the mark is `GAPS`.
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
    """Mark of a tuple: as many items as another field of the same value; it may be empty if it has a default."""

    field: str


@dataclass(frozen=True, slots=True)
class IdsOf:
    """Mark of a tuple of IDs: each is the `person_id` of an item of another field."""

    field: str


def stored(storage: Storage) -> Any:
    """Dataclass field that is stored in the given format."""
    return field(metadata={"storage": storage})


@dataclass(frozen=True, slots=True)
class PayloadFile:
    """A file that is part of a stage folder, such as a video or a GLB."""

    path: Path
    """Absolute path in memory; stored as a name relative to the stage folder."""
