"""Masks at other sizes, and grown."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

_NEVER_SEEN = 0.02
"""Of the frames: less is an error of the people's masks."""


def shrunk(
    mask: Bool[np.ndarray, "height width"], shape: tuple[int, ...], share: float = 0.5
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels of the smaller size of which more than the share is in the mask; `shape` is (rows, columns)."""
    return cv2.resize(mask.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA) > share


def never_seen(
    seen_ratio: Float[np.ndarray, "small_height small_width"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels that people covered in nearly all frames, from the share of frames in which they did not."""
    seen = cv2.resize(seen_ratio.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return seen < _NEVER_SEEN


def dilated(mask: Bool[np.ndarray, "height width"], radius_px: int) -> Bool[np.ndarray, "height width"]:
    """The mask grown by a disc."""
    if radius_px < 1:
        return mask
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))
    return cv2.dilate(mask.astype(np.uint8), disc).astype(bool)
