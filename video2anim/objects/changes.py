"""Places of a fixed camera's picture that look different for good from some moment on: something left or came there.

A pixel changes where the medians of its colors before and after a moment differ by more than its noise. People hide what
happens when somebody takes a thing, so that the moment is known as a stretch: from the last look at the old color to the
first at the new one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy import ndimage

_WINDOW = 6
"""Looks before and after a moment that medians are taken of: a second of a clip sampled every fifth frame. What stays
for a shorter time is not at rest."""
_LUMINANCE_WEIGHT = 0.5
"""Cast shadows change luminance most; it counts for less, as for the masks of people."""
_NOISE_LAB = 1.5
"""Least noise of a pixel: compression and light that passes."""
_NOISES = 5.0
"""A change is this many times the noise."""
_TELLING = 0.3
"""A look that sees this share of the pixels tells their state."""
_EVEN = 0.15
"""Logarithms of the light's change that differ by less are the same: a shadow takes the same share of every channel,
over its whole area."""
_THIN = 0.12
"""Half the width of the border of a shadow that touches an object, against the square root of its area."""
_BORDER_PX = 2
"""The edge of an object is looked at so far inside and outside its outline."""


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One lasting change."""

    mask: Bool[np.ndarray, "height width"]
    """Its pixels."""
    first: int
    """Sample of the last look at what was there before."""
    last: int
    """Sample of the first look at what is there now."""
    came: bool
    """Something is there since; False where it was there before."""
    rgb: UInt8[np.ndarray, "height width 3"]
    """The picture with it."""


def lasting_changes(
    rgb: UInt8[np.ndarray, "samples height width 3"],
    hidden: Bool[np.ndarray, "samples height width"],
    wanted: Bool[np.ndarray, "height width"],
    least_px: float,
) -> tuple[Change, ...]:
    """Changes of a fixed camera's picture, in order of time.

    Args:
        rgb: Pictures, equally spaced in time.
        hidden: Where people are in front.
        wanted: Where to look.
        least_px: Pixels of the smallest.
    """
    rows, columns = np.nonzero(cv2.dilate(wanted.astype(np.uint8), np.ones((2 * _BORDER_PX + 3,) * 2)))
    if not len(rows) or len(rgb) <= 2 * _WINDOW:
        return ()
    color = np.stack([_lab(picture)[rows, columns] for picture in rgb])
    seen = ~hidden[:, rows, columns]
    lively = _lively(color, seen)
    rows, columns, color, seen = rows[lively], columns[lively], color[:, lively], seen[:, lively]
    if not len(rows):
        return ()
    before, after = _medians(color, seen)[:-1], _medians(color[::-1], seen[::-1])[::-1][1:]
    step = np.linalg.norm(after - before, axis=-1)
    jitter = np.where(seen[1:], np.linalg.norm(color[1:] - before, axis=-1), 0)
    noise = np.maximum(_NOISE_LAB, np.median(np.nan_to_num(jitter), axis=0))
    changed = np.zeros((len(step), *wanted.shape), bool)
    changed[:, rows, columns] = np.nan_to_num(step) > _NOISES * noise
    labels, _ = ndimage.label(changed, np.ones((3, 3, 3)))
    place = np.full(wanted.shape, -1)
    place[rows, columns] = np.arange(len(rows))
    found = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        inside = labels[box] == number
        if inside.any(0).sum() < least_px:
            continue
        # The moment in which the most of it changes.
        amount = np.where(inside, step[box[0]][:, place[box[1:]].clip(0)], 0).sum((1, 2))
        at = box[0].start + int(amount.argmax())
        whole = np.zeros(wanted.shape, bool)
        whole[box[1:]] = inside.any(0)
        whole &= place >= 0
        states = [np.where((place >= 0)[..., None], state[at][place.clip(0)], np.nan) for state in (before, after)]
        pieces, count = ndimage.label(ndimage.binary_opening(whole & ~_shadow(*states), np.ones((2, 2))))
        for piece in range(1, count + 1):
            mask = ndimage.binary_fill_holes(pieces == piece) & (place >= 0)
            mask = _cut(mask, *states) & (place >= 0)
            if mask.sum() < least_px:
                continue
            own = place[mask]
            first, last = _moment(color[:, own], seen[:, own], before[at, own], after[at, own], at)
            found.append(_told(mask, first, last, rgb, hidden, *states))
    return tuple(sorted(found, key=lambda change: change.last))


