"""Stage background: the picture without its people, and where the people are.

The background image is a temporal median that leaves out tracked people. A first background image, made with the person
model's generous masks, sharpens the masks by figure and ground; the sharper masks make the final background image.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.pipeline.options import limits, model_of
from video2anim.pipeline.stage import NO_MODEL, StageContext, StageSpec
from video2anim.types import BackgroundImage, PersonTracks, VideoClip

if TYPE_CHECKING:
    from video2anim.background.person_segmentation import Raster
    from video2anim.networks.segmentation import SegmentModel

_SAMPLE_BYTES = 256 * 2**20
"""Memory for full-size samples of the background image."""
_FEWEST_SAMPLES = 9


@dataclass(frozen=True)
class BackgroundConfig:
    """How the background image is sampled."""

    frame_step: Annotated[int, limits("frames", ge=1, le=100_000)] = 5
    """Masks are made for every such frame and the last one."""
    max_samples: Annotated[int, limits(ge=1, le=255)] = 60
    """Most frames that the median takes; fewer where they would need too much memory."""
    long_side_px: Annotated[int, limits("px", ge=16, le=16_384)] = 384
    """Working resolution of masks, and of all depth that follows."""
    segment_model: Annotated[str, model_of("segment", also=(NO_MODEL,))] = "none"
    """Model of slot `segment` that sees people beside the person model; `none` leaves masks to the latter."""


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Frames of the median, aligned to the first frame of the clip."""

    row: Int[np.ndarray, "plate_samples"]
    """Which of the mask frames they are."""
    rgb: UInt8[np.ndarray, "plate_samples height width 3"]
    H_reference_frame: Float[np.ndarray, "samples 3 3"]
    """For every mask frame; identity for a static camera, NaN where it could not be registered."""


@dataclass(frozen=True, slots=True, eq=False)
class _People:
    """Masks of all mask frames, in their own pixels."""

    any_person: Bool[np.ndarray, "samples small_height small_width"]
    selected: Bool[np.ndarray, "samples small_height small_width"]


def make_background(
    clip: VideoClip, tracks: PersonTracks, config: BackgroundConfig, ctx: StageContext
) -> BackgroundImage:
    """Background image of the clip and masks of its people.

    For a moving camera the frames are aligned to the first one by a homography, which is exact for a turning camera
    only; a warning says so.

    Raises:
        InputError: the clip's video cannot be read.
    """
    from video2anim.background.background_image import inpaint_unobserved, median_background, updated_background
    from video2anim.background.person_segmentation import Raster

    raster = Raster.of_clip(clip.width_px, clip.height_px, config.long_side_px)
    frame_index = np.unique(np.r_[0 : clip.frame_count : config.frame_step, clip.frame_count - 1])
    generous = _generous_masks(tracks, frame_index, raster)
    samples = _collect(clip, frame_index, generous, config, ctx)

    excluded = _excluded(generous, samples, raster)
    median = median_background(samples.rgb, excluded)
    unseen = np.all(excluded, axis=0)
    model = None if config.segment_model == NO_MODEL else ctx.model(config.segment_model)
    known = (inpaint_unobserved(median, unseen), ~unseen)
    people = _masks(clip, tracks, frame_index, samples, known, raster, model, ctx)

    sharper = _excluded(_grown(people.any_person, tracks, frame_index, raster), samples, raster)
    unseen = np.all(sharper, axis=0)
    background = inpaint_unobserved(updated_background(median, samples.rgb, excluded, sharper), unseen)
    seen_ratio = 1.0 - sharper.mean(axis=0, dtype=np.float32)
    _report(clip, samples, unseen, people, ctx)
    return BackgroundImage(
        background_rgb=background,
        seen_ratio=seen_ratio.astype(np.float32),
        frame_index=frame_index,
        person_mask=people.any_person,
        selected_mask=people.selected,
    )


def _mask_frames(clip: VideoClip, frame_index: Int[np.ndarray, "samples"]) -> Iterator[np.ndarray]:
    """Pictures of the mask frames, in one decode but for the last one."""
    from video2anim.video import read_frames

    step = int(frame_index[1]) if len(frame_index) > 1 else 1
    regular = frame_index % step == 0
    yield from read_frames(clip, 0, int(frame_index[regular][-1]) + 1, step)
    if not regular[-1]:
        yield from read_frames(clip, int(frame_index[-1]))


