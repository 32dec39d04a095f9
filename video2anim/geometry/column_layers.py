"""Near objects and the background behind them, along plumb columns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

_JUMP_COLUMNS = 3
"""Columns over which a jump in distance may spread."""


def background_distance(
    distance_m: Float[np.ndarray, "columns"],
    azimuth_rad: Float[np.ndarray, "columns"],
    *,
    jump_ratio: float = 1.2,
    widest_ratio: float = 0.6,
    far_m: float = np.inf,
) -> tuple[Float[np.ndarray, "columns"], Bool[np.ndarray, "columns"]]:
    """Distance of the background per column, and which columns show something nearer instead.

    A run of columns between two jumps (or a jump and the picture's edge) that is nearer than its neighbors at every
    jump stands before the background; the background passes behind it on a straight line between its neighbors, or at
    the neighbor's distance where there is only one. Nearest runs are taken away first, until none is left.

    Args:
        distance_m: horizontal distance of the first upright surface; may be infinite.
        azimuth_rad: direction of the columns.
        jump_ratio: ratio of neighboring distances that counts as a jump.
        widest_ratio: a run wider than this share of the columns is background.
        far_m: distances are cut here.
    """
    background = np.minimum(distance_m, far_m).astype(np.float64)
    hidden = np.zeros(len(background), dtype=bool)
    for _ in range(len(background)):
        run = _nearest_run(background, jump_ratio, widest_ratio)
        if run is None:
            break
        start, stop = run
        _bridge(background, azimuth_rad, start, stop)
        hidden[start:stop] = True
    return background, hidden & (distance_m < background / (1 + 0.5 * (jump_ratio - 1)))


def _nearest_run(distance_m: np.ndarray, jump_ratio: float, widest_ratio: float) -> tuple[int, int] | None:
    edges = [0, *_jumps(distance_m, jump_ratio), len(distance_m)]
    best: tuple[float, int, int] | None = None
    for start, stop in pairwise(edges):
        if stop - start > widest_ratio * len(distance_m) or len(edges) == 2:
            continue
        inside = np.median(distance_m[start:stop])
        before = distance_m[max(start - _JUMP_COLUMNS, 0)] if start > 0 else np.inf
        after = distance_m[min(stop + _JUMP_COLUMNS - 1, len(distance_m) - 1)] if stop < len(distance_m) else np.inf
        nearer = inside * (1 + 0.5 * (jump_ratio - 1)) < min(before, after)
        if nearer and (best is None or inside < best[0]):
            best = (float(inside), start, stop)
    return None if best is None else best[1:]


def _jumps(distance_m: np.ndarray, jump_ratio: float) -> list[int]:
    """Columns at which a new run begins: the steepest place of every stretch with a jump."""
    if len(distance_m) <= _JUMP_COLUMNS:
        return []
    log = np.log(np.maximum(distance_m, 1e-3))
    wide = np.abs(log[_JUMP_COLUMNS:] - log[:-_JUMP_COLUMNS]) > np.log(jump_ratio)
    step = np.abs(np.diff(log))
    found: list[int] = []
    start = 0
    while start < len(wide):
        if not wide[start]:
            start += 1
            continue
        stop = start
        while stop < len(wide) and wide[stop]:
            stop += 1
        stretch = step[start : stop + _JUMP_COLUMNS - 1]
        tops = np.flatnonzero(stretch > max(0.5 * np.log(jump_ratio), 0.34 * stretch.max()))
        found.extend(int(start + top + 1) for top in tops)
        start = stop
    return sorted(set(found))


def _bridge(distance_m: np.ndarray, azimuth_rad: np.ndarray, start: int, stop: int) -> None:
    """Replace columns start..stop by the straight wall between their neighbors."""
    if start == 0 or stop >= len(distance_m):
        distance_m[start:stop] = distance_m[stop] if start == 0 else distance_m[start - 1]
        return
    ends = [start - 1, stop]
    x0, x1 = (distance_m[e] * np.sin(azimuth_rad[e]) for e in ends)
    z0, z1 = (distance_m[e] * np.cos(azimuth_rad[e]) for e in ends)
    angle = azimuth_rad[start:stop]
    across = np.sin(angle) * (z1 - z0) - np.cos(angle) * (x1 - x0)
    bridged = (x0 * (z1 - z0) - z0 * (x1 - x0)) / np.where(np.abs(across) < 1e-9, 1e-9, across)
    low, high = sorted((distance_m[ends[0]], distance_m[ends[1]]))
    distance_m[start:stop] = np.clip(bridged, 0.7 * low, high)
