"""Contacts between body parts and surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
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


@dataclass(frozen=True, slots=True, eq=False)
class RestedSkin:
    """Foremost skin of parts in the frames in which they rested."""

    point_m: Float[np.ndarray, "rests 3"]
    place: Int[np.ndarray, "rests"]
    """Number of the place where it rested."""
    bears: Bool[np.ndarray, "rests"]
    """Whether it is that of seat or feet, which rest neither on backs nor on arms."""
    ahead: Float[np.ndarray, "rests 3"]
    """Unit direction in which who sat there looked; zero for other parts."""

    @classmethod
    def nothing(cls) -> RestedSkin:
        return cls(np.zeros((0, 3)), np.zeros(0, int), np.zeros(0, bool), np.zeros((0, 3)))

    @classmethod
    def joined(cls, some: Sequence[RestedSkin]) -> RestedSkin:
        """All of some."""
        columns = (np.concatenate([getattr(one, name) for one in some]) for name in cls.__slots__)
        return cls(*columns)

    def only(self, chosen: Bool[np.ndarray, "rests"]) -> RestedSkin:
        """Some of them."""
        return RestedSkin(self.point_m[chosen], self.place[chosen], self.bears[chosen], self.ahead[chosen])

    def __len__(self) -> int:
        return len(self.point_m)
