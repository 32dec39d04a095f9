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


def ground_contact_distance(
    distance_m: Float[np.ndarray, "seen_columns"],
    azimuth_rad: Float[np.ndarray, "seen_columns"],
    all_azimuth_rad: Float[np.ndarray, "columns"],
) -> Float[np.ndarray, "columns"]:
    """Distance of an upright object in every column, from the foot line in the columns where it is seen.

    A foot line that is straight on the floor, but for outliers, is taken as straight (a flat front); any other one is
    only cleared of outliers.
    """
    steady_m = _median_along(distance_m)
    points = distance_m[:, None] * np.stack([np.sin(azimuth_rad), np.cos(azimuth_rad)], -1)
    normal, level_m = _robust_line(points, 0.01 * float(np.median(distance_m)))
    off_m = np.abs(points @ normal - level_m)
    towards = np.stack([np.sin(all_azimuth_rad), np.cos(all_azimuth_rad)], -1) @ normal
    reach = level_m / np.where(np.abs(towards) < 1e-6, 1e-6, towards)
    seen = (all_azimuth_rad >= azimuth_rad.min()) & (all_azimuth_rad <= azimuth_rad.max())
    sane = (reach[seen] > 0.7 * distance_m.min()).all() and (reach[seen] < 1.3 * distance_m.max()).all()
    if sane and np.median(off_m) < 0.03 * np.median(distance_m):
        held = np.clip(all_azimuth_rad, azimuth_rad.min(), azimuth_rad.max())
        return np.interp(held, all_azimuth_rad, np.clip(reach, 0.5 * distance_m.min(), 1.5 * distance_m.max()))
    return np.interp(all_azimuth_rad, azimuth_rad, steady_m)


def _robust_line(points_m: np.ndarray, scale_m: float) -> tuple[np.ndarray, float]:
    """Unit normal and level (normal . x = level) of the line with the least sum of distances, by reweighting."""
    weight, normal, level_m = np.ones(len(points_m)), np.array([0.0, 1.0]), 0.0
    for _ in range(10):
        center = np.average(points_m, axis=0, weights=weight)
        _, vectors = np.linalg.eigh(np.cov(points_m.T, aweights=weight) + 1e-12 * np.eye(2))
        normal = vectors[:, 0]
        level_m = float(center @ normal)
        weight = 1 / np.maximum(np.abs(points_m @ normal - level_m), scale_m)
    return normal, level_m


def _median_along(distance_m: np.ndarray) -> np.ndarray:
    """Running median over an eighth of the columns."""
    width = min(len(distance_m) // 8 * 2 + 1, 15)
    padded = np.pad(distance_m, width // 2, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, width), -1)
