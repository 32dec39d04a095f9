"""The outline of an object of which a detector gives the box: its colors and depth against those around it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_AROUND = 0.25
"""Share of the box on each side that shows what is not the object."""
_LONG_SIDE_PX = 160
"""Size at which the outline is cut: finer than the depth, and 50 ms."""
_ROUNDS = 5
_MIN_PX = 4


def outlined(
    image_rgb: UInt8[np.ndarray, "height width 3"],
    depth_m: Float[np.ndarray, "rows columns"],
    floor: Bool[np.ndarray, "rows columns"],
    box_px: Float[np.ndarray, "4"],
) -> Bool[np.ndarray, "height width"]:
    """Pixels of the box that are unlike those around it (GrabCut, Rother et al. 2004, on lightness, hue and depth).

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
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(looks, trimap, (0, 0, 0, 0), *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    cut = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    found[window] = cv2.resize(cut, tuple(high - low), interpolation=cv2.INTER_NEAREST) > 0
    return found
