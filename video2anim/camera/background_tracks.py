"""Points of the background tracked from frame to frame (pyramidal Lucas-Kanade flow on Shi-Tomasi corners), and whether
the camera moves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.background.person_masks import generous_masks
from video2anim.background.person_segmentation import Raster
from video2anim.types import PersonTracks, VideoClip
from video2anim.video import read_frames

STATIC_DRIFT_RATIO = 0.005
"""A camera is static if its background drifts by at most this share of the image width."""
MIN_POINTS = 12
"""Least points that locate a frame: twice those that determine it without errors."""
_MASK_SIDE_PX = 384
"""Long side of the masks of people, the working size of stage background."""
_GRID = 4
"""Cells of the image across and down, of which each has as many points and says how far it drifts."""
_STILL_PERCENT = 25
"""Cells of which at most so many stay where they are while the camera moves."""
_COARSE_STEPS = 20
"""Steps over the clip after which a camera that has not moved is static; otherwise every frame is looked at."""

_WORK_SIDE_PX = 960
"""Long side of the image in which points are tracked."""
_POINTS = 500
"""Points that are tracked at a time. New ones are added when a quarter of them is lost."""
_SPACING_RATIO = 0.015
"""Distance between points, as a share of the long side: 500 of them fill half of an image of 4:3."""
_CORNER_QUALITY = 0.003
"""Least eigenvalue of the structure tensor over the largest in the image: corners of dim regions count too."""
_WINDOW_PX, _PYRAMID_LEVELS = 21, 4
"""Of the flow, at the working resolution: motion up to 160 px a frame."""
_ROUND_TRIP_PX = 0.7
"""A point is lost if the flow to the next frame and back misses it by more."""


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundTracks:
    """Observations of tracked points, sorted by frame."""

    frame: Int[np.ndarray, "observations"]
    point: Int[np.ndarray, "observations"]
    pixel: Float[np.ndarray, "observations 2"]
    """In pixels of the clip."""


def track_background(
    images: Iterable[UInt8[np.ndarray, "height width 3"]],
    people: Iterable[Bool[np.ndarray, "small_height small_width"]],
) -> BackgroundTracks:
    """Track corners through consecutive frames.

    Args:
        images: All frames of the clip (RGB).
        people: For each of them, where no point may be.
    """
    frames, points, pixels = [], [], []
    tracker = _Tracker()
    for number, (image, person) in enumerate(zip(images, people, strict=True)):
        point, pixel = tracker.step(image, person)
        frames.append(np.full(len(point), number))
        points.append(point)
        pixels.append(pixel)
    return BackgroundTracks(np.concatenate(frames), np.concatenate(points), np.concatenate(pixels))


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundMotion:
    """What the background shows of a camera's motion."""

    tracks: BackgroundTracks
    """In all frames; in a few, spread over the clip, if the camera is static."""
    drift_ratio: float
    """Largest displacement of points since they were first seen, as a share of the image width; NaN if the background
    has too little texture."""

    @property
    def is_static(self) -> bool:
        """Whether the camera is; one of which nothing is known counts as static."""
        return not self.drift_ratio > STATIC_DRIFT_RATIO

    def warnings(self) -> list[str]:
        """What a user should know of it."""
        if np.isnan(self.drift_ratio):
            return ["camera motion is unknown (too little background texture); the camera is taken as static"]
        if self.is_static:
            return []
        return [
            f"the camera moves: the background drifts by {100 * self.drift_ratio:.1f} % of the image width "
            f"(static: below {100 * STATIC_DRIFT_RATIO:.1f} %); its path is estimated, and the scene is what the first "
            "frame shows"
        ]


