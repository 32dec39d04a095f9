"""Matches estimate and truth: frames by time, worlds by the shared camera, persons by their projected joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from video2anim.errors import InputError
from video2anim.geometry.projection import invert_rigid, project
from video2anim.lab.eval.truth import Truth
from video2anim.lab.synth.world import NEAR_M
from video2anim.types import BodyMotion, Intrinsics, VideoClip

DURATION_TOLERANCE = 0.10
"""Largest relative difference of duration or aspect ratio between a clip and its truth."""
_PERSON_REACH = 0.5
"""Largest distance of matched persons, as a share of the true person's height in the picture."""
_MATCH_STEP_FRAMES = 3


@dataclass(frozen=True, slots=True, eq=False)
class FrameMatch:
    """The true frame that each frame of the estimate shows."""

    true_index: Int[np.ndarray, "frames"]
    known: Bool[np.ndarray, "frames"]
    """Whether a true frame lies within half a frame."""


def expect_same_clip(clip: VideoClip, truth: Truth, scene_dir: str) -> None:
    """Check that the truth belongs to the clip.

    Raises:
        InputError: durations or aspect ratios differ by more than 10 %.
    """
    duration_s = clip.source.duration_s or clip.frame_count / clip.fps
    shapes = (clip.width_px / clip.height_px, truth.intrinsics.width_px / truth.intrinsics.height_px)
    for name, estimated, true, unit in (
        ("duration", duration_s, truth.duration_s, " s"),
        ("width / height", *shapes, ""),
    ):
        if abs(estimated - true) > DURATION_TOLERANCE * true:
            raise InputError(
                f"truth of another clip: {name} is {estimated:.2f}{unit} in {scene_dir} and {true:.2f}{unit} in "
                f"{truth.folder}; give the truth folder of the video that was run"
            )


def match_frames(clip: VideoClip, truth: Truth) -> FrameMatch:
    """Nearest true frame of every frame of the clip, by its time in the source video."""
    true_time_s = truth.frame_time_s
    time_s = clip.source_time_s
    right = np.clip(np.searchsorted(true_time_s, time_s), 1, max(1, len(true_time_s) - 1))
    left = right - 1
    right = np.minimum(right, len(true_time_s) - 1)
    nearer_left = np.abs(time_s - true_time_s[left]) <= np.abs(time_s - true_time_s[right])
    index = np.where(nearer_left, left, right)
    known = np.abs(time_s - true_time_s[index]) <= 0.5 / truth.fps + 1e-6
    return FrameMatch(index, known)


def truth_from_estimate(
    T_world_camera: Float[np.ndarray, "frames 4 4"], truth: Truth, frames: FrameMatch
) -> Float[np.ndarray, "4 4"]:
    """T_true_estimate: maps the estimated world to the true one so that the cameras of the first common frame coincide.

    With a fixed camera this compares everything in the camera's frame. With a moving camera both worlds coincide at the
    start, and later drift of the estimated camera counts as error.
    """
    known = np.flatnonzero(frames.known)
    first = int(known[0]) if len(known) else 0
    return truth.main.T_world_camera[frames.true_index[first]] @ invert_rigid(T_world_camera[first])


@dataclass(frozen=True, slots=True)
class PersonMatch:
    """An estimated and a true person that match, as indices into their tuples."""

    estimate: int
    truth: int
    distance_px: float


def match_people(estimates: Sequence[BodyMotion], truth: Truth, frames: FrameMatch) -> tuple[PersonMatch, ...]:
    """The assignment with the least total distance of projected joints over common frames, sorted by true person.

    Distances are in pixels of the true picture. Pairs farther apart than half the true person's height are left out.
    """
    if not estimates:
        return ()
    cost = np.full((len(estimates), len(truth.people)), np.inf)
    height_px = np.full_like(cost, np.nan)
    for i, estimate in enumerate(estimates):
        for j, person in enumerate(truth.people):
            cost[i, j], height_px[i, j] = _picture_distance(estimate, person, frames)
    allowed = cost <= _PERSON_REACH * height_px
    rows, columns = linear_sum_assignment(np.where(allowed, cost, 1e9))
    pairs = [
        PersonMatch(int(i), int(j), float(cost[i, j])) for i, j in zip(rows, columns, strict=True) if allowed[i, j]
    ]
    return tuple(sorted(pairs, key=lambda pair: pair.truth))


def _picture_distance(estimate: BodyMotion, person: BodyMotion, frames: FrameMatch) -> tuple[float, float]:
    """Mean joint distance, and median height of the true person, in true pixels; infinite without a common frame."""
    rows = np.flatnonzero(frames.known & estimate.valid & person.valid[frames.true_index])[::_MATCH_STEP_FRAMES]
    if not len(rows):
        return np.inf, np.nan
    size = person.intrinsics
    estimated, seen = _pixels(
        estimate.joints_camera_m[rows], estimate.intrinsics.resized(size.width_px, size.height_px)
    )
    true, truly_seen = _pixels(person.joints_camera_m[frames.true_index[rows]], size)
    both = seen & truly_seen
    if not both.any():
        return np.inf, np.nan
    height_px = float(np.median(np.ptp(true[..., 1], axis=1)[truly_seen.all(1)])) if truly_seen.all(1).any() else np.nan
    return float(np.linalg.norm(estimated - true, axis=-1)[both].mean()), height_px


def _pixels(points_camera_m: np.ndarray, intrinsics: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    ahead = points_camera_m[..., 2] > NEAR_M
    safe = np.where(ahead[..., None], points_camera_m, [0.0, 0.0, 1.0])
    return project(safe, intrinsics), ahead


def resample_nearest(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Nearest-neighbor resampling to `shape` (height, width): each pixel takes the value at its center."""
    rows = ((np.arange(shape[0]) + 0.5) * image.shape[0] / shape[0]).astype(np.int64)
    columns = ((np.arange(shape[1]) + 0.5) * image.shape[1] / shape[1]).astype(np.int64)
    return image[rows[:, None], columns[None, :]]


def common_maps(frame_index: np.ndarray, truth: Truth, frames: FrameMatch) -> list[tuple[int, int]]:
    """Pairs (row of the estimate's samples, row of the truth's maps) that show the same frame."""
    true_row = {int(frame): row for row, frame in enumerate(truth.label_frame_index)}
    pairs = []
    for row, frame in enumerate(frame_index):
        if frames.known[frame] and (found := true_row.get(int(frames.true_index[frame]))) is not None:
            pairs.append((row, found))
    return pairs
