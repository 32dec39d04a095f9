"""Overlapping square tiles of a picture, for networks that see small objects only when they look closer."""

from __future__ import annotations

import math
from collections.abc import Iterator

_ZOOMS = (1, 2)
_OVERLAP = 0.4


def square_tiles(width_px: int, height_px: int, *, min_px: int) -> Iterator[tuple[int, int, int]]:
    """x0, y0, side of tiles as high as the picture is small, then of half that; none below `min_px`."""
    for zoom in _ZOOMS:
        side = min(width_px, height_px) // zoom
        if side < min_px or (zoom == 1 and width_px == height_px):
            continue
        for y0 in _starts(height_px, side):
            for x0 in _starts(width_px, side):
                yield x0, y0, side


def _starts(length: int, side: int) -> list[int]:
    spare = length - side
    count = 1 + math.ceil(spare / (side * (1.0 - _OVERLAP)))
    return [round(spare * k / max(count - 1, 1)) for k in range(count)]
