"""Lasting changes in the images of a fixed camera: places where an object appears or disappears.

A pixel changes where the medians of its colors before and after a moment differ by more than its noise. People hide
the moment at which they take an object, so it is given as an interval: from the last sample of the old color to the
first of the new one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from scipy import ndimage

_WINDOW = 6
"""Samples before and after a moment that medians are taken of: 1 s of a clip sampled every fifth frame. Objects that
stay for less are not at rest."""
_CALM = 5
"""Minimum number of them with the same color; others may show a hand or a face that passes, or noise."""
_LUMINANCE_WEIGHT = 0.5
"""Weight of luminance, which cast shadows change most."""
_NOISE_LAB = 1.5
"""Minimum noise of a pixel: compression and flicker."""
_NOISES = 5.0
"""Minimum change of a pixel over its noise."""
_TELLING = 0.3
"""Minimum visible share of the pixels for a sample to tell their state."""
_EVEN = 0.15
"""Maximum spread of a shadow's change of light (logarithm), which is the same in all channels and over its area."""
_DETAIL_PX = 3.0
"""Standard deviation of the smoothing whose difference from the image is detail: planks of a floor are so wide.
Not measured."""
_SHOWS_THROUGH = 0.7
"""Minimum correlation of detail before and after where only the light changed. It is 0.73 to 0.96 for 11 shadows of
people on a wooden floor (`benchmarks/one_camera.py`), and -0.14 to 0.05 at five places where objects are taken or put
(V2A-Bench `03_pick_up`, `benchmarks/carried.py`); by a script that is not kept."""
_PIECE = 0.2
"""Minimum area of a piece over that of the largest."""
_WEAK = 0.25
"""Minimum change over the upper quartile of the changes; smaller ones are shadows of the object."""
_BORDER_PX = 2
"""Width of the band on both sides of an outline in which its edge is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One lasting change."""

    mask: Bool[np.ndarray, "height width"]
    """Its pixels."""
    first: int
    """Last sample of the old state."""
    last: int
    """First sample of the new state."""
    came: bool
    """True: the object appeared; False: it disappeared."""
    rgb: UInt8[np.ndarray, "height width 3"]
    """The image with the object."""


