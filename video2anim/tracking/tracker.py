"""Tracking of everybody in a clip: crops from frame to frame, identities by position, motion and appearance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from video2anim.networks.blazepose import BlazePose, PoseEstimate
from video2anim.networks.blazepose_detector import box_iou
from video2anim.networks.roi import SquareRoi
from video2anim.tracking import person_detection as finder
from video2anim.tracking.appearance import AppearanceDescriptor, clothing_histogram
from video2anim.tracking.sides import is_turned
from video2anim.types import PersonTrack

if TYPE_CHECKING:
    from video2anim.networks.objectron import ObjectFinder

_HELD_FRAMES = 5
"""Frames for which a lost person is searched in the last crop. Not measured."""
THUMBNAIL_PX = 128
"""Side of the pictures of people in the report."""
_OTHER_CLOTHING, _SAME_CLOTHING, _DISTINCT = 0.7, 0.3, 0.1
"""Appearance distances (`benchmarks/appearance.py`). Above the first, a person is not the same after a short loss.
Below the second, it may be after a long one, unless another person is within the third of that distance."""


@dataclass(slots=True, eq=False)
class Track:
    """A person's estimates by frame, while tracking."""

    estimates: dict[int, PoseEstimate] = field(default_factory=dict)
    best: tuple[float, int, np.ndarray] = (0.0, 0, np.zeros(0, np.uint8))
    """Score of the best view of the person, its frame, and the crop; empty before the first."""
    last_frame: int = -1
    looks: AppearanceDescriptor | None = None
    """Colors of the clothes, None before the first was seen."""

    def put(self, frame: int, found: PoseEstimate) -> None:
        """Add the estimate of a frame."""
        self.estimates[frame] = found
        self.last_frame = max(self.last_frame, frame)

    def drop(self, frame: int) -> None:
        """Remove the estimate of a frame."""
        del self.estimates[frame]
        if frame == self.last_frame:
            self.last_frame = max(self.estimates, default=-1)

    @property
    def last(self) -> PoseEstimate:
        return self.estimates[self.last_frame]

    def look_at(self, frame: int, image: np.ndarray) -> None:
        """Keep the crop of a frame whose score is higher than those before."""
        found = self.estimates[frame]
        seen = found.roi.side_px * float(found.visibility.mean())
        if seen > self.best[0]:
            upright = replace(found.roi, rotation_rad=0.0)
            self.best = (seen, frame, upright.crop(image, THUMBNAIL_PX))

    def see_clothing(self, frame: int, image: np.ndarray) -> None:
        """Add the appearance in a frame in which nobody else is near."""
        found = self.estimates[frame]
        self.looks = self.looks or AppearanceDescriptor()
        self.looks.add(clothing_histogram(image, found.landmarks_px, found.visibility))

    def appearance_distance(self, other: AppearanceDescriptor | None) -> float:
        """Distance of the clothes, NaN where unknown."""
        return self.looks.distance(other) if self.looks is not None and other is not None else float("nan")

    def velocity_px(self) -> np.ndarray:
        """Median motion of the hips per frame over the last pictures, (2,)."""
        of = self.estimates
        frames = [frame for frame in sorted(of) if of.get(frame - 1) is not of[frame]][-5:]
        if len(frames) < 2:
            return np.zeros(2)
        hips = np.array([finder.hips_px(self.estimates[frame]) for frame in frames])
        return np.median(np.diff(hips, axis=0) / np.diff(frames)[:, None], axis=0)

    def rows(self, person_id: int, width_px: int, height_px: int) -> PersonTrack:
        """Rows from the first frame to the last that shows the person.

        What is outside the picture of this size is not visible, however sure of it the landmark model is, and a
        landmark of which it contradicts itself counts less: half where its two answers are `MAX_DISAGREEMENT` apart.
        """
        first = min(self.estimates)
        one = self.estimates[first]
        count = max(self.estimates) - first + 1
        valid = np.zeros(count, bool)
        score = np.full(count, np.nan)
        box_px = np.full((count, 4), np.nan)
        landmarks_px = np.full((count, *one.landmarks_px.shape), np.nan)
        landmarks_m = np.full((count, *one.landmarks_m.shape), np.nan)
        visibility = np.full((count, *one.visibility.shape), np.nan)
        mask_crop = np.zeros((count, *one.mask_crop.shape), np.uint8)
        T_image_crop = np.full((count, 2, 3), np.nan)
        for frame, found in self.estimates.items():
            row = frame - first
            valid[row] = True
            inside = ((found.landmarks_px >= 0) & (found.landmarks_px <= (width_px, height_px))).all(-1)
            agreement = 1.0 / (1.0 + (found.disagreement / finder.MAX_DISAGREEMENT) ** 2)
            score[row], visibility[row] = found.presence, np.where(inside, found.visibility * agreement, 0.0)
            mask_crop[row] = found.mask_crop
            box_px[row], T_image_crop[row] = found.box_px(), found.roi.T_image_crop()
            landmarks_px[row], landmarks_m[row] = found.landmarks_px, found.landmarks_m
        return PersonTrack(
            person_id, valid, score, box_px, landmarks_px, landmarks_m, visibility, mask_crop, T_image_crop, first
        )


