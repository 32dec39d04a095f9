"""Merging of recognized objects and regions of depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.objects.depth_regions import Region, RegionLimits

_COVERED = 0.5
"""Share covered by better objects above which an object or a region is one of them."""
_BUILT = 0.6
"""Share of a region on walls, ceiling and floor above which it is no object."""
_MIN_PART = 0.15
"""Minimum area of a part of a mask over that of the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """An object of any source, at the size of the depth map; its label is `object` where no network recognized it."""

    label: str
    score: float
    mask: Bool[np.ndarray, "height width"]


def joined_objects(
    recognized: Sequence[Detection],
    regions: Sequence[Region],
    built: Bool[np.ndarray, "height width"],
    points_world_m: Float[np.ndarray, "height width 3"],
    valid: Bool[np.ndarray, "height width"],
    limits: RegionLimits,
) -> list[Detection]:
    """Recognized objects of an object's size, and regions of depth that none of them explains; best score first.

    Args:
        recognized: By a network, best first.
        regions: By `find_regions`.
        built: Where the network sees walls, ceiling or floor.
        points_world_m: Lifted pixels, +Y up, floor at 0.
        valid: Pixels whose depth is known.
        limits: Least and largest size of an object.
    """
    found: list[Detection] = []
    taken = np.zeros(built.shape, bool)
    for obj in recognized:
        mask = _main_parts(obj.mask & ~taken)
        if mask.sum() < (1 - _COVERED) * obj.mask.sum():
            continue
        if mask.mean() < limits.min_ratio or not _has_object_size(points_world_m[mask & valid], limits):
            continue
        found.append(Detection(obj.label, obj.score, mask))
        taken |= mask
    for region in regions:
        size = max(int(region.mask.sum()), 1)
        if (region.mask & taken).sum() > _COVERED * size or (region.mask & built).sum() > _BUILT * size:
            continue
        mask = _main_parts(region.mask & ~taken)
        if mask.mean() >= limits.min_ratio:
            # Not recognized: a lower score than that of recognized objects.
            found.append(Detection("object", 0.7 * region.score, mask))
            taken |= mask
    return sorted(found, key=lambda item: -item.score)


def _has_object_size(points_m: np.ndarray, limits: RegionLimits) -> bool:
    """Whether the points span an object's width and height; true where too few have depth."""
    if len(points_m) < 12:
        return True
    low, high = np.percentile(points_m, [5, 95], axis=0)
    width, height = float(np.hypot(*(high - low)[[0, 2]])), float(high[1])
    return limits.min_m <= max(width, height) and max(width, height) <= 1.5 * limits.max_m


def _main_parts(mask: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """The mask without small parts, and without those that are farther from the largest than they are long: what hides
    an object's middle is seldom larger than what is seen of it."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count <= 2:
        return mask
    area = stats[1:, cv2.CC_STAT_AREA]
    largest = 1 + int(area.argmax())
    away_px = cv2.distanceTransform((parts != largest).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    kept = [
        number
        for number in range(1, count)
        if area[number - 1] >= _MIN_PART * area.max()
        and away_px[parts == number].min() <= stats[number, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max()
    ]
    return np.isin(parts, kept)
