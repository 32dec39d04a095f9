"""Keyframe selection, and how a motion of any length is cut into overlapping windows (paper 8.2)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Int

WINDOW_FRAMES = 121
"""Length N of one synthesis (paper section 4)."""
OVERLAP_FRAMES = WINDOW_FRAMES // 2
"""Last frames v of a window that seed the next: half of it (paper 8.2)."""
KEYFRAME_INTERVALS = (15, 30, 60)
"""Frames between keyframes at which models are compared (paper Table 2 and 8.2: 15 and 60); the first is the default of
`scenemi sample`, the last, half a window, that of `scenemi evaluate`."""


@dataclass(frozen=True, slots=True)
class WindowSpan:
    """Frames [start, stop) of the motion. Frames before `seed_stop` are known from the window before."""

    start: int
    stop: int
    seed_stop: int
    """Equal to `start` for the first window."""

    @property
    def frame_count(self) -> int:
        return self.stop - self.start


def select_keyframes(
    frame_count: int, interval: int, *, usable: Bool[np.ndarray, "frames"] | None = None
) -> Int[np.ndarray, "keyframes"]:
    """Every `interval`-th frame and the last one; where frames are unusable, only usable ones.

    With `usable`, an unusable grid frame is replaced by the last usable frame before it and the first after it, so a
    gap is spanned from edge to edge. First and last usable frame are always keyframes.

    Returns:
        Sorted frame indices (K,), K >= 1.

    Raises:
        ValueError: no frames, no usable frame, or an interval below 1.
    """
    if frame_count < 1 or interval < 1:
        raise ValueError(f"select_keyframes: want frame_count >= 1 and interval >= 1, got {frame_count}, {interval}")
    usable = np.ones(frame_count, dtype=bool) if usable is None else np.asarray(usable, dtype=bool)
    if usable.shape != (frame_count,):
        raise ValueError(f"select_keyframes: usable has shape {usable.shape}, want ({frame_count},)")
    good = np.flatnonzero(usable)
    if len(good) == 0:
        raise ValueError("select_keyframes: no usable frame in the motion")
    chosen = {int(good[0]), int(good[-1])}
    for frame in range(0, frame_count, interval):
        if usable[frame]:
            chosen.add(frame)
            continue
        after = int(np.searchsorted(good, frame))
        chosen.update(int(good[i]) for i in (after - 1, after) if 0 <= i < len(good))
    return np.array(sorted(chosen), dtype=np.int64)


def split_long_gaps(keyframes: Int[np.ndarray, "keyframes"], longest: int = WINDOW_FRAMES - 1) -> np.ndarray:
    """Frames that have to be bridged by interpolation so that no gap between keyframes exceeds `longest` frames.

    Returns:
        Sorted frame indices, empty in the common case.
    """
    bridges: list[int] = []
    for low, high in pairwise(keyframes):
        pieces = -(-int(high - low) // longest)
        bridges.extend(int(low + (high - low) * i // pieces) for i in range(1, pieces))
    return np.array(bridges, dtype=np.int64)


def plan_windows(
    keyframes: Int[np.ndarray, "keyframes"], window: int = WINDOW_FRAMES, overlap: int = OVERLAP_FRAMES
) -> tuple[WindowSpan, ...]:
    """Windows of `window` frames from the first to the last keyframe.

    Each ends on a keyframe, since the model is trained with the first and the last frame given, and shares at least
    `overlap` frames with the one before wherever the keyframes are dense enough (61 for a regular interval of 15: 60 is
    no multiple of it plus one). A motion shorter than a window is one shorter span; priors of fixed length pad it
    (`scenemi.prior.padded`).

    Raises:
        ValueError: two keyframes lie `window` frames or more apart; `split_long_gaps` says where to bridge.
    """
    keyframes = np.asarray(keyframes)
    if len(keyframes) < 1 or (np.diff(keyframes) < 1).any():
        raise ValueError(f"plan_windows: want ascending keyframes, at least one, got {keyframes}")
    if not 0 <= overlap < window:
        raise ValueError(f"plan_windows: want 0 <= overlap < window, got {overlap}, {window}")
    if len(keyframes) > 1 and np.diff(keyframes).max() >= window:
        raise ValueError(f"plan_windows: keyframes {np.diff(keyframes).max()} frames apart exceed a window of {window}")
    first, last = int(keyframes[0]), int(keyframes[-1])
    stop = _last_keyframe_below(keyframes, first + window) + 1
    spans = [WindowSpan(first, stop, first)]
    while stop <= last:
        reach = stop + window - max(overlap, 1)
        new_stop = _last_keyframe_below(keyframes, reach) + 1
        if new_stop <= stop:
            new_stop = int(keyframes[np.searchsorted(keyframes, stop)]) + 1
        spans.append(WindowSpan(max(first, new_stop - window), new_stop, stop))
        stop = new_stop
    return tuple(spans)


def _last_keyframe_below(keyframes: Int[np.ndarray, "keyframes"], limit: int) -> int:
    return int(keyframes[np.searchsorted(keyframes, limit) - 1])
