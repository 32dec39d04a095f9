"""Joint indices of the legs."""

from __future__ import annotations

from dataclasses import dataclass

from video2anim.types.skeleton import JOINT_INDEX


@dataclass(frozen=True, slots=True)
class Leg:
    """Joint indices of one leg."""

    hip: int
    knee: int
    ankle: int
    toe: int


LEGS: tuple[Leg, ...] = tuple(
    Leg(*(JOINT_INDEX[f"{side}_{joint}"] for joint in ("hip", "knee", "ankle", "foot"))) for side in ("left", "right")
)
