"""Stage segment: the objects and the floor in the background image.

Provider `geometric`: an object is an upright region that stands on the floor, is nearer than the background behind it
and has an object's size. There is no semantic class; the label is `object`. Any other provider is a model of slot
`segment`: what it recognizes in the background image is held to an object's size by the depth, and joined by the
regions of depth that it does not explain. A detector that has seen photographs names chairs, tables, desks and boxes
before both. Depth is brought to meters by floor and person roughly: stage metric does it for good, with what is found
here. An empty list is a valid answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.pipeline.options import limits, model_of
from video2anim.pipeline.stage import NO_MODEL, StageContext, StageSpec
from video2anim.types import (
    BackgroundImage,
    BodyTracks,
    CameraEstimate,
    DepthClip,
    InstanceMasks,
    ObjectInstance,
    VideoClip,
    View,
)

if TYPE_CHECKING:
    from video2anim.networks.segmentation import Segmentation
    from video2anim.objects.depth_regions import RegionLimits, Regions
    from video2anim.objects.merge import Detection

_FURNITURE_WORDS = ("chair", "table", "desk", "box")
"""Words of the detector for what a body uses."""
_FLOOR_TOLERANCE_M = 0.3
"""Recognized floor may lie so far off the floor by its depth."""


@dataclass(frozen=True)
class SegmentConfig:
    """What counts as an object."""

    provider: Annotated[str, model_of("segment", also=("geometric",))] = "room-segment"
    """`geometric`, or a model of slot `segment`, by its name or as NAME@PATH."""
    finder: Annotated[str, model_of("finder", also=(NO_MODEL,))] = "objectron"
    """Detector that knows photographs, for chairs, tables and boxes; `none` for no detector."""
    finder_score: Annotated[float, limits(ge=0, le=1)] = 0.5
    """Least score of what it finds; less is wrong more often than right on background images of real clips."""
    chair_score: Annotated[float, limits(ge=0, le=1)] = 0.3
    """The same of a chair in which its second network sees the 3D box of a chair."""
    min_ratio: Annotated[float, limits(ge=0, le=1)] = 0.004
    """Least share of the picture."""
    min_m: Annotated[float, limits("m", ge=0, le=1000)] = 0.15
    """Least width and height."""
    max_m: Annotated[float, limits("m", gt=0, le=1000)] = 4.0
    """Largest width and height."""
    max_objects: Annotated[int, limits("objects", ge=0, le=1000)] = 12
    """Objects kept, best first."""
    min_score: Annotated[float, limits(ge=0, le=2)] = 0.25
    """Objects with a smaller score are dropped, unless the person touches them."""


def segment_background(
    clip: VideoClip,
    background: BackgroundImage,
    depth: DepthClip,
    bodies: BodyTracks,
    camera: CameraEstimate,
    config: SegmentConfig,
    ctx: StageContext,
) -> InstanceMasks:
    """Instances, best score first, and the floor, at the size of the background image.

    Raises:
        StageError: there is no body in any frame (its camera gives gravity and the floor).
    """
    from video2anim.calibration.gather import first_depth_m, picture_evidence
    from video2anim.geometry.masks import shrunk
    from video2anim.networks.segmentation import CLASSES
    from video2anim.objects.depth_regions import RegionLimits, find_regions
    from video2anim.objects.merge import Detection

    main, shape = bodies.main, depth.background_value.shape
    view = main.view().resized(*shape[::-1])
    seen = None if config.provider == "geometric" else ctx.model(config.provider).segment(background.background_rgb)
    named = np.zeros(shape, bool) if seen is None else shrunk(seen.semantic == CLASSES.index("floor"), shape)
    evidence = picture_evidence(depth, background, bodies, camera, named, clip.fps, ctx.rng("segment/points"))
    depth_m = first_depth_m(evidence, depth, main)
    valid = depth.background_valid & np.isfinite(depth_m)
    depth_m = np.where(np.isfinite(depth_m), depth_m, 1e3)
    limits = RegionLimits(
        min_ratio=config.min_ratio,
        min_m=config.min_m,
        max_m=config.max_m,
        most=4 * config.max_objects,
    )
    regions = find_regions(depth_m, valid, view, limits)
    named = _named_by_finder(background, depth_m, regions.floor, config, ctx)
    if seen is None and not named:
        found, floor = [Detection("object", r.score, r.mask) for r in regions.objects], regions.floor
    else:
        found, floor = _with_networks(seen, named, depth_m, valid, regions, limits, view, ctx)
    scores = [item.score + 0.5 * _occlusion_share(item, background) for item in found]
    order = [i for i in np.argsort(scores)[::-1] if scores[i] >= config.min_score][: config.max_objects]
    instances = tuple(
        _instance(number, found[i], min(float(scores[i]), 1.0), background.background_rgb)
        for number, i in enumerate(order, start=1)
    )
    floor = _enlarge(floor, background.background_rgb)
    for instance in instances:
        floor &= ~instance.mask
    ctx.quality("objects", len(instances), "count")
    ctx.quality("floor_ratio", float(floor.mean()), "ratio")
    covered = sum(int(instance.mask.sum()) for instance in instances) / floor.size
    ctx.quality("object_ratio", covered, "ratio")
    ctx.quality("mean_score", float(np.mean([i.score for i in instances])) if instances else 0.0, "ratio", "higher")
    return InstanceMasks(config.provider, instances, floor)


def _named_by_finder(
    background: BackgroundImage,
    depth_m: Float[np.ndarray, "small_height small_width"],
    floor: Bool[np.ndarray, "small_height small_width"],
    config: SegmentConfig,
    ctx: StageContext,
) -> list[Detection]:
    """Objects that the detector names, outlined, best first."""
    from video2anim.geometry.masks import shrunk
    from video2anim.objects.merge import Detection
    from video2anim.objects.outline import outlined

    if config.finder == NO_MODEL:
        return []
    finder, image = ctx.model(config.finder), background.background_rgb
    objects: list[Detection] = []
    for found in finder.find(image, min_score=min(config.finder_score, config.chair_score)):
        sure = found.score >= config.finder_score
        if found.label == "chair" and found.score >= config.chair_score:
            sure |= finder.chair_box(image, found.box_px) is not None
        if sure and found.label in _FURNITURE_WORDS:
            mask = shrunk(outlined(image, depth_m, floor, found.box_px), depth_m.shape)
            objects.append(Detection(found.label, found.score, mask))
    ctx.quality("named_by_detector", len(objects), "count")
    return objects


def _with_networks(
    seen: Segmentation | None,
    named: list[Detection],
    depth_m: Float[np.ndarray, "small_height small_width"],
    valid: Bool[np.ndarray, "small_height small_width"],
    regions: Regions,
    limits: RegionLimits,
    view: View,
    ctx: StageContext,
) -> tuple[list[Detection], Bool[np.ndarray, "small_height small_width"]]:
    """What the networks recognize, joined with the regions of depth; and the floor by both."""
    from video2anim.geometry.masks import shrunk
    from video2anim.geometry.projection import backproject, transform_points
    from video2anim.networks.segmentation import CLASSES
    from video2anim.objects.merge import Detection, joined_objects

    shape = depth_m.shape
    recognized, built, floor = list(named), np.zeros(shape, bool), np.zeros(shape, bool)
    if seen is not None:
        recognized += [
            Detection(i.label, i.score, shrunk(i.mask, shape)) for i in seen.instances if i.kind == "furniture"
        ]
        built = shrunk(np.isin(seen.semantic, [CLASSES.index(name) for name in ("floor", "wall", "ceiling")]), shape)
        floor = shrunk(seen.semantic == CLASSES.index("floor"), shape)
    camera_m = backproject(depth_m, view.intrinsics)
    world_m = transform_points(view.T_world_camera, camera_m.reshape(-1, 3)).reshape(camera_m.shape)
    found = joined_objects(recognized, regions.objects, built, world_m, valid, limits)
    ctx.quality("recognized", len(recognized), "count")
    if seen is None:
        return found, regions.floor
    # Where depth says flat and low and the network has no other idea, or where it says floor and depth does not object.
    low = ~valid | (np.abs(world_m[..., 1]) < _FLOOR_TOLERANCE_M)
    return found, (floor & low) | (regions.floor & built)


def _occlusion_share(region: Detection, background: BackgroundImage) -> float:
    """Share of sampled frames in which the main person overlaps the region or its border: likely to be used."""
    if not len(background.selected_mask):
        return 0.0
    return float((background.selected_mask & region.mask).any((1, 2)).mean())


def _instance(
    number: int, region: Detection, score: float, background_rgb: UInt8[np.ndarray, "h w 3"]
) -> ObjectInstance:
    mask = _enlarge(region.mask, background_rgb)
    rows, columns = np.nonzero(mask)
    box = np.array([columns.min(), rows.min(), columns.max(), rows.max()], dtype=np.float64)
    return ObjectInstance(number, region.label, score, box, mask)


def _enlarge(small: Bool[np.ndarray, "h w"], background_rgb: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Mask at the background image's size, its outline drawn to the background image's edges by a guided filter (He et
    al. 2013)."""
    import cv2

    height, width = background_rgb.shape[:2]
    soft = cv2.resize(small.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(1.5 * width / small.shape[1]))
    refined = cv2.ximgproc.guidedFilter(background_rgb, soft, radius, 60.0)
    large = refined > 0.5
    if small.any() and not large.any():
        return cv2.resize(small.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)
    return large


STAGE = StageSpec("segment", segment_background, version=8, models=("segment", "finder"))
