"""Person masks of the sampled frames, and what they exclude from the background image."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.background.person_segmentation import (
    Raster,
    lab_difference,
    person_probability,
    refine_mask,
)
from video2anim.geometry.masks import dilated
from video2anim.types import PersonTracks, VideoClip
from video2anim.video import read_frames


@dataclass(frozen=True, slots=True, eq=False)
class MedianSamples:
    """Frames of the median, aligned to the first frame of the clip."""

    row: Int[np.ndarray, "median_samples"]
    """Which of the mask frames they are."""
    rgb: UInt8[np.ndarray, "median_samples height width 3"]
    H_first_frame: Float[np.ndarray, "samples 3 3"]
    """For every mask frame; identity for a static camera, NaN where it shows another perspective."""


@dataclass(frozen=True, slots=True, eq=False)
class PeopleMasks:
    """Masks of all mask frames, in their own pixels."""

    any_person: Bool[np.ndarray, "samples small_height small_width"]
    selected: Bool[np.ndarray, "samples small_height small_width"]


def mask_frames(clip: VideoClip, frame_index: Int[np.ndarray, "samples"]) -> Iterator[np.ndarray]:
    """Images of the mask frames, in one pass and, if it is off the regular step, another one for the last."""
    step = int(frame_index[1]) if len(frame_index) > 1 else 1
    regular = frame_index % step == 0
    yield from read_frames(clip, 0, int(frame_index[regular][-1]) + 1, step)
    if not regular[-1]:
        yield from read_frames(clip, int(frame_index[-1]))


def generous_masks(
    tracks: PersonTracks, frame_index: Int[np.ndarray, "samples"], raster: Raster
) -> Bool[np.ndarray, "samples small_height small_width"]:
    """Pixels that may be a person, with a margin."""
    masks = np.zeros((len(frame_index), raster.height_px, raster.width_px), bool)
    for row, frame in enumerate(frame_index):
        for track in tracks.people:
            seen = track.row(int(frame))
            if seen is not None:
                likely = person_probability(track, int(frame), raster) > 0.25
                masks[row] |= dilated(likely, _margin_px(track.box_px[seen], raster, 0.04))
    return masks


def grown_masks(
    masks: Bool[np.ndarray, "samples small_height small_width"],
    tracks: PersonTracks,
    frame_index: Int[np.ndarray, "samples"],
    raster: Raster,
) -> Bool[np.ndarray, "samples small_height small_width"]:
    """Union of the refined masks and the model's own, with a small margin."""
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


def aligned(rgb: UInt8[np.ndarray, "height width 3"], H: Float[np.ndarray, "3 3"]) -> np.ndarray:
    """An image warped into the first frame by a homography."""
    return cv2.warpPerspective(rgb, H, (rgb.shape[1], rgb.shape[0]), flags=cv2.INTER_LINEAR)


def excluded_from_median(
    person: Bool[np.ndarray, "samples small_height small_width"], samples: MedianSamples, raster: Raster
) -> Bool[np.ndarray, "median_samples small_height small_width"]:
    """Pixels that the median excludes from each of its samples: people, and what is outside of an aligned frame."""
    excluded = person[samples.row].copy()
    for k, row in enumerate(samples.row):
        H = samples.H_first_frame[row]
        if not np.array_equal(H, np.eye(3)):
            H_small = raster.T_small_image @ H @ np.linalg.inv(raster.T_small_image)
            free = cv2.warpPerspective(
                1.0 - excluded[k].astype(np.float32), H_small, (raster.width_px, raster.height_px)
            )
            excluded[k] = free < 0.99
    return excluded


def people_masks(
    clip: VideoClip,
    tracks: PersonTracks,
    frame_index: Int[np.ndarray, "samples"],
    samples: MedianSamples,
    background_known: tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "small_height small_width"]],
    raster: Raster,
    on_row: Callable[[int], None],
) -> PeopleMasks:
    """Masks by the person model and the difference from the background."""
    shape = (len(frame_index), raster.height_px, raster.width_px)
    people = PeopleMasks(np.zeros(shape, bool), np.zeros(shape, bool))
    small_background, known = raster.reduce(background_known[0]), background_known[1]
    main_id = tracks.selected_ids[0] if tracks.selected_ids else None
    nobody = np.zeros(shape[1:], np.float32)
    for row, (frame, picture) in enumerate(zip(frame_index, mask_frames(clip, frame_index), strict=True)):
        on_row(row)
        by_id = {t.person_id: person_probability(t, int(frame), raster) for t in tracks.people}
        main = nobody if main_id is None else by_id.pop(main_id, nobody)
        others = np.max([nobody, *by_id.values()], axis=0)
        ground, ground_known = _background_in_frame(small_background, known, samples.H_first_frame[row], raster)
        difference = lab_difference(raster.reduce(picture), ground)
        people.any_person[row] = refine_mask(np.maximum(main, others), difference, ground_known)
        people.selected[row] = refine_mask(main, difference, ground_known) & (main >= others)
        people.any_person[row] |= people.selected[row]
    return people


def _background_in_frame(
    small_background: UInt8[np.ndarray, "small_height small_width 3"],
    known: Bool[np.ndarray, "small_height small_width"],
    H_first_frame: Float[np.ndarray, "3 3"],
    raster: Raster,
) -> tuple[UInt8[np.ndarray, "small_height small_width 3"], Bool[np.ndarray, "small_height small_width"]]:
    """The background image warped into the frame, and where it is known."""
    if np.array_equal(H_first_frame, np.eye(3)):
        return small_background, known
    if not np.isfinite(H_first_frame).all():
        return small_background, np.zeros_like(known)
    H_small = np.linalg.inv(raster.T_small_image @ H_first_frame @ np.linalg.inv(raster.T_small_image))
    size = (raster.width_px, raster.height_px)
    moved_known = cv2.warpPerspective(known.astype(np.float32), H_small, size) > 0.99
    return cv2.warpPerspective(small_background, H_small, size), moved_known
