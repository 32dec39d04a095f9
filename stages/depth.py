"""Stage depth: depth of the background image and of the people in sampled frames, up to one scale and offset.

A network of slot `depth` estimates it (`video2anim.depth.network_depth`); its uncertainty comes from hue jitter
(supplement 8.1). With a static camera every frame has the depth of the background image, and only people have the depth
of their own frame, aligned to it, so that nothing flickers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from video2anim.pipeline.options import limits, model_of
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import BackgroundImage, CameraEstimate, DepthClip, VideoClip

if TYPE_CHECKING:
    from video2anim.depth.temporal_alignment import Alignment

_HueShift = Annotated[float, limits("rad", ge=-math.pi, le=math.pi)]


@dataclass(frozen=True)
class DepthConfig:
    """The network and how its uncertainty is measured."""

    provider: Annotated[str, model_of("depth")] = "room-depth"
    """A model of slot `depth`, by its name or as NAME@PATH."""
    max_frames: Annotated[int, limits(ge=1, le=255)] = 12
    """Sampled frames in which people's depth is estimated. With half of them the calibration is the
    same (`benchmarks/calibration.py`)."""
    hue_shifts_rad: tuple[_HueShift, ...] = (-0.6, -0.3, 0.3, 0.6)
    """Hue shifts of the background image's copies."""
    frame_hue_shifts_rad: tuple[_HueShift, ...] = (-0.45, 0.45)
    """Hue shifts of each sampled frame's copies; fewer, since there are many frames. With these for the background
    image too, 0.999 instead of 0.957 of it is valid on `ocv_walk`."""
    unreliable_ratio: Annotated[float, limits(ge=0, le=1)] = 0.04
    """Pixels with a deviation above this share of the range of values are invalid."""


def estimate_depth(
    clip: VideoClip,
    background_image: BackgroundImage,
    camera: CameraEstimate,
    config: DepthConfig,
    ctx: StageContext,
) -> DepthClip:
    """Relative depth of the background image and of every sampled frame, with uncertainty.

    Raises:
        InputError: the clip's video cannot be read.
    """
    from video2anim.depth.network_depth import DepthModel, HueJitter, clip_depth, frame_depths, image_depth

    model: DepthModel = ctx.model(config.provider)
    chosen = np.linspace(0, len(background_image.frame_index) - 1, config.max_frames).round().astype(int)
    sampled = background_image.of_frames(background_image.frame_index[np.unique(chosen)])
    empty = image_depth(
        model,
        background_image.background_rgb,
        background_image.seen_ratio.shape,
        HueJitter(config.hue_shifts_rad, config.unreliable_ratio),
    )
    jitter = HueJitter(config.frame_hue_shifts_rad, config.unreliable_ratio)
    frames = frame_depths(model, clip, sampled, jitter, ctx.progress)
    depth, alignment = clip_depth(config.provider, model.kind, sampled, empty, frames, is_static=camera.is_static)
    _report(depth, alignment, sampled, ctx)
    return depth


def _report(depth: DepthClip, alignment: Alignment | None, background: BackgroundImage, ctx: StageContext) -> None:
    if alignment is not None and alignment.lost:
        ctx.warn(
            f"{alignment.lost} of {len(depth.frame_index)} sampled frames could not be aligned to the background: "
            "people have no depth there"
        )
    if alignment is not None and alignment.flicker_before is not None and alignment.flicker_after is not None:
        ctx.quality("flicker_before", alignment.flicker_before, "ratio", "lower")
        ctx.quality("flicker_after", alignment.flicker_after, "ratio", "lower")
    people = background.selected_mask
    ctx.quality("background_valid_ratio", float(depth.background_valid.mean()), "ratio", "higher")
    ctx.quality("person_valid_ratio", (people & depth.valid).sum() / max(int(people.sum()), 1), "ratio", "higher")
    sigma = depth.sigma[depth.valid] / np.maximum(np.abs(depth.value[depth.valid]), 1e-6)
    ctx.quality("median_sigma_ratio", float(np.median(sigma)) if sigma.size else 1.0, "ratio", "lower")


STAGE = StageSpec("depth", estimate_depth, version=5, models=("depth",))
