"""Outlines of regions of a raster as polygons of few corners, and polygons as triangles."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int
from mapbox_earcut import triangulate_float64
from skimage.measure import approximate_polygon, find_contours

_TOLERANCE = 0.75
"""Maximum distance of outlines from the zero line of the field, in cells; it is below the blur of the field."""


def outlines(field: Float[np.ndarray, "rows columns"]) -> list[Float[np.ndarray, "_ 2"]]:
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
    """The ring without collinear corners, such as the point where the contour began."""
    before, after = np.roll(ring, 1, 0), np.roll(ring, -1, 0)
    span = np.maximum(np.linalg.norm(after - before, axis=1), 1e-9)
    return ring[np.abs(_cross(ring - before, after - before)) / span > 1e-3]


def signed_area(ring: Float[np.ndarray, "corners 2"]) -> float:
    """Positive for a polygon that runs counter-clockwise."""
    return 0.5 * float(_cross(ring, np.roll(ring, -1, 0)).sum())


def triangulated(
    rings: Sequence[Float[np.ndarray, "_ 2"]],
) -> tuple[Float[np.ndarray, "points 2"], Int[np.ndarray, "faces 3"]]:
    """Triangles of polygons with holes, counter-clockwise, as `outlines` gives them: no corners but theirs."""
    outer = [ring for ring in rings if signed_area(ring) > 0]
    holes = [ring for ring in rings if signed_area(ring) < 0]
    points, faces, first = [np.zeros((0, 2))], [np.zeros((0, 3), int)], 0
    for ring in outer:
        inner = [hole for hole in holes if cv2.pointPolygonTest(ring.astype(np.float32), hole[0].tolist(), False) > 0]
        corners = np.concatenate([ring, *inner])
        points.append(corners)
        ends = np.cumsum([len(ring), *map(len, inner)]).astype(np.uint32)
        faces.append(first + triangulate_float64(corners, ends).reshape(-1, 3).astype(int))
        first += len(corners)
    return np.concatenate(points), np.concatenate(faces)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