def background_motion(clip: VideoClip, people: PersonTracks) -> BackgroundMotion:
    """Track the background of a clip, and measure how far it drifts.

    Raises:
        InputError: the clip's video cannot be read.
    """
    coarse = max(1, (clip.frame_count - 1) // _COARSE_STEPS)
    found, followed = _motion_by_steps(clip, people, coarse)
    if coarse > 1 and not (followed and found.is_static):
        found, _ = _motion_by_steps(clip, people, 1)
    return found


def _motion_by_steps(clip: VideoClip, people: PersonTracks, step: int) -> tuple[BackgroundMotion, bool]:
    """The motion over every `step`-th frame, and whether each shows enough of the points before."""
    tracks = track_background(read_frames(clip, step=step), _people_masks(clip, people, step))
    drift_px, followed = _drift(tracks, np.array([clip.width_px, clip.height_px]))
    return BackgroundMotion(tracks, float(drift_px / clip.width_px)), followed


def _people_masks(clip: VideoClip, people: PersonTracks, step: int) -> Iterator[np.ndarray]:
    raster = Raster.of_clip(clip.width_px, clip.height_px, _MASK_SIDE_PX)
    for frame in range(0, clip.frame_count, step):
        yield generous_masks(people, np.array([frame]), raster)[0]


def _drift(tracks: BackgroundTracks, size_px: Int[np.ndarray, "2"]) -> tuple[float, bool]:
    """Largest displacement of points since they were first seen, in pixels, and whether every next frame shows at least
    a quarter of them.

    Of each cell of a grid the median vector counts: errors of points on little texture cancel. A camera moves the whole
    picture, so three quarters of the cells have to move as far: people fill few cells, and what seems to move on a
    plain backdrop less than half of them (real clips: 0.2 % of the width and less of still cameras, 0.7 % and more of
    others; a script that is not kept). Frames with points in fewer than half of the cells tell nothing.
    """
    _, first, of = np.unique(tracks.point, return_index=True, return_inverse=True)
    moved_px = tracks.pixel - tracks.pixel[first[of]]
    old = tracks.frame > tracks.frame[first[of]]
    cell = _cell(tracks.pixel, size_px)
    begin = np.searchsorted(tracks.frame, np.arange(tracks.frame.max(initial=-1) + 2))
    drifts, followed, before = [], True, 0
    for own in map(slice, begin[:-1], begin[1:]):
        found, where = moved_px[own][old[own]], cell[own][old[own]]
        followed &= 4 * len(found) >= before
        before = own.stop - own.start
        cells = np.unique(where)
        if 2 * len(cells) >= _GRID**2:
            each = [np.median(found[where == one], axis=0) for one in cells]
            drifts.append(np.percentile(np.linalg.norm(each, axis=1), _STILL_PERCENT))
    return float(max(drifts, default=np.nan)), followed and len(drifts) > 0


def _cell(pixel: Float[np.ndarray, "points 2"], size_px: Int[np.ndarray, "2"]) -> Int[np.ndarray, "points"]:
    """Cell of the grid that each point is in."""
    return (pixel / size_px * _GRID).astype(int) @ [1, _GRID]


def _first_of_each(group: Int[np.ndarray, "items"], most: int) -> Int[np.ndarray, "kept"]:
    """The first so many items of every group."""
    order = np.argsort(group, kind="stable")
    _, begin, count = np.unique(group[order], return_index=True, return_counts=True)
    rank = np.arange(len(group)) - np.repeat(begin, count)
    return np.sort(order[rank < most])


class _Tracker:
    """The points of the last frame, at the working resolution."""

    def __init__(self) -> None:
        self._image: np.ndarray | None = None
        self._at = np.zeros((0, 2), np.float32)
        self._point = np.zeros(0, int)
        self._made = 0

    def step(self, rgb: np.ndarray, person: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers and pixels (of the clip) of the points in the next frame."""
        scale = min(1.0, _WORK_SIDE_PX / max(rgb.shape[:2]))
        size = (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale))
        image = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        free = cv2.resize(person.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
        if self._image is not None and len(self._at):
            self._follow(self._image, image, free)
        if len(self._at) < 0.75 * _POINTS:
            self._add(image, free)
        self._image = image
        return self._point.copy(), (self._at.astype(np.float64) + 0.5) / (np.array(size) / rgb.shape[1::-1]) - 0.5

    def _follow(self, before: np.ndarray, after: np.ndarray, free: np.ndarray) -> None:
        moved, found = _flow(before, after, self._at)
        back, found_back = _flow(after, before, moved)
        kept = found & found_back
        kept &= np.linalg.norm(back - self._at, axis=1) < _ROUND_TRIP_PX
        # Windows that reach over the border are matched worse.
        cell, border_px = np.round(moved).astype(int), _WINDOW_PX // 2
        kept &= ((cell >= border_px) & (cell < np.array(after.shape[::-1]) - border_px)).all(1)
        kept[kept] &= free[cell[kept, 1], cell[kept, 0]]
        self._at, self._point = moved[kept], self._point[kept]

    def _add(self, image: np.ndarray, free: np.ndarray) -> None:
        spacing = max(3.0, _SPACING_RATIO * max(image.shape))
        allowed = free.astype(np.uint8)
        for x, y in np.round(self._at).astype(int):
            cv2.circle(allowed, (int(x), int(y)), int(spacing), 0, -1)
        corners = cv2.goodFeaturesToTrack(image, 0, _CORNER_QUALITY, spacing, mask=allowed)
        if corners is None:
            return
        # The strongest of each cell: else something with much texture would have all of them.
        both = np.concatenate([self._at, corners[:, 0].astype(np.float32)])
        kept = _first_of_each(_cell(both, np.array(image.shape[::-1])), _POINTS // _GRID**2)
        new = both[kept[kept >= len(self._at)]]
        self._at = np.concatenate([self._at, new])
        self._point = np.r_[self._point, self._made + np.arange(len(new))]
        self._made += len(new)


def _flow(before: np.ndarray, after: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points move to, and which are found there."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, at, np.empty_like(at), winSize=(_WINDOW_PX, _WINDOW_PX), maxLevel=_PYRAMID_LEVELS
    )
    return moved, found.ravel() > 0
