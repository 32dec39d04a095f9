"""Instances of a background image: what a detector and a segmentation network recognize, and regions of depth.

Masks are at the size of the depth map until `instances_of`, which brings them to that of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import project, world_points
from video2anim.networks.segmentation import CLASSES, Segmentation
from video2anim.objects.depth_regions import RegionLimits, Regions
from video2anim.objects.merge import Detection, joined_objects
from video2anim.objects.outline import cut_by_color, outlined
from video2anim.types import BackgroundImage, ObjectInstance, View

if TYPE_CHECKING:
    from video2anim.networks.objectron import ObjectFinder

_FURNITURE = ("chair", "table", "desk", "box")
"""Classes of the detector that a body uses."""
_FLOOR_TOLERANCE_M = 0.3
"""Pixels that the network calls floor may be this far from y = 0 by their depth, whose scale is rough here."""
_MIN_STOOD = 2
"""Least number of soles that stood on floor: a single one may be an error of the mask."""
_MIN_AHEAD_M = 0.1
"""Nearest points of a body that are projected."""
_TOP_PERCENT = 90
"""Of heights: the top of an object without errors of its mask."""


def detected_furniture(
    finder: ObjectFinder,
    image_rgb: UInt8[np.ndarray, "height width 3"],
    depth_m: Float[np.ndarray, "rows columns"],
    floor: Bool[np.ndarray, "rows columns"],
    *,
    min_score: float,
) -> list[Detection]:
    """Furniture that the detector finds, best first, each with its outline.

    Args:
        finder: the detector.
        image_rgb: the background image.
        depth_m: its depth; masks have this size.
        floor: pixels of the floor.
        min_score: of its detections.
    """
    boxes = (one for one in finder.find(image_rgb, min_score=min_score) if one.label in _FURNITURE)
    return [
        Detection(one.label, one.score, shrunk(outlined(image_rgb, depth_m, floor, one.box_px), depth_m.shape))
        for one in boxes
    ]


def recognized_objects(
    detected: Sequence[Detection], seen: Segmentation | None, shape: tuple[int, int]
) -> list[Detection]:
    """Objects of the detector, then furniture of the segmentation network, with masks of the given size."""
    instances = () if seen is None else seen.instances
    return [
        *detected,
        *(Detection(i.label, i.score, shrunk(i.mask, shape)) for i in instances if i.kind == "furniture"),
    ]


def merged_objects(
    recognized: Sequence[Detection],
    seen: Segmentation | None,
    regions: Regions,
    depth_m: Float[np.ndarray, "rows columns"],
    valid: Bool[np.ndarray, "rows columns"],
    view: View,
    limits: RegionLimits,
) -> tuple[list[Detection], Bool[np.ndarray, "rows columns"]]:
    """Objects of networks and of depth, each once, and the floor by both."""
    if seen is None and not recognized:
        return [Detection("object", region.score, region.mask) for region in regions.objects], regions.floor
    shape = depth_m.shape
    world_m = world_points(depth_m, view)
    if seen is None:
        built = np.zeros(shape, bool)
        return joined_objects(recognized, regions.objects, built, world_m, valid, limits), regions.floor
    built = shrunk(np.isin(seen.semantic, [CLASSES.index(name) for name in ("floor", "wall", "ceiling")]), shape)
    floor = shrunk(seen.semantic == CLASSES.index("floor"), shape)
    # Floor of the network unless depth contradicts it, and floor of depth unless the network sees an object there.
    low = ~valid | (np.abs(world_m[..., 1]) < _FLOOR_TOLERANCE_M)
    found = joined_objects(recognized, regions.objects, built, world_m, valid, limits)
    return found, (floor & low) | (regions.floor & built)


def without_floor(
    found: Sequence[Detection],
    soles_camera_m: Float[np.ndarray, "soles 3"],
    on_floor: Bool[np.ndarray, "soles"],
    person: Bool[np.ndarray, "rows columns"],
    height_m: Float[np.ndarray, "rows columns"],
    view: View,
) -> tuple[list[Detection], Bool[np.ndarray, "rows columns"]]:
    """Objects but for mats, rugs and blankets on which the person stood, and pixels of those: they are floor.

    Args:
        soles_camera_m: Soles of standing feet.
        on_floor: Those on the lowest level.
        person: Pixels at which the person was seen; elsewhere feet may be hidden.
        height_m: Of the depth points over the floor; NaN where unknown. Objects may err as a whole.
    """
    ahead = soles_camera_m[:, 2] > _MIN_AHEAD_M
    column, row = np.round(project(soles_camera_m[ahead], view.intrinsics)).astype(int).T
    rows, columns = person.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    column, row, on_floor = column[inside], row[inside], on_floor[ahead][inside]
    kept, floor = [], np.zeros_like(person)
    for one in found:
        inner = cv2.erode(one.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        stood = (inner & person)[row, column]
        under, low = height_m[row, column][stood & on_floor], int((stood & on_floor).sum())
        is_floor = low >= _MIN_STOOD and 2 * low > stood.sum() and np.isfinite(under).any()
        if is_floor and np.nanpercentile(height_m[one.mask], _TOP_PERCENT) - np.nanmedian(under) < _FLOOR_TOLERANCE_M:
            floor |= one.mask
        else:
            kept.append(one)
    return kept, floor


def instances_of(
    found: Sequence[Detection], background: BackgroundImage, *, min_score: float, max_objects: int
) -> tuple[ObjectInstance, ...]:
    """The best objects as instances at the size of the image, best first, with outlines where its colors change.

    The score of an object rises by half of the share of frames in which the person overlaps it: it is likely used.
    """
    scores = [item.score + 0.5 * _overlap_share(item, background) for item in found]
    order = [i for i in np.argsort(scores)[::-1] if scores[i] >= min_score][:max_objects]
    image = background.background_rgb
    chosen = [found[i] for i in order]
    masks = _cut_masks([one.mask for one in chosen], image)
    return tuple(
        _instance(number, replace(one, mask=mask), min(float(scores[i]), 1.0), image)
        for number, (i, one, mask) in enumerate(zip(order, chosen, masks, strict=True), start=1)
    )


def _cut_masks(
    masks: Sequence[Bool[np.ndarray, "rows columns"]], image_rgb: UInt8[np.ndarray, "height width 3"]
) -> list[Bool[np.ndarray, "rows columns"]]:
    """Every mask cut by color; none grows into another."""
    cut = list(masks)
    for k, mask in enumerate(masks):
        small = cv2.resize(image_rgb, mask.shape[::-1], interpolation=cv2.INTER_AREA)
        cut[k] = cut_by_color(mask, small, np.any(cut[:k] + cut[k + 1 :], axis=0) & ~mask)
    return cut


def _overlap_share(found: Detection, background: BackgroundImage) -> float:
    """Share of the sampled frames in which the main person overlaps the object in the image."""
    if not len(background.selected_mask):
        return 0.0
    return float((background.selected_mask & found.mask).any((1, 2)).mean())


def _instance(
    number: int, found: Detection, score: float, image_rgb: UInt8[np.ndarray, "height width 3"]
) -> ObjectInstance:
    mask = full_size(found.mask, image_rgb)
    rows, columns = np.nonzero(mask)
    box = np.array([columns.min(), rows.min(), columns.max(), rows.max()], dtype=np.float64)
    return ObjectInstance(number, found.label, score, box, mask)


def full_size(
    small: Bool[np.ndarray, "rows columns"], image_rgb: UInt8[np.ndarray, "height width 3"]
) -> Bool[np.ndarray, "height width"]:
    """Mask at the size of an image, its outline on the image's edges by a guided filter (He et al. 2013)."""
    height, width = image_rgb.shape[:2]
    soft = cv2.resize(small.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(1.5 * width / small.shape[1]))
    refined = cv2.ximgproc.guidedFilter(image_rgb, soft, radius, 60.0)
    large = refined > 0.5
    if small.any() and not large.any():
        return cv2.resize(small.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)
    return large
