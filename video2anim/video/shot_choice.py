"""Which shot of a source becomes the clip, and which of its pictures every frame shows."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError
from video2anim.types.clip import FPS
from video2anim.video.cfr import constant_rate_index
from video2anim.video.source_scan import SourceScan

_MIN_PICTURES_PER_S = 2.0
"""Sources with fewer pictures on average are no video: nearly every frame would repeat the one before."""


def chosen_times(
    path: Path, scan: SourceScan, shot: Literal["longest"] | int, *, min_frames: int
) -> tuple[int, Float[np.ndarray, "pictures"], Float[np.ndarray, "frames"]]:
    """Number of the shot, the times of its pictures, and the time of the picture that each frame of the clip shows.

    Args:
        path: The source, for messages.
        scan: What the first pass found.
        shot: `longest`, or the number of a shot, counted from 0.
        min_frames: Fewest frames at 30 fps that make a clip.

    Raises:
        InputError: no such shot, or too few pictures.
    """
    if len(scan.time_s) == 0:
        raise InputError(
            f"{path}: no picture between ingest.start_s and ingest.stop_s; {scan.report.frames} pictures decode in all"
        )
    number = _number(path, scan, shot)
    shot_time_s = scan.shot_time_s(number)
    source_time_s = shot_time_s[constant_rate_index(shot_time_s, FPS)]
    if len(source_time_s) < min_frames:
        raise InputError(
            f"{path}: want at least {min_frames} frames at {FPS:.0f} fps "
            f"({min_frames / FPS:.2f} s), got {len(source_time_s)} from {len(shot_time_s)} decoded pictures"
        )
    if len(source_time_s) * _MIN_PICTURES_PER_S > FPS * len(shot_time_s):
        raise InputError(
            f"{path}: want a video of at least {_MIN_PICTURES_PER_S:.0f} pictures a second, got "
            f"{len(shot_time_s)} pictures in {len(source_time_s) / FPS:.0f} s; choose a denser part with "
            "--set ingest.start_s=S --set ingest.stop_s=S, or another shot with --set ingest.shot=N "
            f"(of {len(scan.shot_start)})"
        )
    return number, shot_time_s, source_time_s


def _number(path: Path, scan: SourceScan, shot: Literal["longest"] | int) -> int:
    spans_s = scan.shots_s()
    if shot == "longest":
        return int(np.argmax([end_s - start_s for start_s, end_s in spans_s]))
    if shot >= len(spans_s):
        raise InputError(f"{path}: no shot {shot}; {len(spans_s)} found, counted from 0")
    return shot