def _generous_masks(
    tracks: PersonTracks, frame_index: Int[np.ndarray, "samples"], raster: Raster
) -> Bool[np.ndarray, "samples small_height small_width"]:
    """Everything that may be a person, with a margin."""
    from video2anim.background.person_segmentation import dilated, person_probability

    masks = np.zeros((len(frame_index), raster.height_px, raster.width_px), bool)
    for row, frame in enumerate(frame_index):
        for track in tracks.people:
            seen = track.row(int(frame))
            if seen is not None:
                likely = person_probability(track, int(frame), raster) > 0.25
                masks[row] |= dilated(likely, _margin_px(track.box_px[seen], raster, 0.04))
    return masks


def _grown(
    masks: Bool[np.ndarray, "samples small_height small_width"],
    tracks: PersonTracks,
    frame_index: Int[np.ndarray, "samples"],
    raster: Raster,
) -> Bool[np.ndarray, "samples small_height small_width"]:
    """Sharp masks, joined with the model's own, with a small margin."""
    from video2anim.background.person_segmentation import dilated, person_probability

    grown = masks.copy()
    for row, frame in enumerate(frame_index):
        for track in tracks.people:
            seen = track.row(int(frame))
            if seen is not None:
                mask = masks[row] | (person_probability(track, int(frame), raster) > 0.5)
                grown[row] |= dilated(mask, _margin_px(track.box_px[seen], raster, 0.015))
    return grown


def _margin_px(box_px: Float[np.ndarray, "4"], raster: Raster, ratio: float) -> int:
    """Share of a person's longer side, in reduced pixels, at least 2."""
    return max(2, round(ratio * raster.scale_y * float(max(box_px[2:] - box_px[:2]))))


def _collect(
    clip: VideoClip,
    frame_index: Int[np.ndarray, "samples"],
    person: Bool[np.ndarray, "samples small_height small_width"],
    config: BackgroundConfig,
    ctx: StageContext,
) -> _Samples:
    """Read and align the frames of the median."""
    import cv2

    from video2anim.camera.background_registration import BackgroundRegistration

    count = len(frame_index)
    affordable = max(_FEWEST_SAMPLES, _SAMPLE_BYTES // (3 * clip.width_px * clip.height_px))
    wanted = np.unique(np.linspace(0, count - 1, min(count, config.max_samples, affordable)).round().astype(int))
    H_reference_frame = np.tile(np.eye(3), (count, 1, 1))
    rgb = np.zeros((len(wanted), clip.height_px, clip.width_px, 3), np.uint8)
    rows: list[int] = []
    registration: BackgroundRegistration | None = None
    for row, picture in enumerate(_mask_frames(clip, frame_index)):
        ctx.progress(row + 1, 2 * count)
        if not clip.camera_is_static:
            size = (clip.width_px, clip.height_px)
            ground = 255 - cv2.resize(person[row].astype(np.uint8) * 255, size, interpolation=cv2.INTER_NEAREST)
            if registration is None:
                registration = BackgroundRegistration(picture, ground)
            else:
                found = registration.register(picture, ground)
                H_reference_frame[row] = np.nan if found is None else found.H_reference_frame
        if row in wanted and np.isfinite(H_reference_frame[row]).all():
            rgb[len(rows)] = picture if registration is None else _aligned(picture, H_reference_frame[row])
            rows.append(row)
    return _Samples(np.array(rows), rgb[: len(rows)], H_reference_frame)


def _aligned(rgb: UInt8[np.ndarray, "height width 3"], H: Float[np.ndarray, "3 3"]) -> np.ndarray:
    import cv2

    return cv2.warpPerspective(rgb, H, (rgb.shape[1], rgb.shape[0]), flags=cv2.INTER_LINEAR)


def _excluded(
    person: Bool[np.ndarray, "samples small_height small_width"], samples: _Samples, raster: Raster
) -> Bool[np.ndarray, "plate_samples small_height small_width"]:
    """What the median leaves out of each of its samples: people, and what lies outside an aligned frame."""
    import cv2

    excluded = person[samples.row].copy()
    for k, row in enumerate(samples.row):
        H = samples.H_reference_frame[row]
        if not np.array_equal(H, np.eye(3)):
            H_small = raster.T_small_image @ H @ np.linalg.inv(raster.T_small_image)
            free = cv2.warpPerspective(
                1.0 - excluded[k].astype(np.float32), H_small, (raster.width_px, raster.height_px)
            )
            excluded[k] = free < 0.99
    return excluded


def _masks(
    clip: VideoClip,
    tracks: PersonTracks,
    frame_index: Int[np.ndarray, "samples"],
    samples: _Samples,
    background_known: tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "small_height small_width"]],
    raster: Raster,
    model: SegmentModel | None,
    ctx: StageContext,
) -> _People:
    """Masks by figure and ground, and by what a network sees."""
    from video2anim.background.person_segmentation import lab_difference, person_probability, refine_mask

    shape = (len(frame_index), raster.height_px, raster.width_px)
    people = _People(np.zeros(shape, bool), np.zeros(shape, bool))
    small_background, known = raster.reduce(background_known[0]), background_known[1]
    main_id = tracks.selected_ids[0] if tracks.selected_ids else None
    nobody = np.zeros(shape[1:], np.float32)
    for row, (frame, picture) in enumerate(zip(frame_index, _mask_frames(clip, frame_index), strict=True)):
        ctx.progress(shape[0] + row + 1, 2 * shape[0])
        by_id = {t.person_id: person_probability(t, int(frame), raster) for t in tracks.people}
        main = nobody if main_id is None else by_id.pop(main_id, nobody)
        others = np.max([nobody, *by_id.values()], axis=0)
        ground, ground_known = _background_in_frame(small_background, known, samples.H_reference_frame[row], raster)
        difference = lab_difference(raster.reduce(picture), ground)
        named = None if model is None else _named_people(model, picture, raster)
        people.any_person[row] = refine_mask(np.maximum(main, others), difference, ground_known, named)
        people.selected[row] = refine_mask(main, difference, ground_known, named) & (main >= others)
        people.any_person[row] |= people.selected[row]
    return people


