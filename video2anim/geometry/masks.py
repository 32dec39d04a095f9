"""Masks at other sizes."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float


def shrunk(
    mask: Bool[np.ndarray, "height width"], shape: tuple[int, ...], share: float = 0.5
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels of the smaller size of which more than the share is in the mask; `shape` is (rows, columns)."""
    return cv2.resize(mask.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA) > share


def enlarged(
    values: Float[np.ndarray, "small_height small_width"], shape: tuple[int, ...]
) -> Float[np.ndarray, "rows columns"]:
    """Values between the pixels; `shape` is (rows, columns)."""
    return cv2.resize(values.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
