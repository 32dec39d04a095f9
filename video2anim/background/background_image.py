"""Background image: the temporal median of every pixel over the frames in which no person covers it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

_STRIP_BYTES = 32 * 2**20
"""Memory for the samples that are worked on at once, in strips of rows."""
_INPAINT_RADIUS_PX = 4.0
"""Pixels of the reduced image, over which Telea's method averages."""


def masked_median(
    samples: UInt8[np.ndarray, "samples *pixels 3"], usable: Bool[np.ndarray, "samples *pixels"]
) -> UInt8[np.ndarray, "*pixels 3"]:
    """Median over the usable samples of each pixel and channel (the lower one of two); 0 where none is usable.

    Found bit by bit from the highest: a bit stays set if no more samples are below the value than may be below the
    median. Faster than a sort.
    """
    # Samples at 255 lie below nothing, so that what is not usable never counts.
    kept = np.where(usable[..., None], samples, np.uint8(255))
    rank = ((usable.sum(axis=0, dtype=np.int16) - 1) // 2)[..., None]
    median = np.zeros(samples.shape[1:], np.uint8)
    for bit in (128, 64, 32, 16, 8, 4, 2, 1):
        candidate = median | np.uint8(bit)
        below = (kept < candidate).view(np.uint8).sum(axis=0, dtype=np.uint8)
        median = np.where(below <= rank, candidate, median)
    median[rank[..., 0] < 0] = 0
    return median


def median_background(
    samples: UInt8[np.ndarray, "samples height width 3"],
    excluded: Bool[np.ndarray, "samples small_height small_width"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Median of the samples without their excluded pixels, black where all are excluded.

    Args:
        samples: At most 255 aligned pictures.
        excluded: What to leave out of each, at any resolution of the same picture.

    Raises:
        ValueError: more than 255 samples.
    """
    count, height, width = samples.shape[:3]
    if count > 255:
        raise ValueError(f"median_background: want at most 255 samples, got {count}")
    rows = _nearest(height, excluded.shape[1])
    columns = _nearest(width, excluded.shape[2])
    background = np.zeros((height, width, 3), np.uint8)
    strip = max(1, _STRIP_BYTES // (count * width * 3))
    for top in range(0, height, strip):
        bottom = min(top + strip, height)
        usable = ~excluded[:, rows[top:bottom]][:, :, columns]
        background[top:bottom] = masked_median(samples[:, top:bottom], usable)
    return background


def updated_background(
    background: UInt8[np.ndarray, "height width 3"],
    samples: UInt8[np.ndarray, "samples height width 3"],
    before: Bool[np.ndarray, "samples small_height small_width"],
    after: Bool[np.ndarray, "samples small_height small_width"],
) -> UInt8[np.ndarray, "height width 3"]:
    """`median_background(samples, after)`, made from `background` = `median_background(samples, before)`.

    Only pixels whose exclusion changed are worked on.
    """
    height, width = background.shape[:2]
    rows, columns = _nearest(height, before.shape[1]), _nearest(width, before.shape[2])
    changed = (before != after).any(axis=0)
    updated = background.copy()
    y, x = np.nonzero(changed[rows][:, columns])
    batch = max(1, _STRIP_BYTES // (3 * len(samples)))
    for first in range(0, len(y), batch):
        yb, xb = y[first : first + batch], x[first : first + batch]
        usable = ~after[:, rows[yb], columns[xb]]
        updated[yb, xb] = masked_median(samples[:, yb, xb], usable)
    return updated


def inpaint_unobserved(
    background: UInt8[np.ndarray, "height width 3"], unseen: Bool[np.ndarray, "small_height small_width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The background image with its unseen pixels inpainted (Telea's method, at the resolution of `unseen`)."""
    if not unseen.any():
        return background
    height, width = background.shape[:2]
    hole = unseen[_nearest(height, unseen.shape[0])][:, _nearest(width, unseen.shape[1])]
    if hole.all():
        return background
    size = (unseen.shape[1], unseen.shape[0])
    # Averages over seen pixels only, so that the hole's black does not enter its border.
    weight = cv2.resize((~hole).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    color = cv2.resize(np.where(hole[..., None], 0, background).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small = np.clip(color / np.maximum(weight, 1e-6)[..., None] + 0.5, 0, 255).astype(np.uint8)
    painted = cv2.inpaint(small, (weight < 0.25).astype(np.uint8), _INPAINT_RADIUS_PX, cv2.INPAINT_TELEA)
    painted = cv2.resize(painted, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(hole[..., None], painted, background)


def with_own_pixels(
    background: UInt8[np.ndarray, "height width 3"],
    first: UInt8[np.ndarray, "height width 3"],
    people: Bool[np.ndarray, "small_height small_width"],
) -> UInt8[np.ndarray, "height width 3"]:
    """The first frame, and the background image where people are in it."""
    rows, columns = _nearest(first.shape[0], people.shape[0]), _nearest(first.shape[1], people.shape[1])
    return np.where(people[rows][:, columns, None], background, first)


def _nearest(length: int, small_length: int) -> np.ndarray:
    """Row (or column) of a small picture that holds each one of a larger picture."""
    return np.minimum(((np.arange(length) + 0.5) * small_length / length).astype(int), small_length - 1)
