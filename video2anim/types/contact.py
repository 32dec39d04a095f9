"""Contacts between body parts and surfaces."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ConfigDict, FiniteFloat, NonNegativeInt

from video2anim.types.checks import Checked

FLOOR = "floor"
"""Label and surface of the floor, which is no object."""


@dataclass(frozen=True, slots=True)
class Contact(Checked):
    """Contact of a body part with one surface over a range of frames: an edge of the contact graph."""

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    person_id: NonNegativeInt
    body_part: str
    """`seat`, `back`, `left hand`, `right foot`, `head`, `left shin`..."""
    object_id: NonNegativeInt | None
    """None for the floor."""
    label: str
    """Label of the object, or `floor`."""
    surface: str
    """The part of the object, followed by `top`, `side` or `underside` unless it is the usual one (`seat`, `back`, `arm
    side`...); only `top`, `side` or `underside` for objects without parts; or `floor`."""
    start_s: FiniteFloat
    """Time of the first frame."""
    end_s: FiniteFloat
    """Time of the last frame."""
    mean_distance_m: FiniteFloat
    """Mean over the frames of the signed distance of the nearest (or deepest) skin to the surface: gaps are positive,
    penetrations negative."""
    largest_distance_m: FiniteFloat
    """This signed distance in the frame in which its absolute value is largest."""
