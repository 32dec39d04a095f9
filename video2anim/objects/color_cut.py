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
    near, core = _dilated(mask, band), ~_dilated(~mask, 2 * band)
    rows, columns = np.nonzero(_dilated(mask, 4 * band))
    window = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] if len(rows) else np.s_[:, :]
    labels = np.select([core, others | ~near, mask], [cv2.GC_FGD, cv2.GC_BGD, cv2.GC_PR_FGD], cv2.GC_PR_BGD).astype(
        np.uint8
    )[window]
    is_object = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if not is_object.any() or is_object.all():
        return mask
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(image_rgb[window]), labels, None, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = np.zeros_like(mask)
    found[window] = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    found = _without_specks(found)
    return found if (found & mask).sum() >= _MIN_IOU * (found | mask).sum() else mask


def _dilated(mask: np.ndarray, pixels: int) -> np.ndarray:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


def _without_specks(mask: np.ndarray) -> np.ndarray:
    _, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return np.isin(label, np.flatnonzero(area >= max(_MIN_PART * area.max(), 1)))
