"""Stage 2: everybody in the clip, followed over time, with BlazePose landmarks in every frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from video2anim.errors import StageError, UsageError
from video2anim.pipeline.options import limits, model_of
from video2anim.pipeline.stage import NO_MODEL, StageContext, StageSpec
from video2anim.types import PersonTrack, PersonTracks, Thumbnail, VideoClip

if TYPE_CHECKING:
    from video2anim.networks.blazepose import PoseEstimate
    from video2anim.tracking.tracker import Track

_PERSON = r"^(largest|all|\s*[0-9]{1,9}\s*)$"


@dataclass(frozen=True)
class TrackConfig:
    """Settings of the stage."""

    person: Annotated[str, Field(pattern=_PERSON, description="that is 'largest', 'all' or a person's ID")] = "largest"
    """Whom later stages work on: `largest`, `all`, or a person's ID."""
    model: Annotated[str, model_of("pose")] = "blazepose-heavy"
    """Landmark model of the table (`video2anim models list`)."""
    finder: Annotated[str, model_of("finder", also=(NO_MODEL,))] = "objectron"
    """Model of slot `finder` that detects people too: from behind, or in blur. `none` to do without."""
    scan_every_s: Annotated[float, limits("s", ge=0, le=3600)] = 0.5
    """Time between searches of the whole picture for further people."""
    min_detection_score: Annotated[float, limits(ge=0, le=1)] = 0.5
    """Detections below are not looked at, 0 to 1."""
    max_lost_s: Annotated[float, limits("s", ge=0, le=3600)] = 1.0
    """A person found again near by after at most this time keeps the ID."""
    max_away_s: Annotated[float, limits("s", ge=0, le=3600)] = 10.0
    """So does, after at most this time and anywhere, a person in the same clothes that nobody else wears."""
    min_track_s: Annotated[float, limits("s", ge=0, le=3600)] = 0.3
    """People seen for less are dropped (half the clip where it is shorter than twice this)."""


def track_people(clip: VideoClip, config: TrackConfig, ctx: StageContext) -> PersonTracks:
    """Find and follow everybody in the clip.

    Landmarks are raw: nothing is smoothed and nothing is filled in; frames without a person are not valid.

    Raises:
        StageError: nobody was found.
        UsageError: `person` names nobody found.
        ModelMissingError: the models' weights cannot be had.
    """
    from video2anim.tracking.sides import without_reversals
    from video2anim.tracking.tracker import Tracker, rejoined
    from video2anim.video import read_frames
    from video2anim.video.heap import frames_in_mapped_memory

    tracker = Tracker(
        ctx.model(config.model), clip.fps, scan_every_s=config.scan_every_s, max_lost_s=config.max_lost_s,
        min_detection_score=config.min_detection_score,
        objects=None if config.finder == NO_MODEL else ctx.model(config.finder),
    )  # fmt: skip
    second, count = max(1, round(clip.fps)), clip.frame_count
    repeated = np.diff(clip.source_time_s, prepend=-np.inf, append=np.inf) == 0
    with frames_in_mapped_memory():
        for frame, image in enumerate(read_frames(clip)):
            if repeated[frame]:
                tracker.repeat(frame)
            else:
                tracker.step(frame, image)
            ctx.progress(frame + 1, count)
        min_frames = max(1, round(min(config.min_track_s * clip.fps, 0.5 * count)))
        # Who is not convincing forward would only grow by what is followed back; the end of the clip cuts people short.
        tracker.tracks = [
            track for track in tracker.tracks
            if _is_person(track) and (len(track.estimates) >= min_frames or track.last_frame == count - 1)
        ]  # fmt: skip
        for start in reversed(range(0, count, second)):
            frames = range(start, min(start + second, count))
            if tracker.may_step_back(frames):
                for frame, image in reversed(list(zip(frames, read_frames(clip, start, frames.stop), strict=True))):
                    tracker.step_back(frame, image, same_picture=bool(repeated[frame + 1]))
    long = [track for track in tracker.tracks if len(track.estimates) >= min_frames]
    ranked = _ranked(rejoined(long, round(config.max_away_s * clip.fps)))
    size_px = clip.width_px, clip.height_px
    rows = [track.rows(number, *size_px) for number, track in enumerate(ranked, start=1)]
    people = tuple(without_reversals(person, clip.fps) for person in rows)
    thumbnails = tuple(Thumbnail(number, *track.best[1:]) for number, track in enumerate(ranked, start=1))
    if not people:
        raise StageError(
            f"nobody found: want a person visible for at least {config.min_track_s:g} s, came none in "
            f"{clip.frame_count} frames of {clip.width_px}x{clip.height_px}; use a clip in which people are at "
            "least about 100 pixels tall and in view from head to hips, or lower track.min_detection_score"
        )
    selected = _select(people, config.person)
    main = next(person for person in people if person.person_id == selected[0])
    ctx.quality("people_found", len(people), "count")
    seen = float(main.valid.sum() / clip.frame_count)
    ctx.quality("valid_frames", 100.0 * seen, "%", "higher")
    ctx.quality("mean_score", float(main.score[main.valid].mean()), "ratio", "higher")
    if seen < 0.5:
        ctx.warn(f"person {main.person_id} is seen in only {100 * seen:.0f} % of the frames")
    return PersonTracks(people=people, selected_ids=selected, thumbnails=thumbnails)


def _is_person(track: Track) -> bool:
    """Whether a track is convincing: on the average it is that of somebody new."""
    from video2anim.tracking.person_detection import MAX_DISAGREEMENT, MIN_PRESENCE_NEW

    estimates = track.estimates.values()
    presence = float(np.mean([found.presence for found in estimates]))
    doubt = float(np.median([found.doubt for found in estimates]))
    return presence >= MIN_PRESENCE_NEW and doubt <= MAX_DISAGREEMENT


def _ranked(tracks: list[Track]) -> list[Track]:
    """By mean box area over the whole clip, largest first; persons are numbered so."""
    return sorted(tracks, key=lambda track: -sum(_area(found) for found in track.estimates.values()))


def _area(found: PoseEstimate) -> float:
    x0, y0, x1, y1 = found.box_px()
    return float((x1 - x0) * (y1 - y0))


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


STAGE = StageSpec("track", track_people, version=24, models=("pose", "finder"))
