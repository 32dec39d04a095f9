"""Who touches what."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ConfigDict, FiniteFloat, NonNegativeInt

from video2anim.types.checks import Checked

FLOOR = "floor"
"""Label and surface of the floor, which is no object."""


@dataclass(frozen=True, slots=True)
class Contact(Checked):
    """A part of a body on one surface for a while: an edge of the contact graph."""

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    person_id: NonNegativeInt
    body_part: str
    """`seat`, `back`, `left hand`, `right foot`, `head`, `left shin`..."""
    object_id: NonNegativeInt | None
    """None for the floor."""
    label: str
    """Of the object, or `floor`."""
    surface: str
    """`seat`, `back`, `arm side`...: the part of the object, with `top`, `side` or `underside` where that does not go
    without saying; `top`, `side` or `underside` alone of objects without parts; `floor`."""
    start_s: FiniteFloat
    """Time of the first frame."""
    end_s: FiniteFloat
    """Time of the last frame."""
    mean_distance_m: FiniteFloat
    """Mean over the frames of the skin's distance from the surface where it is nearest or deepest: a gap is positive, a
    depth negative."""
    largest_distance_m: FiniteFloat
    """That of the frame in which it is farthest from 0."""
