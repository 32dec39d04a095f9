"""Outlines of objects by GrabCut (Rother et al. 2004): out of a detector's box, by color and depth, and in a band
around a mask, by color."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.geometry.masks import dilated

_AROUND = 0.25
"""Share of the box on each side that shows what is not the object."""
_LONG_SIDE_PX = 160
"""Size at which the outline is cut: finer than the depth, and 50 ms."""
_ROUNDS, _MASK_ROUNDS = 5, 4
"""Of color models and cuts, in a box and around a mask. Not measured."""
_MIN_PX = 4
_BAND = 0.06
"""Masks by networks and depth are off by up to this share of the square root of their area: looked at in the background
images of six real clips, no other value was tried."""
_MIN_IOU = 0.5
"""An object whose colors are those of what is around it cannot be cut out: a cut with less overlap is not used.
Not measured."""
_MIN_PART = 0.1
"""Parts smaller than this share of the largest are specks. Not measured."""
_OBJECT = (cv2.GC_FGD, cv2.GC_PR_FGD)


def outlined(
    image_rgb: UInt8[np.ndarray, "height width 3"],
    depth_m: Float[np.ndarray, "rows columns"],
    floor: Bool[np.ndarray, "rows columns"],
    box_px: Float[np.ndarray, "4"],
) -> Bool[np.ndarray, "height width"]:
    """Pixels of the box that are unlike those around it in lightness, hue and depth.

    Args:
        image_rgb: The whole picture.
        depth_m: Of any size.
        floor: Pixels of the floor, at the size of the depth; they start as what is around.
        box_px: x0, y0, x1, y1 in the picture.
    """
    height, width = image_rgb.shape[:2]
    found = np.zeros((height, width), bool)
    side = box_px[2:] - box_px[:2]
    low = np.maximum(np.floor(box_px[:2] - _AROUND * side), 0).astype(int)
    high = np.minimum(np.ceil(box_px[2:] + _AROUND * side), [width, height]).astype(int)
    if (high - low < _MIN_PX).any():
        return found
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    shrink = min(1.0, _LONG_SIDE_PX / max(high - low))
    size = tuple(int(v) for v in np.maximum(np.round((high - low) * shrink), _MIN_PX))
    lab = cv2.cvtColor(cv2.resize(image_rgb[window], size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2LAB)
    depth, ground = (
        cv2.resize(cv2.resize(values.astype(np.float32), (width, height))[window], size) for values in (depth_m, floor)
    )
    inverse = 1 / np.maximum(depth, 0.1)
    near, far = np.percentile(inverse, [98, 2])
    hue = lab[..., 1].astype(np.int32) + lab[..., 2] - 128
    nearness = np.clip(255 * (inverse - far) / max(near - far, 1e-6), 0, 255)
    looks = np.stack([lab[..., 0], np.clip(hue, 0, 255), nearness], -1).astype(np.uint8)
    trimap = np.full(size[::-1], cv2.GC_BGD, np.uint8)
    x0, y0, x1, y1 = np.round((box_px - np.tile(low, 2)) * shrink).astype(int)
    inner = (slice(max(y0, 0), max(y1, 0) + 1), slice(max(x0, 0), max(x1, 0) + 1))
    trimap[inner] = np.where(ground[inner] > 0.5, cv2.GC_PR_BGD, cv2.GC_PR_FGD)
    if not (trimap == cv2.GC_PR_FGD).any() or not (trimap == cv2.GC_BGD).any():
        return found
    cut = _grab_cut(looks, trimap, _ROUNDS).astype(np.uint8)
    found[window] = cv2.resize(cut, tuple(high - low), interpolation=cv2.INTER_NEAREST) > 0
    return found


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
    window = _window(dilated(mask, 4 * band))
    labels = _labels(mask, others, band)[window]
    is_object = np.isin(labels, _OBJECT)
    if not is_object.any() or is_object.all():
        return mask
    found = np.zeros_like(mask)
    found[window] = _grab_cut(image_rgb[window], labels, _MASK_ROUNDS)
    found = _without_specks(found)
    return found if (found & mask).sum() >= _MIN_IOU * (found | mask).sum() else mask


def _labels(mask: np.ndarray, others: np.ndarray, band: int) -> UInt8[np.ndarray, "rows columns"]:
    """What GrabCut starts from: only pixels within the band outside of the mask, and twice that inside, are open."""
    sure, far = ~dilated(~mask, 2 * band), others | ~dilated(mask, band)
    labels = np.select([sure, far, mask], [cv2.GC_FGD, cv2.GC_BGD, cv2.GC_PR_FGD], cv2.GC_PR_BGD)
    return labels.astype(np.uint8)


def _window(mask: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns that have any of it; all if there is none."""
    rows, columns = np.nonzero(mask) if mask.any() else np.nonzero(~mask)
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


def _without_specks(mask: np.ndarray) -> np.ndarray:
    _, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return np.isin(label, np.flatnonzero(area >= max(_MIN_PART * area.max(), 1)))


def _grab_cut(
    image: UInt8[np.ndarray, "rows columns 3"], labels: UInt8[np.ndarray, "rows columns"], rounds: int
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels of the object."""
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    labels = labels.copy()
    cv2.grabCut(np.ascontiguousarray(image), labels, (0, 0, 0, 0), *models, rounds, cv2.GC_INIT_WITH_MASK)
    return np.isin(labels, _OBJECT)
