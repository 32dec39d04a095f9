"""Output of networks of slot `segment`: a class for each pixel, and instances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, UInt8

CLASSES = ("other", "floor", "wall", "ceiling", "furniture", "person")
"""Scene classes; a pixel's class number is the index in this tuple."""


MIN_INSTANCE_RATIO = 0.003
"""Smallest share of the image that a person or a piece of furniture covers: as the scene network was trained."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenInstance:
    """One object or person in a picture."""

    label: str
    """Class name in the network's own vocabulary, such as `chair`; `furniture` where it has no finer one."""
    kind: str
    """`furniture` or `person`."""
    score: float
    """0 to 1."""
    mask: Bool[np.ndarray, "height width"]


@dataclass(frozen=True, slots=True, eq=False)
class Segmentation:
    """One picture, segmented, at its own size."""

    semantic: UInt8[np.ndarray, "height width"]
    """Index into `CLASSES`."""
    instances: tuple[SeenInstance, ...]
    """Best score first."""


@runtime_checkable
class SegmentModel(Protocol):
    """A network in slot `segment`."""

    def segment(self, image: UInt8[np.ndarray, "height width 3"]) -> Segmentation:
        """Classes and instances of a picture, at its own size."""
        ...
