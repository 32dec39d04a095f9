"""Stage 2: everybody in the clip, followed over time, with BlazePose landmarks in every frame."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from video2anim.errors import StageError, UsageError
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import PersonTrack, PersonTracks, Thumbnail, VideoClip

if TYPE_CHECKING:
    from video2anim.models.blazepose import BlazePose, PoseEstimate
    from video2anim.models.roi import SquareRoi

LANDMARKS = 33
MASK_SIZE = 64
_MIN_MEAN_SCORE = 0.7
_MIN_MEAN_VISIBILITY = 0.5
_MIN_MEAN_VISIBILITY_SHORT = 0.7
"""For tracks of less than a second, which may be a mixture of two bodies at an occlusion."""
_BETTER_VISIBILITY = 0.1
_HELD_FRAMES = 5
"""A lost person is first looked for in the crop last seen, this many frames long."""
_LOCAL_SCAN_EVERY = 3
_LOOKED_BACK = 300
"""Frames before the last one that may tell of a person's motion."""
THUMBNAIL_PX = 128
_CLEARLY = 1.1
_NO_PICTURE = np.zeros((THUMBNAIL_PX, THUMBNAIL_PX, 3), np.uint8)


@dataclass(frozen=True)
class TrackConfig:
    """Settings of the stage."""

    person: str = "largest"
    """Whom later stages work on: `largest`, `all`, or a person's ID."""
    model: str = "blazepose-heavy"
    """Landmark model of the table (`video2anim models list`)."""
    scan_every_s: float = 0.5
    """Time between searches of the whole picture for further people."""
    min_detection_score: float = 0.5
    """Detections below are not looked at, 0 to 1."""
    max_lost_s: float = 1.0
    """A person found again after at most this time keeps the ID."""
    min_track_s: float = 0.3
    """People seen for less are dropped (half the clip where it is shorter than twice this)."""


@dataclass(slots=True, eq=False)
class _Track:
    """A person in the making: estimates by frame."""

    estimates: dict[int, PoseEstimate] = field(default_factory=dict)
    best: tuple[float, int, np.ndarray] = (0.0, 0, _NO_PICTURE)
    """How well the person is seen in the best frame, its number, and the crop."""
    last_frame: int = -1

    def put(self, frame: int, found: PoseEstimate) -> None:
        """Keep what was found in a frame."""
        self.estimates[frame] = found
        self.last_frame = max(self.last_frame, frame)

    def drop(self, frame: int) -> None:
        """Forget what was found in a frame."""
        del self.estimates[frame]
        if frame == self.last_frame:
            self.last_frame = max(self.estimates, default=-1)

    @property
    def last(self) -> PoseEstimate:
        return self.estimates[self.last_frame]

    def look_at(self, frame: int, image: np.ndarray) -> None:
        """Keep the picture of a frame that shows the person clearly better than those before."""
        found = self.estimates[frame]
        seen = found.roi.side_px * float(found.visibility.mean())
        if seen > _CLEARLY * self.best[0]:
            upright = replace(found.roi, rotation_rad=0.0)
            self.best = (seen, frame, upright.crop(image, THUMBNAIL_PX))

    def velocity_px(self) -> np.ndarray:
        """Median motion of the hips per frame over the last frames, (2,)."""
        from video2anim.models.people_finder import hips_px

        last = range(self.last_frame, self.last_frame - _LOOKED_BACK, -1)
        frames = sorted([frame for frame in last if frame in self.estimates][:5])
        if len(frames) < 2:
            return np.zeros(2)
        hips = np.array([hips_px(self.estimates[frame]) for frame in frames])
        return np.median(np.diff(hips, axis=0) / np.diff(frames)[:, None], axis=0)