class Tracker:
    """Follows everybody through the frames, given one after another, and then back to before they were found.

    Args:
        pose: detector and landmark network.
        fps: frames per second.
        scan_every_s: time between searches of the whole picture for further people.
        max_lost_s: time after which somebody lost is no longer looked for.
        min_detection_score: detections below are not looked at.
        objects: second detector of people; None to do without.
    """

    def __init__(
        self,
        pose: BlazePose,
        fps: float,
        *,
        scan_every_s: float,
        max_lost_s: float,
        min_detection_score: float,
        objects: ObjectFinder | None = None,
    ) -> None:
        self.tracks: list[Track] = []
        self._pose, self._min_detection_score, self._objects = pose, min_detection_score, objects
        self._scan_every, self._next_scan = max(1, round(scan_every_s * fps)), 0
        self._max_lost = round(max_lost_s * fps)
        self._doubted: list[tuple[int, SquareRoi]] = []

    def step(self, frame: int, image: np.ndarray) -> None:
        """Take the next frame, (H, W, 3) uint8 RGB."""
        for track in self._alive(frame):
            self._follow(track, frame, image)
        self._part_duplicates(frame)
        if frame >= self._next_scan:
            self._next_scan = frame + self._scan_every
            self._scan(frame, image)
        here = [track for track in self.tracks if frame in track.estimates]
        for track in here:
            track.look_at(frame, image)
            if not any(_near(track, other, frame) for other in here if other != track):
                track.see_clothing(frame, image)

    def repeat(self, frame: int) -> None:
        """Take the next frame, which shows the same picture as the one before."""
        for track in self.tracks:
            if frame - 1 in track.estimates:
                track.put(frame, track.estimates[frame - 1])

    def may_step_back(self, frames: range) -> bool:
        """Whether somebody is seen after one of these frames but not in it, or seen better than in it."""
        return any(_is_seen_better(track, frame) for track in self.tracks for frame in frames)

    def step_back(self, frame: int, image: np.ndarray, *, same_picture: bool = False) -> None:
        """Follow back whoever is seen in the next frame but not in this one, or seen better: to be known, people need
        to be seen better than to be followed, and a crop that has slid off finds its way back only later.

        Called after all frames have been taken, from the last to the first.

        Args:
            same_picture: the next frame shows it too.
        """
        for track in self.tracks:
            if not _is_seen_better(track, frame):
                continue
            own, later = track.estimates.get(frame), track.estimates[frame + 1]
            found = later if same_picture else finder.follow(self._pose, image, later)
            others = [seen for seen in self._seen(frame) if seen is not own]
            if found is None or any(finder.same_person(found, other) for other in others):
                continue
            if own is None or finder.is_better(found, own) or found.doubt < own.doubt:
                track.put(frame, found)

    def _alive(self, frame: int) -> list[Track]:
        return [track for track in self.tracks if frame - track.last_frame <= self._max_lost]

    def _seen(self, frame: int) -> list[PoseEstimate]:
        return [track.estimates[frame] for track in self.tracks if frame in track.estimates]

    def _follow(self, track: Track, frame: int, image: np.ndarray) -> None:
        lost = frame - track.last_frame - 1
        if lost < _HELD_FRAMES:
            found = finder.follow(self._pose, image, track.last)
            if found is not None:
                track.put(frame, found)
                return
        rois = finder.scan_near(self._pose, image, track.last.next_roi, min_score=self._min_detection_score)
        self._admit(frame, image, rois)

    def _part_duplicates(self, frame: int) -> None:
        """Where two tracks are on one body, the one that moved there from farther away loses it."""
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
        rois = finder.scan(self._pose, image, min_score=self._min_detection_score, objects=self._objects)
        self._admit(frame, image, rois)
        for track in self.tracks:
            if frame in track.estimates:
                others = [seen for seen in self._seen(frame) if seen is not track.estimates[frame]]
                track.put(frame, finder.whole(self._pose, image, track.estimates[frame], others))

    def _admit(self, frame: int, image: np.ndarray, rois: list[SquareRoi]) -> None:
        """Confirm candidates that are not tracked yet; assign them to lost tracks or to new ones."""
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
        owners = _match_lost(lost, fresh, _looks(image, fresh), frame, self._max_lost)
        for found, owner in zip(fresh, owners, strict=True):
            track = owner if owner is not None else Track()
            if owner is None:
                self.tracks.append(track)
            track.put(frame, found)

    def _is_known(self, found: PoseEstimate, frame: int, fresh: list[PoseEstimate]) -> bool:
        """Whether a track already has this body, or one of `fresh`; a better estimate replaces theirs."""
        for track in self.tracks:
            own = track.estimates.get(frame)
            if own is not None and finder.same_person(found, own):
                if finder.is_better(found, own):
                    track.put(frame, found)
                return True
        for number, other in enumerate(fresh):
            if finder.same_person(found, other):
                fresh[number] = found if finder.is_better(found, other) else other
                return True
        return False


