"""Which frames of a training window are keyframes."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool

_NEAREST = 5
"""Frames between regular keyframes, at least: nearer ones are joined well already."""
_REGULAR, _SEEDED = 0.7, 0.2
"""Shares of windows with regular intervals, and with a known beginning, in the mixed law. In the paper's draw keyframes
are two frames apart in the median, where there is nothing to fill."""
_UNSEEN = np.cumsum([0.4, 0.35, 0.15])
"""Shares of windows with no, at most one and at most two stretches in which the person was not seen; others have three.
With its checks `Generator.choice`, which draws the same, takes most of the time of a mask."""


def draw_mask(
    rng: np.random.Generator, frames: int, law: Literal["paper", "mixed"] = "mixed"
) -> Bool[np.ndarray, "frames"]:
    """Keyframes of one window, first and last frame always among them.

    `paper`: k ~ U{2..N} frames at random (3.2). `mixed`: 10 % of the windows so; 70 % every r-th frame, r log-uniform
    from 5 to N - 1, sometimes with the phase shifted; 20 % a known beginning as in long motion (8.2) followed by
    regular keyframes.
    """
    mask = np.zeros(frames, bool)
    kind = rng.random() if law == "mixed" else 1.0
    if kind >= _REGULAR + _SEEDED:
        count = int(rng.integers(2, frames + 1))
        mask[1 + rng.permutation(frames - 2)[: count - 2]] = True
    else:
        interval = round(float(np.exp(rng.uniform(np.log(_NEAREST), np.log(frames - 1)))))
        phase = int(rng.integers(0, interval)) if rng.random() < 0.3 else 0
        mask[phase::interval] = True
        if kind < _SEEDED:
            mask[: int(rng.integers(2, frames - 10))] = True
    mask[[0, -1]] = True
    return mask


def draw_telling_mask(rng: np.random.Generator, frames: int) -> Bool[np.ndarray, "frames"]:
    """Keyframes 15 to N - 1 frames apart, log-uniform, with any phase: between nearer ones no solid fits on a wrong
    path."""
    mask = np.zeros(frames, bool)
    interval = round(float(np.exp(rng.uniform(np.log(15), np.log(frames - 1)))))
    mask[(int(rng.integers(0, interval)) if rng.random() < 0.3 else 0) :: interval] = True
    mask[[0, -1]] = True
    return mask


def draw_observed_mask(rng: np.random.Generator, frames: int) -> Bool[np.ndarray, "frames"]:
    """Frames as a video pipeline gives them: all or every few (up to 15), but for stretches of 0.2 to 2 s in which the
    person was not seen."""
    mask = np.zeros(frames, bool)
    mask[:: 1 if rng.random() < 0.6 else (3, 5, 15)[rng.integers(3)]] = True
    for _ in range(np.searchsorted(_UNSEEN, rng.random(), side="right")):
        start, length = int(rng.integers(1, frames - 1)), round(float(np.exp(rng.uniform(np.log(6), np.log(60)))))
        mask[start : start + length] = False
    mask[[0, -1]] = True
    return mask