class _Tracker:
    """Follows everybody through the frames, given one after another."""

    def __init__(self, pose: BlazePose, config: TrackConfig, fps: float) -> None:
        self.tracks: list[_Track] = []
        self._pose, self._config = pose, config
        self._scan_every = max(1, round(config.scan_every_s * fps))
        self._max_lost = round(config.max_lost_s * fps)
        self._recent: deque[tuple[int, np.ndarray]] = deque(maxlen=self._scan_every)
        """Frames since the last scan, for the time before a person was found."""
        self._doubted: list[tuple[int, SquareRoi]] = []

    def step(self, frame: int, image: np.ndarray) -> None:
        """Take the next frame, (H, W, 3) uint8 RGB."""
        for track in self._alive(frame):
            self._follow(track, frame, image)
        self._part_duplicates(frame)
        if frame % self._scan_every == 0:
            self._scan(frame, image)
        for track in self.tracks:
            if frame in track.estimates:
                track.look_at(frame, image)
        self._recent.append((frame, image))

    def _alive(self, frame: int) -> list[_Track]:
        return [track for track in self.tracks if frame - track.last_frame <= self._max_lost]

    def _seen(self, frame: int) -> list[PoseEstimate]:
        return [track.estimates[frame] for track in self.tracks if frame in track.estimates]

    def _follow(self, track: _Track, frame: int, image: np.ndarray) -> None:
        from video2anim.models import people_finder as finder

        lost = frame - track.last_frame - 1
        if lost < _HELD_FRAMES:
            found = finder.follow(self._pose, image, track.last.next_roi)
            if found is not None:
                track.put(frame, finder.head_up(self._pose, image, found))
                return
        if lost % _LOCAL_SCAN_EVERY:
            return
        rois = finder.scan_near(self._pose, image, track.last.next_roi, min_score=self._config.min_detection_score)
        self._admit(frame, image, rois)

    def _part_duplicates(self, frame: int) -> None:
        """Where two tracks sit on one body, the one that came there from farther away loses it."""
        from video2anim.models import people_finder as finder

        here = [track for track in self.tracks if frame in track.estimates]
        for i, first in enumerate(here):
            for second in here[i + 1 :]:
                if frame not in first.estimates or frame not in second.estimates:
                    continue
                if finder.same_person(first.estimates[frame], second.estimates[frame]):
                    loser = max((first, second), key=lambda track: _surprise(track, frame))
                    loser.drop(frame)
        self.tracks = [track for track in self.tracks if track.estimates]

    def _scan(self, frame: int, image: np.ndarray) -> None:
        from video2anim.models import people_finder as finder

        rois = finder.scan(self._pose, image, min_score=self._config.min_detection_score)
        self._admit(frame, image, rois)

    def _admit(self, frame: int, image: np.ndarray, rois: list[SquareRoi]) -> None:
        """Confirm candidates that are nobody known; give them to lost tracks or to new ones."""
        from video2anim.models import people_finder as finder

        self._doubted = [(until, roi) for until, roi in self._doubted if until > frame]
        fresh: list[PoseEstimate] = []
        for roi in rois:
            known = [seen.next_roi for seen in (*self._seen(frame), *fresh)]
            if any(finder.overlaps(roi, other) for other in (*known, *(r for _, r in self._doubted))):
                continue
            found = finder.confirm(self._pose, image, roi)
            if found is None:
                self._doubted.append((frame + 2 * self._scan_every, roi))
            elif not self._is_known(found, frame, fresh):
                fresh.append(found)
        lost = [track for track in self._alive(frame) if frame not in track.estimates]
        owners = _match_lost(lost, fresh, frame, self._max_lost)
        for found, owner in zip(fresh, owners, strict=True):
            track = owner if owner is not None else _Track()
            if owner is None:
                self.tracks.append(track)
            track.put(frame, found)
            self._look_back(track, frame)

    def _is_known(self, found: PoseEstimate, frame: int, fresh: list[PoseEstimate]) -> bool:
        """Whether somebody followed already has this body; a clearly better fit then replaces that person's own."""
        from video2anim.models import people_finder as finder

        for track in self.tracks:
            own = track.estimates.get(frame)
            if own is not None and finder.same_person(found, own):
                if found.visibility.mean() > own.visibility.mean() + _BETTER_VISIBILITY:
                    track.put(frame, found)
                return True
        return any(finder.same_person(found, other) for other in fresh)

    def _look_back(self, track: _Track, frame: int) -> None:
        """Follow a person just found backwards through the frames since the last scan."""
        from video2anim.models import people_finder as finder

        for earlier, image in reversed(self._recent):
            if earlier >= frame or earlier in track.estimates:
                return
            found = finder.follow(self._pose, image, track.estimates[earlier + 1].next_roi)
            if found is None or any(finder.same_person(found, other) for other in self._seen(earlier)):
                return
            track.put(earlier, found)