def _cut(
    mask: Bool[np.ndarray, "height width"],
    before: Float32[np.ndarray, "height width 3"],
    after: Float32[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "height width"]:
    """The part that changes most, by GrabCut on the change itself: shadows at its border change less."""
    change = _light_change(before, after)
    amount = np.nan_to_num(np.linalg.norm(after - before, axis=-1))
    channels = np.stack([5 * amount, 100 * np.abs(change.mean(-1)), 100 * np.ptp(change, axis=-1)], -1)
    picture = channels.clip(0, 255).astype(np.uint8)
    radius = max(2, round(0.25 * float(np.sqrt(mask.sum()))))
    around = cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
    rows, columns = np.flatnonzero(around.any(1)), np.flatnonzero(around.any(0))
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    seeds = np.full(mask.shape, cv2.GC_BGD, np.uint8)
    seeds[around] = cv2.GC_PR_BGD
    seeds[mask] = cv2.GC_PR_FGD
    strong = mask & (amount > np.median(amount[mask]))
    seeds[strong] = cv2.GC_FGD
    own = seeds[box].copy()
    if (own == cv2.GC_BGD).any() or (own == cv2.GC_PR_BGD).any():
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(np.ascontiguousarray(picture[box]), own, None, *models, 3, cv2.GC_INIT_WITH_MASK)
    cut = np.zeros_like(mask)
    cut[box] = (own == cv2.GC_FGD) | (own == cv2.GC_PR_FGD)
    cut = ndimage.binary_opening(cut, np.ones((2, 2)))
    labels, count = ndimage.label(cut)
    return cut if not count else ndimage.binary_fill_holes(labels == 1 + np.bincount(labels.ravel())[1:].argmax())


def _lively(
    color: Float32[np.ndarray, "samples pixels 3"], seen: Bool[np.ndarray, "samples pixels"]
) -> Bool[np.ndarray, "pixels"]:
    """Pixels that may change, by means over blocks of a window, of which a change that lasts fills one by half."""
    low, high = np.full(color.shape[1:], np.inf, np.float32), np.full(color.shape[1:], -np.inf, np.float32)
    for start in range(0, len(color), _WINDOW):
        block, free = color[start : start + _WINDOW], seen[start : start + _WINDOW, :, None]
        count = free.sum(0)
        mean = np.where(free, block, 0).sum(0) / np.maximum(count, 1)
        low, high = (
            np.minimum(low, np.where(count > 0, mean, np.inf)),
            np.maximum(high, np.where(count > 0, mean, -np.inf)),
        )
    return np.linalg.norm(np.nan_to_num(high - low, neginf=0.0), axis=-1) > 0.5 * _NOISES * _NOISE_LAB


def _light_change(
    before: Float32[np.ndarray, "height width 3"], after: Float32[np.ndarray, "height width 3"]
) -> Float32[np.ndarray, "height width 3"]:
    """Logarithm of what each channel gained."""
    light = []
    for state in (before, after):
        lab = np.nan_to_num(state) / [_LUMINANCE_WEIGHT, 1, 1]
        srgb = cv2.cvtColor(lab.astype(np.float32), cv2.COLOR_LAB2RGB).clip(1e-3, 1)
        light.append(2.2 * np.log(srgb))
    return light[1] - light[0]


def _shadow(*states: Float32[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """Where all channels lost or gained the same share of light, and so did the pixels around."""
    change, square = _light_change(*states), (5, 5)
    mean = change.mean(-1)
    spread = np.sqrt(np.maximum(cv2.blur(mean**2, square) - cv2.blur(mean, square) ** 2, 0))
    return (np.ptp(change, axis=-1) < _EVEN) & (spread < _EVEN)


def _lab(rgb: UInt8[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
    lab = cv2.GaussianBlur(cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), (0, 0), 0.8)
    lab[..., 0] *= _LUMINANCE_WEIGHT
    return lab


def _medians(
    color: Float32[np.ndarray, "samples pixels 3"], seen: Bool[np.ndarray, "samples pixels"]
) -> Float32[np.ndarray, "samples pixels 3"]:
    """Median of each pixel's latest looks up to every sample; NaN for fewer than a window."""
    kept = np.full((_WINDOW, *color.shape[1:]), np.nan, np.float32)
    medians = np.empty_like(color)
    for k, (now, free) in enumerate(zip(color, seen, strict=True)):
        kept[:, free] = np.concatenate([kept[1:, free], now[None, free]])
        medians[k] = np.median(kept, axis=0)
    return medians


def _moment(
    color: Float32[np.ndarray, "samples pixels 3"],
    seen: Bool[np.ndarray, "samples pixels"],
    before: Float32[np.ndarray, "pixels 3"],
    after: Float32[np.ndarray, "pixels 3"],
    about: int,
) -> tuple[int, int]:
    """Samples of the last look at the old state and the first at the new one; those that see too little do not count."""
    is_new = np.linalg.norm(color - before, axis=-1) > np.linalg.norm(color - after, axis=-1)
    looks = seen.sum(1)
    told = looks > _TELLING * seen.shape[1]
    new = (is_new & seen).sum(1) > 0.5 * looks
    sample = np.arange(len(color))
    old = sample[told & ~new & (sample <= about + _WINDOW)]
    first = int(old[-1]) if len(old) else 0
    later = sample[told & new & (sample > first)]
    return first, int(later[0]) if len(later) else len(color) - 1


def _told(
    mask: Bool[np.ndarray, "height width"],
    first: int,
    last: int,
    rgb: UInt8[np.ndarray, "samples height width 3"],
    hidden: Bool[np.ndarray, "samples height width"],
    before: Float32[np.ndarray, "height width 3"],
    after: Float32[np.ndarray, "height width 3"],
) -> Change:
    """Which of the two states shows something: the one in which the outline is an edge of the picture."""
    square = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
    solid = mask.astype(np.uint8)
    outer = (cv2.dilate(solid, square) > 0) & ~mask & np.isfinite(before + after).all(-1)
    edges = []
    for state in (before, after):
        # Each pixel outside is held to the mean color of the pixels inside that are near.
        near = cv2.blur(np.nan_to_num(state) * solid[..., None], square.shape)
        weight = cv2.blur(solid.astype(np.float32), square.shape)
        gap = np.linalg.norm(near / np.maximum(weight, 1e-6)[..., None] - state, axis=-1)
        edges.append(float(np.median(gap[outer])) if outer.any() else 0.0)
    came = edges[1] > edges[0]
    sample = range(last, len(rgb)) if came else range(first, -1, -1)
    free = [k for k in sample if not (hidden[k] & mask).any()][:1]
    return Change(mask, first, last, came, rgb[free[0] if free else (last if came else first)])
