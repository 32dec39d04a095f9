"""Corrections that are known in some runs of frames, faded out or joined between them without a jump in speed."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from video2anim.geometry.runs import runs

_SLOPE = 0.7
"""Share of a run's end speed that a gap starts with: full speed overshoots."""


def faded(
    values: Float[np.ndarray, "frames dims"], known: Bool[np.ndarray, "frames"], blend: int
) -> Float[np.ndarray, "frames dims"]:
    """`values` where known; elsewhere cubic curves to zero within `blend` frames, or straight to the next run.

    A gap shorter than twice `blend` is bridged; frames beyond the first and last run fade to zero.
    """
    filled = np.where(known[:, None], values, 0.0)
    pieces = runs(known)
    for (start, stop), (next_start, next_stop) in itertools.pairwise(pieces):
        last, first = stop - 1, next_start
        begin = (filled[last], _slope(filled[start:stop], -1))
        end = (filled[first], _slope(filled[next_start:next_stop], 0))
        if first - last <= 2 * blend:
            filled[stop:next_start] = _cubic(begin, end, first - last)
        else:
            _fade_out(filled, stop, begin, blend)
            _fade_in(filled, next_start, end, blend)
    if pieces:
        start, stop = pieces[0]
        _fade_in(filled, start, (filled[start], _slope(filled[start:stop], 0)), blend)
        start, stop = pieces[-1]
        _fade_out(filled, stop, (filled[stop - 1], _slope(filled[start:stop], -1)), blend)
    return filled


def envelope(least: Float[np.ndarray, "frames"], radius: int) -> Float[np.ndarray, "frames"]:
    """A smooth curve that is nowhere below `least`."""
    if not least.any():
        return least
    sigma = radius / 3.0
    return gaussian_filter1d(maximum_filter1d(least, 2 * radius + 1), sigma, mode="nearest", radius=radius)


def bridged(values: Float[np.ndarray, "frames"], known: Bool[np.ndarray, "frames"]) -> Float[np.ndarray, "frames"]:
    """Straight lines between known values, level beyond them; zero where nothing is known."""
    if not known.any():
        return np.zeros(len(values))
    frames = np.arange(len(values))
    return np.interp(frames, frames[known], values[known])


def _slope(piece: np.ndarray, end: int) -> np.ndarray:
    if len(piece) < 2:
        return np.zeros(piece.shape[1])
    return _SLOPE * (piece[-1] - piece[-2] if end == -1 else piece[1] - piece[0])


def _cubic(
    begin: tuple[np.ndarray, np.ndarray], end: tuple[np.ndarray, np.ndarray], steps: int
) -> Float[np.ndarray, "inner dims"]:
    """Hermite curve between two frames `steps` apart, without the two."""
    t = (np.arange(1, steps) / steps)[:, None]
    (value, slope), (next_value, next_slope) = begin, end
    return (
        (2 * t**3 - 3 * t**2 + 1) * value
        + (t**3 - 2 * t**2 + t) * steps * slope
        + (-2 * t**3 + 3 * t**2) * next_value
        + (t**3 - t**2) * steps * next_slope
    )


def _fade_out(filled: np.ndarray, stop: int, begin: tuple[np.ndarray, np.ndarray], blend: int) -> None:
    zero = np.zeros_like(begin[0])
    curve = _cubic(begin, (zero, zero), blend)[: len(filled) - stop]
    filled[stop : stop + len(curve)] = curve


def _fade_in(filled: np.ndarray, start: int, end: tuple[np.ndarray, np.ndarray], blend: int) -> None:
    zero = np.zeros_like(end[0])
    curve = _cubic((zero, zero), end, blend)
    curve = curve[max(0, len(curve) - start) :]
    filled[start - len(curve) : start] = curve
