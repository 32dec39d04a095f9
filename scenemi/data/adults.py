"""Adult bodies for training."""

from __future__ import annotations

import numpy as np

from video2anim.body.anny_body import ADULT, PEOPLES_LENGTHS
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
