"""Stage segment: the objects and the floor in the background image.

Three sources are merged. A model of slot `segment` recognizes objects, which must have an object's size by the depth. A
detector of photographs (`finder`) adds chairs, tables, desks and boxes. Regions of depth add objects that neither
recognizes: upright, standing on the floor, nearer than the background behind them. Their label is `object`; provider
`geometric` uses them alone. Depth is in meters by a rough fit to floor and person; stage metric repeats that fit with
the objects found here. The list may be empty.
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
    DepthClip,
    InstanceMasks,
    VideoClip,
)

if TYPE_CHECKING:
    from video2anim.objects.merge import Detection


@dataclass(frozen=True)
class SegmentConfig:
    """What counts as an object."""

    provider: Annotated[str, model_of("segment", also=("geometric",))] = "room-segment"
    """`geometric`, or a model of slot `segment`, by its name or as NAME@PATH."""
    finder: Annotated[str, model_of("finder", also=(NO_MODEL,))] = "objectron"
    """Detector of chairs, tables and boxes, trained on photographs; `none` for no detector."""
    finder_score: Annotated[float, limits(ge=0, le=1)] = 0.5
    """Minimum score of its detections: below it most are wrong on background images of real clips."""
    min_ratio: Annotated[float, limits(ge=0, le=1)] = 0.004
    """Minimum share of the image."""
    min_m: Annotated[float, limits("m", ge=0, le=1000)] = 0.15
    """Minimum width and height."""
    max_m: Annotated[float, limits("m", gt=0, le=1000)] = 4.0
    """Maximum width and height."""
    max_objects: Annotated[int, limits("objects", ge=0, le=1000)] = 12
    """Objects kept, best first."""
    min_score: Annotated[float, limits(ge=0, le=2)] = 0.25
    """Objects with a smaller score are dropped, unless the person touches them."""


def segment_background(
    clip: VideoClip,
    background: BackgroundImage,
    depth: DepthClip,
    bodies: BodyTracks,
    config: SegmentConfig,
    ctx: StageContext,
) -> InstanceMasks:
    """Instances, best score first, and the floor, at the size of the background image.

    Raises:
        StageError: there is no body in any frame (its camera gives gravity and the floor).
    """
    from video2anim.calibration.gather import first_depth_m, picture_evidence
    from video2anim.geometry.masks import shrunk
    from video2anim.geometry.projection import world_points
    from video2anim.humans.ground import lowest_level
    from video2anim.networks.segmentation import CLASSES
    from video2anim.objects.depth_regions import RegionLimits, find_regions
    from video2anim.objects.instances import (
        full_size,
        instances_of,
        merged_objects,
        recognized_objects,
        without_floor,
    )

    main, shape = bodies.main, depth.background_value.shape
    view = main.view().resized(*shape[::-1])
    image = background.background_rgb
    seen = None if config.provider == "geometric" else ctx.model(config.provider).segment(image)
    labeled = np.zeros(shape, bool) if seen is None else shrunk(seen.semantic == CLASSES.index("floor"), shape)
    evidence = picture_evidence(depth, background, bodies, labeled, clip.fps, ctx.rng("segment/points"))
    depth_m = first_depth_m(evidence, depth, main)
    valid = depth.background_valid & np.isfinite(depth_m)
    depth_m = np.where(np.isfinite(depth_m), depth_m, 1e3)
    limits = RegionLimits(config.min_ratio, config.min_m, config.max_m, 4 * config.max_objects)
    regions = find_regions(depth_m, valid, view, limits)
    detected = _detected(image, depth_m, regions.floor, config, ctx)
    recognized = recognized_objects(detected, seen, shape)
    found, floor = merged_objects(recognized, seen, regions, depth_m, valid, view, limits)
    support_m = evidence.people[0].support_m
    up_m, height_m = (
        support_m @ view.T_world_camera[1, :3],
        np.where(valid, world_points(depth_m, view)[..., 1], np.nan),
    )
    on_floor, person = np.isin(up_m, lowest_level(up_m)), np.asarray(background.selected_mask.any(0))
    found, mats = without_floor(found, support_m, on_floor, person, height_m, view)
    instances = instances_of(found, background, min_score=config.min_score, max_objects=config.max_objects)
    floor = full_size(floor | mats, image)
    for instance in instances:
        floor &= ~instance.mask
    ctx.quality("recognized", len(recognized), "count")
    ctx.quality("objects", len(instances), "count")
    ctx.quality("floor_ratio", float(floor.mean()), "ratio")
    covered = sum(int(instance.mask.sum()) for instance in instances) / floor.size
    ctx.quality("object_ratio", covered, "ratio")
    ctx.quality("mean_score", float(np.mean([i.score for i in instances])) if instances else 0.0, "ratio", "higher")
    return InstanceMasks(config.provider, instances, floor)


def _detected(
    image: UInt8[np.ndarray, "height width 3"],
    depth_m: Float[np.ndarray, "rows columns"],
    floor: Bool[np.ndarray, "rows columns"],
    config: SegmentConfig,
    ctx: StageContext,
) -> list[Detection]:
    """Furniture by the detector; none without one."""
    from video2anim.objects.instances import detected_furniture

    if config.finder == NO_MODEL:
        return []
    found = detected_furniture(ctx.model(config.finder), image, depth_m, floor, min_score=config.finder_score)
    ctx.quality("named_by_detector", len(found), "count")
    return found


STAGE = StageSpec("segment", segment_background, version=15, models=("segment", "finder"))
