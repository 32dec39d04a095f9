"""Stage complete: the hidden parts of objects, in outline and color.

Outlines grow only where a nearer object or never-seen ground can hide the object (convexity, mirror symmetry,
support on the floor); colors there are inpainted from the object itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundPlate,
    CompletedObject,
    CompletedObjects,
    InstanceMasks,
    MetricDepth,
    ObjectInstance,
)


@dataclass(frozen=True)
class CompleteConfig:
    """Limits of the completion."""

    unseen_ratio: float = 0.02
    """Pixels that are free of people in a smaller share of the frames count as never seen."""
    largest_completed_ratio: float = 0.5
    """If more than this share of the completed outline were invented, the visible outline is kept instead."""


def complete_objects(
    plate: BackgroundPlate, masks: InstanceMasks, depth: MetricDepth, config: CompleteConfig, ctx: StageContext
) -> CompletedObjects:
    """Amodal mask and picture of every instance."""
    import cv2

    from video2anim.geometry.amodal import amodal_mask, object_picture

    height, width = plate.plate_rgb.shape[:2]
    seen = cv2.resize(plate.seen_ratio.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    unseen = seen < config.unseen_ratio
    distance_m = {i.object_id: _distance_m(i, depth) for i in masks.instances}
    objects = []
    for done, instance in enumerate(masks.instances):
        if not instance.mask.any():
            continue
        nearer = [m for m in masks.instances if distance_m[m.object_id] < distance_m[instance.object_id]]
        hidden = unseen | _union([m.mask for m in nearer], instance.mask)
        amodal = amodal_mask(instance.mask, hidden & ~instance.mask)
        ratio = 1.0 - instance.mask.sum() / max(int(amodal.sum()), 1)
        if ratio > config.largest_completed_ratio:
            ctx.warn(f"complete: object {instance.object_id} would be {ratio:.0%} invented; its visible part is kept")
            amodal, ratio = instance.mask.copy(), 0.0
        image_rgb, corner = object_picture(plate.plate_rgb, instance.mask, amodal)
        found = CompletedObject(instance.object_id, instance.label, amodal, image_rgb, corner, float(ratio))
        objects.append(found)
        ctx.progress(done + 1, len(masks.instances))
    ratios = [o.completed_ratio for o in objects] or [0.0]
    ctx.quality("objects", len(objects), "objects")
    ctx.quality("mean_completed_ratio", float(np.mean(ratios)), "1")
    ctx.quality("largest_completed_ratio", max(ratios), "1", "lower")
    return CompletedObjects(tuple(objects))


def _union(masks: list[np.ndarray], like: np.ndarray) -> Bool[np.ndarray, "height width"]:
    together = np.zeros_like(like)
    for mask in masks:
        together |= mask
    return together


def _distance_m(instance: ObjectInstance, depth: MetricDepth) -> float:
    """Median depth of the instance; infinite where none of its pixels has any."""
    import cv2

    height, width = depth.background_depth_m.shape
    small = cv2.resize(instance.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)
    known = small & depth.background_valid
    return float(np.median(depth.background_depth_m[known])) if known.any() else float("inf")


STAGE = StageSpec("complete", complete_objects, version=1)