def _named_people(
    model: SegmentModel, picture: UInt8[np.ndarray, "height width 3"], raster: Raster
) -> Bool[np.ndarray, "small_height small_width"]:
    """Where the network sees people, on the reduced picture."""
    import cv2

    from video2anim.networks.segmentation import CLASSES

    semantic = model.segment(raster.reduce(picture)).semantic
    size = (raster.width_px, raster.height_px)
    return cv2.resize(semantic, size, interpolation=cv2.INTER_NEAREST) == CLASSES.index("person")


def _background_in_frame(
    small_background: UInt8[np.ndarray, "small_height small_width 3"],
    known: Bool[np.ndarray, "small_height small_width"],
    H_reference_frame: Float[np.ndarray, "3 3"],
    raster: Raster,
) -> tuple[UInt8[np.ndarray, "small_height small_width 3"], Bool[np.ndarray, "small_height small_width"]]:
    """The background image as this frame's camera sees it, and where it is known."""
    import cv2

    if np.array_equal(H_reference_frame, np.eye(3)):
        return small_background, known
    if not np.isfinite(H_reference_frame).all():
        return small_background, np.zeros_like(known)
    H_small = np.linalg.inv(raster.T_small_image @ H_reference_frame @ np.linalg.inv(raster.T_small_image))
    size = (raster.width_px, raster.height_px)
    moved_known = cv2.warpPerspective(known.astype(np.float32), H_small, size) > 0.99
    return cv2.warpPerspective(small_background, H_small, size), moved_known


def _report(
    clip: VideoClip,
    samples: _Samples,
    unseen: Bool[np.ndarray, "small_height small_width"],
    people: _People,
    ctx: StageContext,
) -> None:
    ctx.quality("background_unobserved", float(unseen.mean()), "ratio", "lower")
    ctx.quality("background_samples", len(samples.row), "count")
    ctx.quality("person_area", float(people.any_person.mean()), "ratio")
    ctx.quality("main_person_area", float(people.selected.mean()), "ratio")
    if not clip.camera_is_static:
        lost = int(np.isnan(samples.H_reference_frame[:, 0, 0]).sum())
        ctx.warn(
            "the camera moves: the background image is aligned to the first frame by a homography"
            + (f"; {lost} of {len(samples.H_reference_frame)} sampled frames could not be aligned" if lost else "")
        )
    if unseen.mean() > 0.02:
        ctx.warn(
            f"{100 * unseen.mean():.0f} % of the background is never seen (people cover it throughout); "
            "the background image is painted there"
        )


STAGE = StageSpec("background", make_background, version=3, models=("segment",))