def lasting_changes(
    rgb: UInt8[np.ndarray, "samples height width 3"],
    hidden: Bool[np.ndarray, "samples height width"],
    wanted: Bool[np.ndarray, "height width"],
    min_px: float,
) -> tuple[Change, ...]:
    """Changes in the images of a fixed camera, in order of time.

    Args:
        rgb: Pictures, equally spaced in time.
        hidden: Where people are in front.
        wanted: Pixels that are analyzed.
        min_px: Minimum area of a change.
    """
    pixels = _Pixels.of(rgb, hidden, wanted) if len(rgb) > 2 * _WINDOW else None
    if pixels is None:
        return ()
    found = []
    for whole, at in pixels.events(min_px):
        states = pixels.state(pixels.before[at]), pixels.state(pixels.after[at])
        opened = ndimage.binary_opening(whole & ~_shadow(*states), np.ones((2, 2)))
        count, pieces = cv2.connectedComponents(opened.astype(np.uint8), connectivity=4)
        for piece in range(1, count):
            mask = _cut(ndimage.binary_fill_holes(pieces == piece) & pixels.known, *states) & pixels.known
            if mask.sum() < min_px or _detail_stays(mask, *states):
                continue
            first, last = pixels.moment(mask, at)
            found.append(_told(mask, first, last, rgb, hidden, *states))
    return tuple(sorted(found, key=lambda change: change.last))


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """Pixels that may change, through time."""

    place: Int[np.ndarray, "height width"]
    """Number of each pixel; -1 where nothing is looked for."""
    color: Float32[np.ndarray, "samples pixels 3"]
    seen: Bool[np.ndarray, "samples pixels"]
    before: Float32[np.ndarray, "gaps pixels 3"]
    """Color before the moment between a sample and the next."""
    after: Float32[np.ndarray, "gaps pixels 3"]

    @classmethod
    def of(cls, rgb: np.ndarray, hidden: np.ndarray, wanted: Bool[np.ndarray, "height width"]) -> _Pixels | None:
        """Those wanted pixels whose color changes; None where none does."""
        around = np.ones((2 * _BORDER_PX + 3,) * 2, np.uint8)
        rows, columns = np.nonzero(cv2.dilate(wanted.astype(np.uint8), around))
        if not len(rows):
            return None
        color = np.stack([_lab(picture)[rows, columns] for picture in rgb])
        seen = ~hidden[:, rows, columns]
        lively = _lively(color, seen)
        if not lively.any():
            return None
        color, seen = color[:, lively], seen[:, lively]
        place = np.full(wanted.shape, -1)
        place[rows[lively], columns[lively]] = np.arange(int(lively.sum()))
        return cls(place, color, seen, _medians(color, seen)[:-1], _medians(color[::-1], seen[::-1])[::-1][1:])

    @property
    def known(self) -> Bool[np.ndarray, "height width"]:
        return self.place >= 0

    def state(self, color: Float32[np.ndarray, "pixels 3"]) -> Float32[np.ndarray, "height width 3"]:
        """Colors of all pixels as a picture, NaN where nothing is looked for."""
        return np.where(self.known[..., None], color[self.place.clip(0)], np.nan).astype(np.float32)

    def events(self, min_px: float) -> Iterator[tuple[Bool[np.ndarray, "height width"], int]]:
        """Pixels that change together, and the interval between samples in which most of them do."""
        step = np.linalg.norm(self.after - self.before, axis=-1)
        jitter = np.where(self.seen[1:], np.linalg.norm(self.color[1:] - self.before, axis=-1), 0)
        noise = np.maximum(_NOISE_LAB, np.median(np.nan_to_num(jitter), axis=0))
        changed = (np.nan_to_num(step) > _NOISES * noise)[:, self.place.clip(0)] & self.known
        labels = np.zeros(changed.shape, np.int32)
        ndimage.label(changed, np.ones((3, 3, 3)), output=labels)
        for number, box in enumerate(ndimage.find_objects(labels), start=1):
            inside = labels[box] == number
            if inside.any(0).sum() < min_px:
                continue
            amount = np.where(inside, step[box[0]][:, self.place[box[1:]].clip(0)], 0).sum((1, 2))
            whole = np.zeros(self.place.shape, bool)
            whole[box[1:]] = inside.any(0)
            yield whole, box[0].start + int(amount.argmax())

    def moment(self, mask: Bool[np.ndarray, "height width"], about: int) -> tuple[int, int]:
        """Last sample of the old state and first of the new; samples with too few visible pixels do not count."""
        own = self.place[mask]
        color, seen = self.color[:, own], self.seen[:, own]
        from_old, from_new = (np.linalg.norm(color - state[about, own], axis=-1) for state in (self.before, self.after))
        looks = seen.sum(1)
        told = looks > _TELLING * seen.shape[1]
        new = ((from_old > from_new) & seen).sum(1) > 0.5 * looks
        sample = np.arange(len(color))
        old = sample[told & ~new & (sample <= about + _WINDOW)]
        first = int(old[-1]) if len(old) else 0
        later = sample[told & new & (sample > first)]
        return first, int(later[0]) if len(later) else len(color) - 1


