"""Stage complete: the hidden parts of objects, in outline and color.

Outlines grow only where a nearer object or never-seen ground can hide the object (convexity, mirror symmetry,
support on the floor); colors there are inpainted from the object itself. A network of the user's may do both instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Bool, UInt8

from video2anim.errors import StageError
from video2anim.pipeline.options import limits, model_of
from video2anim.pipeline.stage import NO_MODEL, StageContext, StageSpec
from video2anim.types import (
    BackgroundImage,
    CompletedObject,
    CompletedObjects,
    InstanceMasks,
    MetricDepth,
    ObjectInstance,
)

if TYPE_CHECKING:
    from video2anim.networks.mask_completer import MaskCompleter

SLOT = "completer"


@dataclass(frozen=True)
class CompleteConfig:
    """Limits of the completion."""

    max_completed_ratio: Annotated[float, limits(ge=0, le=1)] = 0.5
    """If more than this share of the completed outline were invented, the visible outline is kept instead."""
    model: Annotated[str, model_of("completer", also=(NO_MODEL,))] = NO_MODEL
    """Network that completes outlines and colors, `completer@FILE`; `none` leaves them to geometry."""


@dataclass(frozen=True, slots=True, eq=False)
class _Completion:
    """An outline with its hidden part, and what is known of its colors."""

    amodal: Bool[np.ndarray, "height width"]
    picture_rgb: UInt8[np.ndarray, "height width 3"]
    known: Bool[np.ndarray, "height width"]
    """Pixels of the outline whose color the picture has; the others are inpainted."""


def complete_objects(
    background: BackgroundImage, masks: InstanceMasks, depth: MetricDepth, config: CompleteConfig, ctx: StageContext
) -> CompletedObjects:
    """Amodal mask and picture of every instance.

    Raises:
        ModelMissingError: its weights are absent, or no network of its contract.
    """
    from video2anim.geometry.masks import never_seen
    from video2anim.networks.amodal import object_picture

    completer = None if config.model == NO_MODEL else ctx.model(config.model)
    unseen = never_seen(background.seen_ratio, background.background_rgb.shape[:2])
    distance_m = {i.object_id: _distance_m(i, depth) for i in masks.instances}
    objects = []
    for done, instance in enumerate(masks.instances):
        if not instance.mask.any():
            continue
        nearer = [m for m in masks.instances if distance_m[m.object_id] < distance_m[instance.object_id]]
        hidden = unseen | _union([m.mask for m in nearer], instance.mask)
        made = _completed(background.background_rgb, instance, hidden & ~instance.mask, completer, ctx)
        amodal = made.amodal
        ratio = 1.0 - instance.mask.sum() / max(int(amodal.sum()), 1)
        if ratio > config.max_completed_ratio:
            ctx.warn(f"object {instance.object_id} would be {ratio:.0%} invented; its visible part is kept")
            amodal, ratio = instance.mask.copy(), 0.0
        image_rgb, corner = object_picture(made.picture_rgb, made.known, amodal)
        found = CompletedObject(instance.object_id, instance.label, amodal, image_rgb, corner, float(ratio))
        objects.append(found)
        ctx.progress(done + 1, len(masks.instances))
    ratios = [o.completed_ratio for o in objects] or [0.0]
    ctx.quality("objects", len(objects), "count")
    ctx.quality("mean_completed_ratio", float(np.mean(ratios)), "ratio")
    ctx.quality("max_completed_ratio", max(ratios), "ratio", "lower")
    return CompletedObjects(tuple(objects))


def _completed(
    background_rgb: UInt8[np.ndarray, "height width 3"],
    instance: ObjectInstance,
    hidden: Bool[np.ndarray, "height width"],
    completer: MaskCompleter | None,
    ctx: StageContext,
) -> _Completion:
    """What the network says; where there is none or it fails, what geometry says."""
    from video2anim.networks.amodal import amodal_mask

    if completer is not None:
        try:
            said = completer.complete(background_rgb, instance.mask, hidden)
        except StageError as error:
            ctx.warn(f"object {instance.object_id} is completed by geometry instead: {error}")
        else:
            return _Completion(said.amodal, said.rgb, said.amodal)
    return _Completion(amodal_mask(instance.mask, hidden), background_rgb, instance.mask)


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


STAGE = StageSpec("complete", complete_objects, version=2, models=(SLOT,))
