"""Masks whose outlines follow the colors of the image: GrabCut (Rother et al. 2004) in a band around each outline."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

_BAND = 0.06
"""Outlines by networks and depth are off by up to this share of the square root of the mask's area: looked at in the
background images of ten real clips."""
_ROUNDS = 4
"""Of color models and cuts; further ones change little."""
_MIN_IOU = 0.5
"""An object whose colors are those of what is around it cannot be cut out: a cut with less overlap is not used."""
_MIN_PART = 0.1
"""Parts smaller than this share of the largest are specks."""
_OBJECT = (cv2.GC_FGD, cv2.GC_PR_FGD)
_UNUSED_BOX = (0, 0, 1, 1)


def cut_by_color(
    mask: Bool[np.ndarray, "rows columns"],
    image_rgb: UInt8[np.ndarray, "rows columns 3"],
    others: Bool[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """The mask with its outline where the image's colors change; the mask itself where they do not tell.

    Args:
        mask: Of one object.
        image_rgb: The image at the size of the mask.
        others: Pixels of other objects.
    """
    band = max(2, round(_BAND * float(np.sqrt(mask.sum()))))
    window = _window(_dilated(mask, 4 * band))
    labels = _labels(mask, others, band)[window]
    is_object = np.isin(labels, _OBJECT)
    if not is_object.any() or is_object.all():
        return mask
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(image_rgb[window]), labels, _UNUSED_BOX, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = np.zeros_like(mask)
    found[window] = np.isin(labels, _OBJECT)
    found = _without_specks(found)
    return found if (found & mask).sum() >= _MIN_IOU * (found | mask).sum() else mask


def _labels(mask: np.ndarray, others: np.ndarray, band: int) -> UInt8[np.ndarray, "rows columns"]:
    """What GrabCut starts from: only pixels within the band outside of the mask, and twice that inside, are open."""
    sure, far = ~_dilated(~mask, 2 * band), others | ~_dilated(mask, band)
    labels = np.select([sure, far, mask], [cv2.GC_FGD, cv2.GC_BGD, cv2.GC_PR_FGD], cv2.GC_PR_BGD)
    return labels.astype(np.uint8)


def _window(mask: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns that have any of it; all if there is none."""
    rows, columns = np.nonzero(mask) if mask.any() else np.nonzero(~mask)
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


def _dilated(mask: np.ndarray, pixels: int) -> np.ndarray:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


def _without_specks(mask: np.ndarray) -> np.ndarray:
    _, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return np.isin(label, np.flatnonzero(area >= max(_MIN_PART * area.max(), 1)))