def track_people(clip: VideoClip, config: TrackConfig, ctx: StageContext) -> PersonTracks:
    """Find and follow everybody in the clip.

    Landmarks are raw: nothing is smoothed and nothing is filled in; frames without a person are not valid.

    Raises:
        StageError: nobody was found.
        UsageError: `person` names nobody found.
        ModelMissingError: the models' weights cannot be had.
    """
    from video2anim.video import read_frames
    from video2anim.video.heap import pictures_apart

    tracker = _Tracker(ctx.model(config.model), config, clip.fps)
    with pictures_apart():
        for frame, image in enumerate(read_frames(clip)):
            tracker.step(frame, image)
            ctx.progress(frame + 1, clip.frame_count)
    min_frames = max(1, round(min(config.min_track_s * clip.fps, 0.5 * clip.frame_count)))
    ranked = _ranked([t for t in tracker.tracks if _is_person(t, min_frames, round(clip.fps))])
    people = tuple(_to_arrays(track, number, clip.frame_count) for number, track in enumerate(ranked, start=1))
    thumbnails = tuple(Thumbnail(number, *track.best[1:]) for number, track in enumerate(ranked, start=1))
    if not people:
        raise StageError(
            f"nobody found: want a person visible for at least {config.min_track_s:g} s, came none in "
            f"{clip.frame_count} frames of {clip.width_px}x{clip.height_px}; use a clip in which people are at "
            "least about 100 pixels tall, or lower track.min_detection_score"
        )
    selected = _select(people, config.person)
    main = next(person for person in people if person.person_id == selected[0])
    ctx.quality("people found", len(people), "", "none")
    ctx.quality("valid frames of main person", 100.0 * float(main.valid.mean()), "%", "higher")
    ctx.quality("mean score of main person", float(main.score[main.valid].mean()), "", "higher")
    if main.valid.mean() < 0.5:
        ctx.warn(f"person {main.person_id} is seen in only {100 * main.valid.mean():.0f} % of the frames")
    return PersonTracks(people=people, selected_ids=selected, frame_stride=1, thumbnails=thumbnails)


def _surprise(track: _Track, frame: int) -> float:
    """Distance of this frame's hips from where the motion before would put them, in body radii."""
    from video2anim.models.people_finder import hips_px

    before = _Track()
    for earlier in range(frame - _LOOKED_BACK, frame):
        if earlier in track.estimates:
            before.put(earlier, track.estimates[earlier])
    if not before.estimates:
        return np.inf
    predicted_px = hips_px(before.last) + (frame - before.last_frame) * before.velocity_px()
    radius_px = before.last.next_roi.radius_px
    return float(np.linalg.norm(hips_px(track.estimates[frame]) - predicted_px) / radius_px)


def _match_lost(lost: list[_Track], fresh: list[PoseEstimate], frame: int, max_lost: int) -> list[_Track | None]:
    """For each person just found the lost track it continues, by position, size and overlap, or None."""
    from scipy.optimize import linear_sum_assignment

    owners: list[_Track | None] = [None] * len(fresh)
    if not lost or not fresh:
        return owners
    cost = np.array([[_continuation_cost(track, found, frame, max_lost) for found in fresh] for track in lost])
    for row, column in zip(*linear_sum_assignment(np.minimum(cost, 1e6)), strict=True):
        if np.isfinite(cost[row, column]):
            owners[column] = lost[row]
    return owners