def _is_seen_better(track: Track, frame: int) -> bool:
    """Whether the next frame shows somebody of whom this one shows nothing, a part, a doubtful body or another side."""
    own, later = (track.estimates.get(one) for one in (frame, frame + 1))
    if later is None or own is None:
        return later is not None
    turned = is_turned(later.landmarks_px, own.landmarks_px).any()
    return finder.is_whole(later, own) or finder.is_doubtful(own) or bool(turned)


def _surprise(track: Track, frame: int) -> float:
    """Distance of this frame's hips from where the motion before would put them, in body radii."""
    before = Track()
    for earlier in track.estimates:
        if earlier < frame:
            before.put(earlier, track.estimates[earlier])
    if not before.estimates:
        return np.inf
    predicted_px = finder.hips_px(before.last) + (frame - before.last_frame) * before.velocity_px()
    radius_px = before.last.next_roi.radius_px
    return float(np.linalg.norm(finder.hips_px(track.estimates[frame]) - predicted_px) / radius_px)


def _near(track: Track, other: Track, frame: int) -> bool:
    """Whether another person may cover a part of this one."""
    return finder.boxes_meet(track.estimates[frame].box_px(), other.estimates[frame].box_px())


def _looks(image: np.ndarray, fresh: list[PoseEstimate]) -> list[AppearanceDescriptor]:
    """Appearance of new people."""
    return [AppearanceDescriptor(clothing_histogram(image, found.landmarks_px, found.visibility)) for found in fresh]


def _match_lost(
    lost: list[Track], fresh: list[PoseEstimate], looks: list[AppearanceDescriptor], frame: int, max_lost: int
) -> list[Track | None]:
    """For each new person the lost track that it continues, by position, size, overlap and appearance, or None."""
    owners: list[Track | None] = [None] * len(fresh)
    if not lost or not fresh:
        return owners
    seen = list(zip(fresh, looks, strict=True))
    cost = np.array(
        [[_continuation_cost(track, found, worn, frame, max_lost) for found, worn in seen] for track in lost]
    )
    for row, column in zip(*linear_sum_assignment(np.minimum(cost, 1e6)), strict=True):
        if np.isfinite(cost[row, column]):
            owners[column] = lost[row]
    return owners


def _continuation_cost(
    track: Track, found: PoseEstimate, looks: AppearanceDescriptor, frame: int, max_lost: int
) -> float:
    """Distance from the predicted position in body radii, plus 1 - IoU of the boxes, plus the appearance distance;
    infinite where the position is out of reach or the appearance differs."""
    gap = frame - track.last_frame
    moved_px = gap * track.velocity_px()
    radius_px = track.last.next_roi.radius_px
    away = float(np.linalg.norm(finder.hips_px(found) - finder.hips_px(track.last) - moved_px)) / radius_px
    growth = abs(np.log(found.next_roi.side_px / track.last.next_roi.side_px))
    if away > 0.8 + 2.0 * gap / max(max_lost, 1) or growth > np.log(1.6):
        return np.inf
    iou = float(box_iou(track.last.box_px() + np.tile(moved_px, 2), found.box_px()[None])[0])
    appearance_distance = float(np.nan_to_num(track.appearance_distance(looks), nan=_SAME_CLOTHING))
    return away + growth + (1.0 - iou) + appearance_distance if appearance_distance < _OTHER_CLOTHING else np.inf


def rejoined(tracks: list[Track], max_away: int) -> list[Track]:
    """Tracks of people who left and came back, joined where their appearance is similar and nobody else's is.

    Args:
        tracks: of all people.
        max_away: longest absence in frames.
    """
    while True:
        pairs = [
            (min(second.estimates) - first.last_frame, i, j)
            for i, first in enumerate(tracks)
            for j, second in enumerate(tracks)
            if 0 < min(second.estimates) - first.last_frame <= max_away
        ]
        sure = [pair for pair in pairs if _is_back(tracks, *pair[1:])]
        if not sure:
            return tracks
        _, i, j = min(sure)
        first, second = tracks[i], tracks[j]
        joined = Track(first.estimates | second.estimates, max(first.best, second.best, key=lambda best: best[0]))
        joined.last_frame, joined.looks = second.last_frame, first.looks
        if first.looks is not None and second.looks is not None:
            first.looks.add(second.looks.histograms)
        tracks = [track for number, track in enumerate(tracks) if number not in (i, j)] + [joined]


def _is_back(tracks: list[Track], i: int, j: int) -> bool:
    """Whether the appearance is the same, and that of nobody seen at the same time is nearly as close."""
    pair = (tracks[i], tracks[j])
    distance = tracks[i].appearance_distance(tracks[j].looks)
    if not distance < _SAME_CLOTHING:
        return False
    others = [track for track in tracks if track not in pair and any(_meet(track, one) for one in pair)]
    return not any(track.appearance_distance(one.looks) < distance + _DISTINCT for track in others for one in pair)


def _meet(first: Track, second: Track) -> bool:
    """Whether two tracks overlap in time, so that they are two people."""
    return min(first.estimates) <= second.last_frame and min(second.estimates) <= first.last_frame
