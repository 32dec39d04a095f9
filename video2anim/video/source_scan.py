"""First pass over a source: time stamps, shots, and damage."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from video2anim.video.bars import EVERY, bar_margins
from video2anim.video.decode import DecodeReport, SourceHeader, Stamps, decode
from video2anim.video.shots import THUMBNAIL_SIDE_PX, ShotDetector

MAX_GAP_S = 2.0
"""A longer gap in the time stamps ends a shot: an image held over it would be invented footage."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceScan:
    """The pictures of a source between `start_s` and `stop_s`."""

    time_s: Float[np.ndarray, "pictures"]
    """Time stamps as the source has them, strictly increasing; may be empty."""
    shot_start: tuple[int, ...]
    """Index of the first picture of every shot."""
    report: DecodeReport
    reached_end: bool
    """False where the pass ended at `stop_s`, so that the rest of the source is unknown."""
    margins: Float[np.ndarray, "looked_at 4"]
    """Bars around the first of every `EVERY` pictures, by `bar_margins`."""
    stamps: Stamps = "pts"
    """Which stamps `time_s` are."""

    @property
    def period_s(self) -> float:
        """Median time between pictures, 0 for fewer than two."""
        return float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else 0.0

    def shot_time_s(self, shot: int) -> Float[np.ndarray, "shot_pictures"]:
        """Time stamps of one shot's pictures."""
        return self.time_s[self._pictures(shot)]

    def shot_margins(self, shot: int) -> Float[np.ndarray, "looked_at 4"]:
        """Bars around those of one shot's pictures that were looked at."""
        pictures = self._pictures(shot)
        return self.margins[-(-pictures.start // EVERY) : -(-pictures.stop // EVERY)]

    def _pictures(self, shot: int) -> slice:
        bounds = (*self.shot_start, len(self.time_s))
        return slice(bounds[shot], bounds[shot + 1])

    def shots_s(self) -> tuple[tuple[float, float], ...]:
        """Start and end of every shot; the end is that of its last picture."""
        spans = []
        for shot in range(len(self.shot_start)):
            time_s = self.shot_time_s(shot)
            end_s = float(time_s[-1]) + self.period_s
            if shot + 1 < len(self.shot_start):
                end_s = min(end_s, float(self.time_s[self.shot_start[shot + 1]]))
            spans.append((float(time_s[0]), end_s))
        return tuple(spans)


def scan_source(
    path: Path,
    header: SourceHeader,
    *,
    start_s: float = 0.0,
    stop_s: float | None = None,
    on_picture: Callable[[int], None] | None = None,
) -> SourceScan:
    """Decode the source, keeping only a few thumbnails at a time.

    Decoders return pictures in the order in which they are shown. Where presentation times contradict that order
    more often than decode times do (an AVI has no presentation times, and FFmpeg's guesses may be wrong), the source
    is decoded once more by its decode times: FFmpeg does the same for single frames ("best effort time stamp").

    Args:
        path: The source.
        header: Its header, by `probe`.
        start_s: Pictures earlier than this after the first one are left out.
        stop_s: Pictures this late or later after the first one are left out; None for none.
        on_picture: Called with the number of pictures decoded so far.

    Raises:
        InputError: the file cannot be opened.
    """
    found = _scan_pass(path, header, "pts", start_s, stop_s, on_picture)
    if found.report.faulty_pts > found.report.faulty_dts:
        found = _scan_pass(path, header, "dts", start_s, stop_s, on_picture)
    return found


def _scan_pass(
    path: Path,
    header: SourceHeader,
    stamps: Stamps,
    start_s: float,
    stop_s: float | None,
    on_picture: Callable[[int], None] | None,
) -> SourceScan:
    report = DecodeReport()
    detector = ShotDetector()
    size_px = header.upright_size_px(THUMBNAIL_SIDE_PX)
    stamps_s, margins = array("d"), array("d")
    gap_ends: list[int] = []
    first_s: float | None = None
    reached_end = True
    for picture in decode(path, header, report, stamps):
        first_s = picture.time_s if first_s is None else first_s
        if stop_s is not None and picture.time_s - first_s >= stop_s:
            reached_end = False
            break
        if picture.time_s - first_s < start_s:
            continue
        if stamps_s and picture.time_s - stamps_s[-1] > MAX_GAP_S:
            gap_ends.append(len(stamps_s))
        if len(stamps_s) % EVERY == 0:
            margins.extend(bar_margins(picture.luminance()))
        stamps_s.append(picture.time_s)
        detector.add(picture.rgb(*size_px))
        if on_picture is not None:
            on_picture(report.frames)
    cuts = detector.finish()
    starts = sorted({0, *cuts, *gap_ends}) if stamps_s else []
    around = np.array(margins, dtype=np.float64).reshape(-1, 4)
    return SourceScan(np.array(stamps_s, dtype=np.float64), tuple(starts), report, reached_end, around, stamps)
