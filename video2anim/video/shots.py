"""Detection of cuts (hard changes from one shot to another) in a stream of frames.

Several images on both sides of a boundary are compared: every one before must differ from every one after, so a single
dark, bright or damaged image is no cut. In a pan or fast motion neighbors differ too, so the difference across the
boundary must exceed those on both sides. Dissolves and fades are not detected.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, UInt8

THUMBNAIL_SIDE_PX = 96
"""Long side of the pictures that `ShotDetector` is given."""
_SIDE_FRAMES = 6
"""Images compared on each side of a boundary; a flash of fewer is never a cut."""
_CUT_DISTANCE = 0.30
"""Smallest distance (0 to 1) between the sides of a cut."""
_MIN_CONTRAST = 2.5
"""Least ratio of the distance across a cut to the median distance of neighbors."""
_DETAIL_FLOOR = 0.01
"""Root mean square of log luminance detail below which a picture counts as blank."""
_BINS = (8, 17, 17)
"""Bins of relative luminance, a and b."""
_GRID = (32, 18)
"""Cells of the low-resolution structure."""


@dataclass(frozen=True, slots=True)
class Descriptor:
    """Appearance of an image, nearly independent of exposure."""

    structure: Float[np.ndarray, "cells"]
    """Log luminance on a coarse grid, slow shading removed, zero mean, unit norm (less for a blank picture)."""
    colors: Float[np.ndarray, "bins"]
    """Square root of the histogram of chromaticity and relative luminance; unit norm."""


def describe(thumbnail_rgb: UInt8[np.ndarray, "height width 3"]) -> Descriptor:
    """Descriptor of a small picture."""
    lab = cv2.cvtColor(thumbnail_rgb, cv2.COLOR_RGB2LAB)
    grid = cv2.resize(lab[..., 0], _GRID, interpolation=cv2.INTER_AREA).astype(np.float32)
    # Differences of log luminance do not change with gain; the wide blur removes glare and vignettes.
    log_luminance = np.log(grid + 8.0)
    detail = log_luminance - cv2.GaussianBlur(log_luminance, (0, 0), 4.0)
    detail -= detail.mean()
    # Where there is less detail than noise, the structure is small instead of amplified noise.
    structure = detail.ravel() / max(float(np.linalg.norm(detail)), _DETAIL_FLOOR * np.sqrt(detail.size))
    median = max(float(np.median(lab[..., 0])), 1.0)
    # The median luminance and gray are in the middle of their bins, where noise does not move them to another.
    relative = np.clip(lab[..., 0] / median * 64.0 + 16.0, 0, 255).astype(np.uint8)
    stacked = np.dstack([relative, lab[..., 1:]])
    histogram = cv2.calcHist([stacked], [0, 1, 2], None, list(_BINS), [0, 256, 60, 196, 60, 196])
    for axis in range(3):
        histogram = _softened(histogram, axis)
    histogram = histogram.ravel()
    return Descriptor(structure, np.sqrt(histogram / max(float(histogram.sum()), 1e-9)))


def _softened(histogram: Float[np.ndarray, "luminance a b"], axis: int) -> Float[np.ndarray, "luminance a b"]:
    """Each bin shared with its neighbors along one axis (1/4, 1/2, 1/4; the ends keep their part)."""
    first, last = histogram.take([0], axis), histogram.take([-1], axis)
    padded = np.concatenate([first, histogram, last], axis)
    count = histogram.shape[axis]
    before, after = padded.take(range(count), axis), padded.take(range(2, count + 2), axis)
    return 0.5 * histogram + 0.25 * (before + after)


def distance(a: Descriptor, b: Descriptor) -> float:
    """Appearance distance of two images, 0 (same) to 1: mean of the distances of structure and color."""
    structure = 0.5 * float(np.sum((a.structure - b.structure) ** 2))
    colors = np.sqrt(max(0.0, 1.0 - float(a.colors @ b.colors)))
    return float(0.5 * (min(1.0, structure) + colors))


class ShotDetector:
    """Finds cuts in a stream of thumbnails; keeps the last twelve descriptors.

    Add every image, then call `finish`; `cuts` holds the index of the first picture of each new shot.
    """

    def __init__(self) -> None:
        self.cuts: list[int] = []
        self._recent: deque[Descriptor] = deque(maxlen=2 * _SIDE_FRAMES)
        self._count = 0

    def add(self, thumbnail_rgb: UInt8[np.ndarray, "height width 3"]) -> None:
        """Take the next picture."""
        self._recent.append(describe(thumbnail_rgb))
        self._count += 1
        # A boundary is decided once the side after it is full; the first ones have a short side before.
        if self._count > _SIDE_FRAMES:
            self._decide(len(self._recent) - _SIDE_FRAMES)

    def finish(self) -> list[int]:
        """Decide the last boundaries, whose side after is short, and return the cuts."""
        pictures = len(self._recent)
        for split in range(max(1, pictures - _SIDE_FRAMES + 1), pictures):
            self._decide(split)
        return self.cuts

    def _decide(self, split: int) -> None:
        """Add a cut if the image at `split` of the recent ones begins a shot."""
        recent = list(self._recent)
        before = recent[max(0, split - _SIDE_FRAMES) : split]
        after = recent[split : split + _SIDE_FRAMES]
        index = self._count - len(recent) + split
        across = min(distance(a, b) for a in before for b in after)
        if across < _CUT_DISTANCE:
            return
        steps = [distance(a, b) for side in (before, after) for a, b in pairwise(side)]
        usual = float(np.median(steps)) if steps else 0.0
        if across > _MIN_CONTRAST * usual:
            self.cuts.append(index)
