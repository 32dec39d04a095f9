"""The whole outline of a partly hidden object, and a picture of it.

Pixels are added only where something can hide the object: a nearer object, or a place the camera never saw free.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from scipy.ndimage import binary_fill_holes

GRAY = 127
"""Color around the object."""
_MIRROR_OVERLAP = 0.85
_INPAINT_LONG_SIDE_PX = 320


def amodal_mask(
    visible: Bool[np.ndarray, "height width"], hidden: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Visible pixels, plus hidden ones that the object's convexity, its mirror image or its support call for.

    Args:
        visible: pixels of the object.
        hidden: pixels where something nearer, or never-seen ground, covers whatever is behind.
    """
    if not visible.any():
        return visible.copy()
    mask = _filled(visible)
    mask |= _hull(mask) & hidden
    mirrored = _mirrored(mask)
    if (mirrored & mask).sum() > _MIRROR_OVERLAP * (mirrored | mask).sum():
        mask |= mirrored & hidden
    return _filled(mask | _down_to_floor(mask, hidden))


def _filled(mask: np.ndarray) -> Bool[np.ndarray, "height width"]:
    return np.asarray(binary_fill_holes(mask), dtype=bool)


def _hull(mask: np.ndarray) -> np.ndarray:
    points = np.argwhere(mask)[:, ::-1].astype(np.int32)
    filled = np.zeros(mask.shape, dtype=np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return filled.astype(bool)


def _mirrored(mask: np.ndarray) -> np.ndarray:
    """Mirror image about the vertical line through the middle of the outline."""
    columns = np.flatnonzero(mask.any(0))
    flipped = columns[0] + columns[-1] - np.arange(mask.shape[1])
    inside = (flipped >= 0) & (flipped < mask.shape[1])
    mirrored = np.zeros_like(mask)
    mirrored[:, inside] = mask[:, flipped[inside]]
    return mirrored


def _down_to_floor(mask: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Columns whose lower end is hidden go down to the line between the lower ends that are seen."""
    columns = np.flatnonzero(mask.any(0))
    lowest = mask.shape[0] - 1 - np.argmax(mask[::-1, columns], axis=0)
    below = np.minimum(lowest + 1, mask.shape[0] - 1)
    cut = hidden[below, columns] & (lowest < mask.shape[0] - 1)
    added = np.zeros_like(mask)
    if not cut.any() or (~cut).sum() < 2:
        return added
    foot = np.maximum(np.interp(columns, columns[~cut], lowest[~cut]), lowest)
    rows = np.arange(mask.shape[0])[:, None]
    added[:, columns] = cut & (rows > lowest) & (rows <= foot)
    return added & hidden


def object_picture(
    image_rgb: UInt8[np.ndarray, "height width 3"],
    visible: Bool[np.ndarray, "height width"],
    amodal: Bool[np.ndarray, "height width"],
) -> tuple[UInt8[np.ndarray, "crop_height crop_width 3"], tuple[int, int]]:
    """Crop of the amodal box with hidden pixels inpainted and gray outside, and its top-left pixel.

    Raises:
        ValueError: the mask is empty.
    """
    rows, columns = np.nonzero(amodal)
    if not len(rows):
        raise ValueError("object_picture: want a mask with pixels, got an empty one")
    top, left = int(rows.min()), int(columns.min())
    window = (slice(top, int(rows.max()) + 1), slice(left, int(columns.max()) + 1))
    crop, whole = image_rgb[window].copy(), amodal[window]
    missing = whole & ~visible[window]
    if missing.any():
        crop[missing] = _inpainted(crop, whole, missing)[missing]
    crop[~whole] = GRAY
    return crop, (left, top)


def _inpainted(crop: np.ndarray, whole: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Colors for the missing pixels from the object's own visible ones, at a limited size for speed."""
    height, width = whole.shape
    shrink = min(1.0, _INPAINT_LONG_SIDE_PX / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    small = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
    known = cv2.resize((whole & ~missing).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    if not known.any():
        return crop
    filled = cv2.inpaint(small, 1 - known, 3, cv2.INPAINT_TELEA)
    return cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
