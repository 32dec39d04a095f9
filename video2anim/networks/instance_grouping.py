"""Instances from center and offset heads: pixels vote for the center of their object.

Source: Panoptic-DeepLab (Cheng et al. 2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

_MIN_HEAT = 0.12
"""Smallest probability of a center."""
_APART = 0.06
"""Smallest distance of two centers, in image heights."""
_FARTHEST = 0.35
"""Pixels whose vote misses every center by more (image heights) belong to no instance."""


@dataclass(frozen=True, slots=True, eq=False)
class InstanceOffsets:
    """Predicted centers, offsets and boundaries of objects."""

    center: Float[np.ndarray, "rows columns"]
    """Probability that an object's center is at this pixel."""
    offset: Float[np.ndarray, "rows columns 2"]
    """From this pixel to the center of the object that it shows (x, y), in image heights."""
    boundary: Float[np.ndarray, "rows columns"]
    """Probability that an object ends at this pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Pixels of one object."""

    mask: Bool[np.ndarray, "rows columns"]
    score: float
    """0 to 1: probability of its center, agreement of its pixels, probability that they belong to any object."""

    @property
    def share(self) -> Float[np.ndarray, "rows columns"]:
        """The mask as numbers, to be resized."""
        return self.mask.astype(np.float32)


def grouped(
    heads: InstanceOffsets,
    wanted: Bool[np.ndarray, "rows columns"],
    probability: Float[np.ndarray, "rows columns"] | None = None,
    min_ratio: float = 0.002,
) -> list[Group]:
    """Split the wanted pixels into objects, best score first.

    Args:
        heads: Predicted centers and offsets.
        wanted: Pixels that belong to some object.
        probability: That they do; 1 if not given.
        min_ratio: Smallest share of the image for an object.
    """
    rows, columns = wanted.shape
    centers = _centers(heads.center, wanted)
    if not len(centers) or not wanted.any():
        return []
    y, x = np.nonzero(wanted)
    vote = np.stack([x, y], 1) + heads.offset[y, x] * rows
    far = np.linalg.norm(vote[:, None] - centers[None, :, :2], axis=-1)
    nearest = far.argmin(1)
    miss = far[np.arange(len(far)), nearest]
    nearest[miss > _FARTHEST * rows] = -1
    groups = []
    for number, (center_x, center_y) in enumerate(centers[:, :2].astype(int)):
        own = nearest == number
        if own.sum() < min_ratio * wanted.size:
            continue
        mask = np.zeros((rows, columns), bool)
        mask[y[own], x[own]] = True
        agreement = float(np.exp(-np.median(miss[own]) / (0.08 * rows)))
        likely = 1.0 if probability is None else float(probability[mask].mean())
        groups.append(Group(mask, float(np.sqrt(heads.center[center_y, center_x] * agreement)) * likely))
    return sorted(groups, key=lambda group: -group.score)


def _centers(heat: np.ndarray, wanted: np.ndarray) -> Float[np.ndarray, "centers 3"]:
    """Peaks x, y, height near wanted pixels."""
    rows = heat.shape[0]
    smooth = cv2.GaussianBlur(heat.astype(np.float32), (0, 0), max(0.008 * rows, 0.6))
    reach = max(1, round(_APART * rows))
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    peak = (smooth == cv2.dilate(smooth, around)) & (smooth > _MIN_HEAT)
    peak &= cv2.dilate(wanted.astype(np.uint8), around) > 0
    # A plateau is one peak: its center.
    count, _, _, center = cv2.connectedComponentsWithStats(peak.astype(np.uint8), connectivity=8)
    x, y = np.round(center[1:count]).astype(int).T
    order = np.argsort(-smooth[y, x])
    return np.stack([x, y, smooth[y, x]], 1)[order].astype(np.float64)
