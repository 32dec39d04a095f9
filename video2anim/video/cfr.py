"""Conversion of time stamps to a constant frame rate."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

_TIE_S = 1e-6
"""Times that differ by less are equal: time stamps in floating point are rounded."""


def constant_rate_index(source_time_s: Float[np.ndarray, "pictures"], fps: float) -> Int[np.ndarray, "frames"]:
    """Which source picture each frame of a constant-rate clip shows.

    Frame i lies at `source_time_s[0] + i / fps` and shows the picture nearest in time, but a later picture only
    where it is at most half a frame away: across a hole in the time stamps the last picture is held. The clip lasts
    to the end of the last picture, taken to be shown for the median period.

    Args:
        source_time_s: Strictly increasing time stamps, at least one.
        fps: Frames per second of the clip.

    Raises:
        ValueError: no pictures, or time stamps that do not increase.
    """
    time_s = np.asarray(source_time_s, dtype=np.float64)
    if time_s.ndim != 1 or len(time_s) == 0:
        raise ValueError(f"want a list of at least one time stamp, got shape {time_s.shape}")
    steps_s = np.diff(time_s)
    if not np.all(np.isfinite(time_s)) or np.any(steps_s <= 0):
        raise ValueError("time stamps do not increase strictly")
    last_period_s = float(np.median(steps_s)) if len(steps_s) else 1.0 / fps
    duration_s = time_s[-1] - time_s[0] + last_period_s
    frame_count = max(1, int(np.floor(duration_s * fps + 0.5)))
    frame_s = time_s[0] + np.arange(frame_count) / fps
    held = np.searchsorted(time_s, frame_s + _TIE_S, side="right") - 1
    following = np.minimum(held + 1, len(time_s) - 1)
    ahead_s, behind_s = time_s[following] - frame_s, frame_s - time_s[held]
    use_following = (ahead_s < behind_s - _TIE_S) & (ahead_s <= 0.5 / fps + _TIE_S)
    return np.where(use_following, following, held)


def max_gap_s(source_time_s: Float[np.ndarray, "pictures"]) -> float:
    """Longest time between neighboring pictures, 0 for fewer than two."""
    return float(np.max(np.diff(source_time_s), initial=0.0))
