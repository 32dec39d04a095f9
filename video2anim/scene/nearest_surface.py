"""Nearest triangle of a solid to each point, with the signed distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from video2anim.geometry.sdf import point_triangle_distance, surface_samples

_NEAREST_SAMPLES = 4
"""Surface samples whose triangles are tested per point: two triangles meet at an edge, three or more at a corner of a
box, of which any two give the sign."""
_SAME_M = 1e-6
"""Distances closer than this are equal, as of triangles that share the nearest point on an edge (float64 rounding over
the extent of a room)."""


@dataclass(frozen=True, slots=True, eq=False)
class NearestSurface:
    """Results for the points with a surface in reach."""

    point: Int[np.ndarray, "found"]
    """Ascending numbers of the points."""
    face: Int[np.ndarray, "found"]
    """The nearest triangle of each."""
    distance_m: Float[np.ndarray, "found"]
    """Positive outside (where the triangle faces), negative inside."""


def nearest_surface(
    points_m: Float[np.ndarray, "points 3"],
    triangles_m: Float[np.ndarray, "faces 3 3"],
    *,
    reach_m: float,
    sample_step_m: float = 0.02,
) -> NearestSurface:
    """Nearest triangles of a solid whose triangles face outward.

    The distance is exact to the triangles of the 4 nearest surface samples, which lie at most a step apart.

    Args:
        points_m: in the frame of the triangles.
        triangles_m: corners, counterclockwise from outside; degenerate ones are not found.
        reach_m: points farther away are left out.
        sample_step_m: longest edge of the pieces whose centers are the samples.
    """
    normals = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    area2 = np.linalg.norm(normals, axis=-1)
    whole = np.flatnonzero(area2 > 0)
    near = _within_box(points_m, triangles_m[whole].reshape(-1, 3), reach_m) if len(whole) else whole
    if not len(near):
        return _nothing()
    # Drop triangles and samples far from all points; the nearest sample of a triangle is up to a step farther than it.
    low_m, high_m = points_m[near].min(0) - reach_m, points_m[near].max(0) + reach_m
    beside = (triangles_m[whole].max(1) < low_m) | (triangles_m[whole].min(1) > high_m)
    number = whole[~beside.any(1)]
    if not len(number):
        return _nothing()
    samples_m, owner = surface_samples(triangles_m[number], sample_step_m)
    kept = _within_box(samples_m, points_m[near], reach_m + sample_step_m)
    count = min(_NEAREST_SAMPLES, len(kept))
    if not count:
        return _nothing()
    tree = KDTree(samples_m[kept])
    _, nearest = tree.query(points_m[near], k=count, distance_upper_bound=reach_m + sample_step_m)
    found = np.asarray(nearest).reshape(len(near), count)
    row, column = np.nonzero(found < len(kept))
    faces = number[owner[kept[found[row, column]]]]
    distance_m = point_triangle_distance(points_m[near[row]], triangles_m[faces])
    above_m = np.einsum("nd,nd->n", points_m[near[row]] - triangles_m[faces, 0], normals[faces]) / area2[faces]
    # The nearest; of those that share an edge there, the one whose plane is farthest from the point.
    order = np.lexsort((-np.abs(above_m), np.round(distance_m / _SAME_M), row))
    order = order[np.unique(row[order], return_index=True)[1]]
    order = order[distance_m[order] <= reach_m]
    return NearestSurface(near[row[order]], faces[order], np.copysign(distance_m[order], above_m[order]))


def _nothing() -> NearestSurface:
    return NearestSurface(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))


def _within_box(
    points_m: Float[np.ndarray, "points 3"], around_m: Float[np.ndarray, "others 3"], reach_m: float
) -> Int[np.ndarray, "inside"]:
    """Numbers of the points in the box around other points, widened by a reach."""
    low_m, high_m = around_m.min(0) - reach_m, around_m.max(0) + reach_m
    return np.flatnonzero(((points_m >= low_m) & (points_m <= high_m)).all(1))
