"""Outlines of regions of a raster as polygons of few corners, and polygons as triangles."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int
from skimage.measure import approximate_polygon, find_contours

_TOLERANCE = 0.75
"""Outlines may leave the line where a field is zero by so many cells: less than its blur."""


def outlines(field: Float[np.ndarray, "rows columns"]) -> list[Float[np.ndarray, "corners 2"]]:
    """Closed polygons (column, row) around where a field over a raster's nodes is positive: counter-clockwise with rows
    upward, holes the other way round. They end at the raster's border."""
    # Outside is as negative as the border is positive, so that clipping puts the line onto the border.
    edge = np.pad(field, 1, constant_values=-1.0)
    found = []
    last = np.array(field.shape[::-1]) - 1.0
    for line in find_contours(edge, 0.0):
        ring = approximate_polygon(np.clip(line[:, ::-1] - 1, 0, last), _TOLERANCE)[:-1]
        ring = _without_idle(ring)
        if len(ring) >= 3:
            found.append(ring)
    # The contour of a region runs one way, that of its holes the other.
    areas = [signed_area(ring) for ring in found]
    if areas and areas[int(np.argmax(np.abs(areas)))] < 0:
        found = [ring[::-1] for ring in found]
    return found


def _without_idle(ring: np.ndarray) -> np.ndarray:
    """Without corners that lie on the line between their neighbors: where the line began."""
    before, after = np.roll(ring, 1, 0), np.roll(ring, -1, 0)
    span = np.maximum(np.linalg.norm(after - before, axis=1), 1e-9)
    return ring[np.abs(_cross(ring - before, after - before)) / span > 1e-3]


def signed_area(ring: Float[np.ndarray, "corners 2"]) -> float:
    """Positive for a polygon that runs counter-clockwise."""
    return 0.5 * float(_cross(ring, np.roll(ring, -1, 0)).sum())


def triangulated(
    rings: Sequence[Float[np.ndarray, "corners 2"]],
) -> tuple[Float[np.ndarray, "points 2"], Int[np.ndarray, "faces 3"]]:
    """Triangles of polygons with holes, counter-clockwise, as `outlines` gives them: no corners but theirs."""
    outer = [ring for ring in rings if signed_area(ring) > 0]
    holes = [ring for ring in rings if signed_area(ring) < 0]
    points, faces, first = [np.zeros((0, 2))], [np.zeros((0, 3), int)], 0
    for ring in outer:
        inner = [hole for hole in holes if cv2.pointPolygonTest(ring.astype(np.float32), hole[0].tolist(), False) > 0]
        corners = np.concatenate([ring, *inner])
        points.append(corners)
        faces.append(first + _ears(corners, _bridged(ring, inner)))
        first += len(corners)
    return np.concatenate(points), np.concatenate(faces)


def _bridged(ring: np.ndarray, holes: Sequence[np.ndarray]) -> list[int]:
    """One closed way along all rings of a polygon, with a way there and back to each hole; numbers of corners."""
    corners = np.concatenate([ring, *holes])
    starts = np.cumsum([len(ring), *map(len, holes)])
    edges = [np.stack([n := np.arange(len(ring)), np.roll(n, -1)], 1)]
    edges += [np.stack([n := np.arange(a, b), np.roll(n, -1)], 1) for a, b in itertools.pairwise(starts)]
    edge = np.concatenate(edges)
    way = list(range(len(ring)))
    # From right to left: a hole's rightmost corner then sees the way.
    for number in sorted(range(len(holes)), key=lambda k: -holes[k][:, 0].max()):
        loop = np.arange(starts[number], starts[number + 1])
        loop = np.roll(loop, -int(holes[number][:, 0].argmax()))
        gap = np.linalg.norm(corners[way] - corners[loop[0]], axis=1)
        for at in np.argsort(gap):
            # A corner that has a bridge is there twice, and only one of the two would do.
            free = way.count(way[at]) == 1
            if free and not _crosses(corners[loop[0]], corners[way[at]], corners[edge[:, 0]], corners[edge[:, 1]]):
                break
        else:
            continue
        edge = np.concatenate([edge, [[loop[0], way[at]]]])
        way = [*way[: at + 1], *loop.tolist(), int(loop[0]), *way[at:]]
    return way


def _crosses(a: np.ndarray, b: np.ndarray, start: np.ndarray, end: np.ndarray) -> bool:
    """Whether a line properly crosses any of others."""
    one, two = _cross(b - a, start - a), _cross(b - a, end - a)
    three, four = _cross(end - start, a - start), _cross(end - start, b - start)
    return bool(((one * two < -1e-9) & (three * four < -1e-9)).any())


def _ears(corners: np.ndarray, way: list[int]) -> Int[np.ndarray, "faces 3"]:
    """Ears cut off a way around a polygon, the best shaped first."""
    faces = []
    while len(way) > 2:
        number = np.array(way)
        p = corners[number]
        a, b, c = np.roll(p, 1, 0), p, np.roll(p, -1, 0)
        area = _cross(b - a, c - a)
        longest = np.maximum.reduce([((x - y) ** 2).sum(1) for x, y in ((a, b), (b, c), (c, a))])
        quality = area / np.maximum(longest, 1e-12)
        inside = np.ones((len(p), len(p)), bool)
        for x, y in ((a, b), (b, c), (c, a)):
            inside &= _cross((y - x)[:, None], p[None] - x[:, None]) >= -1e-9
        for x in (a, b, c):
            inside &= ((p[None] - x[:, None]) ** 2).sum(-1) > 1e-12
        quality[inside.any(1)] -= 10.0
        best = int(quality.argmax())
        if area[best] > 1e-9:
            faces.append([number[best - 1], number[best], number[(best + 1) % len(number)]])
        del way[best]
    return np.array(faces, int).reshape(-1, 3)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
