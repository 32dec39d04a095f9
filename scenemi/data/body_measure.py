"""Measures of a body for retargeting, computed once."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from scenemi.data.foot_mesh import PartHull, Sole, hull_of, sole_of
from scenemi.data.hinge_limb import LegBones
from video2anim.body.legs import LEGS
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.skeleton import FEET, JOINT_INDEX

_ELBOWS = (JOINT_INDEX["left_elbow"], JOINT_INDEX["right_elbow"])
_WRISTS = (JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"])


@dataclass(frozen=True, slots=True, eq=False)
class BodyMeasure:
    """Legs and the reach of the skin; pairs are left, right."""

    soles: tuple[Sole, Sole]
    legs: tuple[LegBones, LegBones]
    trunk: PartHull
    """All but feet, forearms and hands."""
    above_feet: PartHull
    hands: tuple[PartHull, PartHull]


@functools.lru_cache(maxsize=8)
def measure_body(body: ShapedBody) -> BodyMeasure:
    """Measure of a body; remembered for the last eight bodies."""
    left, right = LEGS
    above_feet = tuple(joint for joint in range(22) if joint not in FEET)
    return BodyMeasure(
        (sole_of(body, left), sole_of(body, right)),
        (LegBones.of(body.rest_joints_m, left), LegBones.of(body.rest_joints_m, right)),
        hull_of(body, tuple(joint for joint in above_feet if joint not in (*_ELBOWS, *_WRISTS))),
        hull_of(body, above_feet),
        (hull_of(body, _WRISTS[:1]), hull_of(body, _WRISTS[1:])),
    )