def _cut(
    mask: Bool[np.ndarray, "height width"],
    before: Float32[np.ndarray, "height width 3"],
    after: Float32[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "height width"]:
    """The mask without shadows at its border, which change less than the rest."""
    amount = np.nan_to_num(np.linalg.norm(after - before, axis=-1))
    strong = ndimage.binary_opening(mask & (amount > _WEAK * np.percentile(amount[mask], 75)), np.ones((2, 2)))
    closed = ndimage.binary_closing(strong, np.ones((5, 5))).astype(np.uint8)
    count, labels = cv2.connectedComponents(closed, connectivity=4)
    if count == 1:
        return mask
    area = np.bincount(labels.ravel())[1:]
    return mask & ndimage.binary_fill_holes(np.isin(labels, 1 + np.flatnonzero(area > _PIECE * area.max())))


def _lively(
    color: Float32[np.ndarray, "samples pixels 3"], seen: Bool[np.ndarray, "samples pixels"]
) -> Bool[np.ndarray, "pixels"]:
    """Pixels that may change, by means over blocks of a window: a lasting change fills at least half of a block."""
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
    """Logarithm of the change of each linear channel."""
    light = []
    for state in (before, after):
        lab = np.nan_to_num(state) / [_LUMINANCE_WEIGHT, 1, 1]
        srgb = cv2.cvtColor(lab.astype(np.float32), cv2.COLOR_LAB2RGB).clip(1e-3, 1)
        light.append(2.2 * np.log(srgb))
    return light[1] - light[0]


def _shadow(*states: Float32[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """Where the change of light is the same in all channels and in the neighborhood."""
    change, square = _light_change(*states), (5, 5)
    mean = change.mean(-1)
    spread = np.sqrt(np.maximum(cv2.blur(mean**2, square) - cv2.blur(mean, square) ** 2, 0))
    return (np.ptp(change, axis=-1) < _EVEN) & (spread < _EVEN)


def _detail_stays(
    mask: Bool[np.ndarray, "height width"],
    before: Float32[np.ndarray, "height width 3"],
    after: Float32[np.ndarray, "height width 3"],
) -> bool:
    """Whether the same surface is seen before and after, in another light: fine detail of luminance correlates.

    Shadows and reflections of people change color too, where light comes from several sides, but they hide nothing
    (texture against cast shadows: Sanin, Sanderson and Lovell 2012).
    """
    known = mask & np.isfinite(before + after).all(-1)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), _DETAIL_PX)
    fine = []
    for state in (before, after):
        value = np.where(known, state[..., 0], 0).astype(np.float32)
        fine.append((value - cv2.GaussianBlur(value, (0, 0), _DETAIL_PX) / np.maximum(weight, 1e-6))[known])
    size = np.linalg.norm(fine[0]) * np.linalg.norm(fine[1])
    return bool(fine[0] @ fine[1] > _SHOWS_THROUGH * size)


def _lab(rgb: UInt8[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
    lab = cv2.GaussianBlur(cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), (0, 0), 0.8)
    lab[..., 0] *= _LUMINANCE_WEIGHT
    return lab


def _medians(
    color: Float32[np.ndarray, "samples pixels 3"], seen: Bool[np.ndarray, "samples pixels"]
) -> Float32[np.ndarray, "samples pixels 3"]:
    """Median of each pixel's latest visible samples up to every sample; NaN where they are too few or differ."""
    kept = np.full((_WINDOW, *color.shape[1:]), np.nan, np.float32)
    medians = np.empty_like(color)
    for k, (now, free) in enumerate(zip(color, seen, strict=True)):
        kept[:, free] = np.concatenate([kept[1:, free], now[None, free]])
        medians[k] = np.median(kept, axis=0)
        near = np.linalg.norm(kept - medians[k], axis=-1) < 0.5 * _NOISES * _NOISE_LAB
        medians[k, near.sum(0) < _CALM] = np.nan
    return medians


def _told(
    mask: Bool[np.ndarray, "height width"],
    first: int,
    last: int,
    rgb: UInt8[np.ndarray, "samples height width 3"],
    hidden: Bool[np.ndarray, "samples height width"],
    before: Float32[np.ndarray, "height width 3"],
    after: Float32[np.ndarray, "height width 3"],
) -> Change:
    """The change with the state that shows the object: the one in which the outline is an image edge."""
    square = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
    solid = mask.astype(np.uint8)
    outer = (cv2.dilate(solid, square) > 0) & ~mask & np.isfinite(before + after).all(-1)
    edges = []
    for state in (before, after):
        # Compare each pixel outside to the mean color of near pixels inside.
        near = cv2.blur(np.nan_to_num(state) * solid[..., None], square.shape)
        weight = cv2.blur(solid.astype(np.float32), square.shape)
        gap = np.linalg.norm(near / np.maximum(weight, 1e-6)[..., None] - state, axis=-1)
        edges.append(float(np.median(gap[outer])) if outer.any() else 0.0)
    came = edges[1] > edges[0]
    sample = range(last, len(rgb)) if came else range(first, -1, -1)
    free = [k for k in sample if not (hidden[k] & mask).any()][:1]
    return Change(mask, first, last, came, rgb[free[0] if free else (last if came else first)])
