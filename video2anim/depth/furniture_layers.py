"""Outline of an upright object whose lower part is known."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_fill_holes, grey_closing

from video2anim.depth.floor_boundary import BoundaryConfig, best_path, image_codes, look_log_ratio

_MARGIN_RATIO = 0.08
"""Room left and right of the known part, as a share of its width: roofs and crowns stick out."""
_SPIKE_RATIO = 0.2
"""Peaks narrower than this share of the width are taken for background of the same color."""
_CONFIG = BoundaryConfig(
    jump_weight=1.5, jump_limit=18.0, edge_weight=8.0, ratio_limit=2.0, evidence_needed=0.3, pixel_weight=0.15
)


def grow_cutout(
    image_rgb: UInt8[np.ndarray, "rows columns 3"],
    seen: Bool[np.ndarray, "rows columns"],
    part: Bool[np.ndarray, "rows columns"],
    floor: Bool[np.ndarray, "rows columns"],
    top_row: int,
) -> Bool[np.ndarray, "rows columns"]:
    """Whole visible outline of an upright object from its part before the floor.

    The upper end of every plumb column is found by dynamic programming, in rounds: the object looks like its known part
    and what was found above it, the rest of the picture does not, and its upper edge is a line without needless jumps.

    Args:
        part: pixels known to belong to the object.
        floor: pixels known not to.
        top_row: it does not reach above this row.
    """
    columns = np.flatnonzero(part.any(0))
    width = int(np.ptp(columns)) + 1
    left, right = int(columns.min()), int(columns.max()) + 1
    margin = max(2, round(_MARGIN_RATIO * width))
    wide = slice(max(left - margin, 0), min(right + margin, part.shape[1]))
    row = np.arange(part.shape[0])[:, None]
    first = np.argmax(part, axis=0)
    own = part | (seen & part.any(0) & (row <= first) & (row >= np.maximum(first - width // 2, top_row)))
    codes, gradient = image_codes(image_rgb)
    mask = part
    for _ in range(_CONFIG.rounds):
        other = seen & ~own & ~floor
        if not other.any():
            return own
        ratio = look_log_ratio(codes, own, other, part, _CONFIG.ratio_limit)
        cost = _top_costs(ratio[:, wide], gradient[:, wide], seen[:, wide], part[:, wide], top_row)
        top, _ = best_path(cost, _CONFIG)
        top = _without_spikes(top, max(3, round(_SPIKE_RATIO * width)))
        own = part.copy()
        own[:, wide] |= (row >= top[None, :]) & (row <= first[wide]) & part[:, wide].any(0)
        mask = own.copy()
        mask[:, wide] |= _overhang(ratio[:, wide], top, part[:, wide])
    return np.asarray(binary_fill_holes(mask & seen & ~floor), dtype=bool)


def _without_spikes(top: np.ndarray, width: int) -> np.ndarray:
    """Upper edge without peaks narrower than `width` columns (a row counts down, so peaks are dips in it)."""
    return np.asarray(grey_closing(top, size=min(width, len(top)), mode="nearest"))


def _top_costs(
    ratio: np.ndarray, gradient: np.ndarray, seen: np.ndarray, part: np.ndarray, top_row: int
) -> Float[np.ndarray, "columns candidates"]:
    """Cost of the object's highest row being t, in 0..rows (rows = nothing of it in the column)."""
    weighed = np.where(seen & ~part, ratio - _CONFIG.evidence_needed, 0.0) * _CONFIG.pixel_weight
    known = part.any(0)
    first = np.where(known, np.argmax(part, axis=0), part.shape[0] - np.argmax(np.any(part, axis=1)[::-1]))
    row = np.arange(part.shape[0] + 1)[:, None]
    above = np.concatenate([np.zeros((1, ratio.shape[1])), np.cumsum(np.where(row[:-1] < first, weighed, 0), axis=0)])
    edge = np.concatenate([np.where(seen, gradient, 0.0), np.zeros((1, ratio.shape[1]))])
    cost = 2 * above - above[-1:] - _CONFIG.edge_weight * np.maximum(edge, np.roll(edge, 1, axis=0))
    cost = np.where(row < top_row, 1e6, cost)
    cost = np.where((row > first) & known, 1e6, cost)
    return np.ascontiguousarray(cost.T)


def _overhang(ratio: np.ndarray, top: np.ndarray, part: np.ndarray) -> Bool[np.ndarray, "rows columns"]:
    """Parts beside the known columns that look like the object, between its top and its foot."""
    beside = ~np.any(part, axis=0)
    row = np.arange(part.shape[0])[:, None]
    looks = cv2.morphologyEx((ratio > 0.5).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)
    return looks & beside[None, :] & (row >= top[None, :]) & (row < np.argmax(part.any(1)))