def _continuation_cost(track: _Track, found: PoseEstimate, frame: int, max_lost: int) -> float:
    """Distance from the predicted place in body radii plus missing box overlap; infinite where out of reach."""
    from video2anim.models.blazepose_detector import box_iou
    from video2anim.models.people_finder import hips_px

    gap = frame - track.last_frame
    moved_px = gap * track.velocity_px()
    radius_px = track.last.next_roi.radius_px
    away = float(np.linalg.norm(hips_px(found) - hips_px(track.last) - moved_px)) / radius_px
    growth = abs(np.log(found.next_roi.side_px / track.last.next_roi.side_px))
    if away > 0.8 + 2.0 * gap / max(max_lost, 1) or growth > np.log(1.6):
        return np.inf
    iou = float(box_iou(track.last.box_px() + np.tile(moved_px, 2), found.box_px()[None])[0])
    return away + growth + (1.0 - iou)


def _is_person(track: _Track, min_frames: int, sure_frames: int) -> bool:
    """Whether a track is long and convincing enough; a short appearance has to be the more convincing one."""
    estimates = track.estimates.values()
    mean_score = float(np.mean([found.presence for found in estimates]))
    mean_visibility = float(np.mean([found.visibility.mean() for found in estimates]))
    min_visibility = _MIN_MEAN_VISIBILITY if len(estimates) >= sure_frames else _MIN_MEAN_VISIBILITY_SHORT
    return len(estimates) >= min_frames and mean_score >= _MIN_MEAN_SCORE and mean_visibility >= min_visibility


def _ranked(tracks: list[_Track]) -> list[_Track]:
    """By mean box area over the whole clip, largest first; persons are numbered so."""
    return sorted(tracks, key=lambda track: -sum(_area(found) for found in track.estimates.values()))


def _area(found: PoseEstimate) -> float:
    x0, y0, x1, y1 = found.box_px()
    return float((x1 - x0) * (y1 - y0))


def _to_arrays(track: _Track, person_id: int, frame_count: int) -> PersonTrack:
    valid = np.zeros(frame_count, bool)
    score = np.full(frame_count, np.nan)
    box_px = np.full((frame_count, 4), np.nan)
    landmarks_px = np.full((frame_count, LANDMARKS, 2), np.nan)
    landmarks_m = np.full((frame_count, LANDMARKS, 3), np.nan)
    visibility = np.full((frame_count, LANDMARKS), np.nan)
    mask_crop = np.zeros((frame_count, MASK_SIZE, MASK_SIZE), np.uint8)
    T_image_crop = np.full((frame_count, 2, 3), np.nan)
    for frame, found in track.estimates.items():
        valid[frame] = True
        score[frame], visibility[frame], mask_crop[frame] = (
            found.presence,
            found.visibility,
            found.mask_crop,
        )
        box_px[frame], T_image_crop[frame] = found.box_px(), found.roi.T_image_crop()
        landmarks_px[frame], landmarks_m[frame] = found.landmarks_px, found.landmarks_m
    return PersonTrack(
        person_id,
        valid,
        score,
        box_px,
        landmarks_px,
        landmarks_m,
        visibility,
        mask_crop,
        T_image_crop,
    )


def _select(people: tuple[PersonTrack, ...], wanted: str) -> tuple[int, ...]:
    """IDs that `wanted` names; `people` are sorted, largest first."""
    ids = tuple(person.person_id for person in people)
    match wanted:
        case "largest":
            return ids[:1]
        case "all":
            return ids
        case _ if wanted.strip().isdigit() and int(wanted) in ids:
            return (int(wanted),)
    found = ", ".join(str(i) for i in ids)
    raise UsageError(f"--person {wanted}: want `largest`, `all` or one of the IDs found: {found}")


STAGE = StageSpec("track", track_people, version=4, models=("pose",))
