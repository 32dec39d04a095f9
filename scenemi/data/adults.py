"""Adult bodies: drawn for training, or as large as a skeleton."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from video2anim.body.anny_body import ADULT, PEOPLES_LENGTHS, anny_model, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.types import BodyShape

_RANGES = {
    "age": (0.6, 0.85),
    "muscle": (0.3, 0.75),
    "weight": (0.25, 0.75),
    "proportions": (0.35, 0.75),
}
"""Phenotypes of Anny."""
_HEIGHT = {"woman": (0.25, 0.6), "man": (0.15, 0.55)}
"""Statures from 1.5 to 1.95 m."""
_HEIGHTS = np.linspace(0.0, 1.0, 6)
"""Anny's heights of adults between which lengths are taken for linear: so they are to 2 mm."""


def draw_adults(count: int, seed: int = 0) -> tuple[BodyShape, ...]:
    """The middle adult, then women and men in turn, of varied build and limbs; a longer draw begins like a shorter one.

    Raises:
        ValueError: a count below 1.
    """
    if count < 1:
        raise ValueError(f"draw_adults: want a count of at least 1, got {count}")
    shapes = [BodyShape("anny", dict(ADULT))]
    for number in range(1, count):
        rng = np.random.default_rng([seed, number])
        woman = number % 2 == 1
        values = {"gender": rng.uniform(0.85, 1.0) if woman else rng.uniform(0.0, 0.15)}
        values["height"] = rng.uniform(*_HEIGHT["woman" if woman else "man"])
        values |= {name: rng.uniform(*span) for name, span in _RANGES.items()}
        values |= {name: np.clip(rng.normal(*spread), -1, 1) for name, spread in PEOPLES_LENGTHS.items()}
        shapes.append(BodyShape("anny", {**ADULT, **{name: round(float(v), 4) for name, v in values.items()}}))
    return tuple(shapes)


def adult_with(length_m: Callable[[Float[np.ndarray, "22 3"]], float], wanted_m: float) -> ShapedBody:
    """The average adult build of which a length of the skeleton (T-pose joints) is about as wanted, within what adults
    have."""
    lengths_m = [length_m(_rest_joints_m(float(height))) for height in _HEIGHTS]
    height = float(np.interp(wanted_m, lengths_m, _HEIGHTS))
    return shaped_body(BodyShape("anny", {**ADULT, "height": round(height, 2)}))


@functools.cache
def _rest_joints_m(height: float) -> Float[np.ndarray, "22 3"]:
    return anny_model().shaped(BodyShape("anny", {**ADULT, "height": height})).rest_joints_m
