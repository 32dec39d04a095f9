"""Stage background: the image without people, and the masks of people.

The background image is a temporal median that excludes tracked people. A first one, made with the enlarged masks of the
person model, refines the masks by difference from the background; the refined masks make the final one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Bool, Int

from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import BackgroundImage, CameraEstimate, PersonTracks, VideoClip

if TYPE_CHECKING:
    from video2anim.background.person_masks import MedianSamples, PeopleMasks

_SAMPLE_BYTES = 256 * 2**20
"""Memory for full-size samples of the background image."""
_MIN_SAMPLES = 9
"""Fewest samples, whatever their memory: a median of fewer shows people who stand."""


@dataclass(frozen=True)
class BackgroundConfig:
    """How the background image is sampled."""

    frame_step: Annotated[int, limits("frames", ge=1, le=100_000)] = 5
    """Masks are made of every such frame and of the last one."""
    max_samples: Annotated[int, limits(ge=1, le=255)] = 60
    """Most frames of the median; fewer where they would need too much memory."""
    long_side_px: Annotated[int, limits("px", ge=16, le=16_384)] = 384
    """Working resolution of masks, and of all depth that follows."""


def make_background(
    clip: VideoClip, tracks: PersonTracks, camera: CameraEstimate, config: BackgroundConfig, ctx: StageContext
) -> BackgroundImage:
    """Background image of the clip and masks of its people.

    It is the first frame's view. Frames of a camera that turns are aligned to it; if the camera travels, only what
    people hide in the first frame comes from others.

    Raises:
        InputError: the clip's video cannot be read.
    """
    from video2anim.background.background_image import (
        inpaint_unobserved,
        median_background,
        updated_background,
        with_own_pixels,
    )
    from video2anim.background.person_masks import excluded_from_median, generous_masks, grown_masks, people_masks
    from video2anim.background.person_segmentation import Raster

    raster = Raster.of_clip(clip.width_px, clip.height_px, config.long_side_px)
    frame_index = np.unique(np.r_[0 : clip.frame_count : config.frame_step, clip.frame_count - 1])
    generous = generous_masks(tracks, frame_index, raster)
    samples = _collect(clip, frame_index, camera, config, ctx)

    excluded = excluded_from_median(generous, samples, raster)
    median = median_background(samples.rgb, excluded)
    unseen = np.all(excluded, axis=0)
    known = (inpaint_unobserved(median, unseen), ~unseen)
    done = len(frame_index)
    people = people_masks(
        clip, tracks, frame_index, samples, known, raster, lambda row: ctx.progress(done + row + 1, 2 * done)
    )

    sharper = excluded_from_median(grown_masks(people.any_person, tracks, frame_index, raster), samples, raster)
    unseen = np.all(sharper, axis=0)
    background = inpaint_unobserved(updated_background(median, samples.rgb, excluded, sharper), unseen)
    if camera.travels:
        background = with_own_pixels(background, samples.rgb[0], sharper[0])
    seen_ratio = 1.0 - sharper.mean(axis=0, dtype=np.float32)
    _report(camera, samples, unseen, people, ctx)
    return BackgroundImage(
        background_rgb=background,
        seen_ratio=seen_ratio.astype(np.float32),
        frame_index=frame_index,
        person_mask=people.any_person,
        selected_mask=people.selected,
    )


def _collect(
    clip: VideoClip,
    frame_index: Int[np.ndarray, "samples"],
    camera: CameraEstimate,
    config: BackgroundConfig,
    ctx: StageContext,
) -> MedianSamples:
    """Read and align the frames of the median."""
    from video2anim.background.person_masks import MedianSamples, aligned, mask_frames

    count = len(frame_index)
    affordable = max(_MIN_SAMPLES, _SAMPLE_BYTES // (3 * clip.width_px * clip.height_px))
    wanted = np.unique(np.linspace(0, count - 1, min(count, config.max_samples, affordable)).round().astype(int))
    H_first_frame = np.tile(np.eye(3), (count, 1, 1)) if camera.is_static else camera.H_first_frame(frame_index)
    rgb = np.zeros((len(wanted), clip.height_px, clip.width_px, 3), np.uint8)
    rows: list[int] = []
    for row, picture in enumerate(mask_frames(clip, frame_index)):
        ctx.progress(row + 1, 2 * count)
        if row in wanted and np.isfinite(H_first_frame[row]).all():
            rgb[len(rows)] = picture if camera.is_static else aligned(picture, H_first_frame[row])
            rows.append(row)
    return MedianSamples(np.array(rows), rgb[: len(rows)], H_first_frame)


def _report(
    camera: CameraEstimate,
    samples: MedianSamples,
    unseen: Bool[np.ndarray, "small_height small_width"],
    people: PeopleMasks,
    ctx: StageContext,
) -> None:
    ctx.quality("background_unobserved", float(unseen.mean()), "ratio", "lower")
    ctx.quality("background_samples", len(samples.row), "count")
    ctx.quality("person_area", float(people.any_person.mean()), "ratio")
    ctx.quality("main_person_area", float(people.selected.mean()), "ratio")
    if camera.travels:
        ctx.warn("the camera travels: what people hide in the first frame is taken from frames of other perspectives")
    if unseen.mean() > 0.02:
        ctx.warn(
            f"{100 * unseen.mean():.0f} % of the background is never seen (people cover it throughout); "
            "the background image is inpainted there"
        )


STAGE = StageSpec("background", make_background, version=4)
