"""Nearest points on a triangle mesh, and which points its closed parts enclose."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from video2anim.geometry.sdf import surface_samples

_SAMPLE_STEP_M = 0.08
_MAX_SAMPLES = 400_000
_FEW_SAMPLES, _MANY_SAMPLES = 8, 48
_RADIUS_PER_STEP = 2 / 3
"""A centroid is at most this share of the longest edge away from any point of its triangle."""
_WELD_M = 1e-5
"""Corners nearer than this are one: files repeat a corner for each of its normals."""
_RAY_SHIFT_M = np.array([3.1e-6, 7.3e-6])
"""Rays miss the queried point by this, so that none runs along an edge of an axis-aligned mesh."""
_PAIRS_AT_ONCE = 2_000_000


class MeshSurface:
    """Triangles (faces, 3, 3), as a surface or as the solid that closed parts enclose.

    The nearest point is exact to the triangles of the 8, and where those may not be all that matter 48, nearest surface
    samples: centroids of pieces with edges up to 8 cm (more for surfaces above 300 m2). So the distance is never too
    small, and exact nearly everywhere; measured against all triangles (tests): exact below 20 cm, 1 point in 1000 of a
    room wrong by more than 0.1 mm, at most 2 cm (points that hundreds of triangles are equally far from).
    """

    def __init__(self, triangles_m: Float[np.ndarray, "faces 3 3"], *, fill: bool = False) -> None:
        self._triangles_m = triangles_m
        edges = triangles_m[:, 1:] - triangles_m[:, :1]
        area_m2 = 0.5 * float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1).sum())
        # A piece of edge h has 0.12 to 0.25 h^2 of area.
        step_m = max(_SAMPLE_STEP_M, (area_m2 / (0.12 * _MAX_SAMPLES)) ** 0.5)
        samples_m, self._owner = surface_samples(triangles_m, step_m)
        self._tree, self._step_m = KDTree(samples_m), step_m
        self._closed = closed_parts(triangles_m) if fill else []

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """See `scenemi.scene.geometry.Solid`."""
        found_m, gap_m = points_m.copy(), np.full(len(points_m), np.inf)
        farthest_m = self._improve(points_m, np.arange(len(points_m)), _FEW_SAMPLES, reach_m, found_m, gap_m)
        # A nearer triangle would have a sample within a piece's radius of its nearest point.
        open_rows = np.flatnonzero(farthest_m < np.minimum(gap_m, reach_m) + _RADIUS_PER_STEP * self._step_m)
        self._improve(points_m, open_rows, _MANY_SAMPLES, reach_m, found_m, gap_m)
        far = gap_m > reach_m
        found_m[far], gap_m[far] = points_m[far], np.inf
        for part in self._closed:
            inside = inside_closed(points_m, part)
            found_m[inside], gap_m[inside] = points_m[inside], 0.0
        return found_m, gap_m

    def touches(self, points_m: Float[np.ndarray, "points 3"], reach_m: float) -> Bool[np.ndarray, "points"]:
        """Whether a solid point lies within reach; most answers need no triangle, so this is faster than distances."""
        radius_m = _RADIUS_PER_STEP * self._step_m
        sample_gap_m, _ = self._tree.query(points_m, distance_upper_bound=reach_m + radius_m)
        touched = np.asarray(sample_gap_m <= reach_m)
        open_rows = np.flatnonzero(~touched & np.isfinite(sample_gap_m))
        if self._closed:
            open_rows = np.flatnonzero(~touched)
        touched[open_rows] = self.nearest_within(points_m[open_rows], reach_m)[1] <= reach_m
        return touched

    def _improve(
        self, points_m: np.ndarray, rows: np.ndarray, count: int, reach_m: float, found_m: np.ndarray, gap_m: np.ndarray
    ) -> Float[np.ndarray, "rows"]:
        """Try the triangles of the `count` nearest samples, in place; distance of the last sample tried."""
        count = min(count, len(self._owner))
        reach_m = reach_m + _RADIUS_PER_STEP * self._step_m
        found = self._tree.query(points_m[rows], k=count, distance_upper_bound=reach_m)
        sample_gap_m, samples = (np.asarray(values).reshape(len(rows), count) for values in found)
        last_m = sample_gap_m[:, -1] if count < len(self._owner) else np.full(len(rows), np.inf)
        near = np.flatnonzero(np.isfinite(sample_gap_m[:, 0]))
        if not len(near):
            return last_m
        faces = np.sort(
            self._owner[np.where(samples[near] < len(self._owner), samples[near], samples[near, :1])], axis=1
        )
        # Most of the nearest samples share their triangle: each is tried once.
        first = np.ones(faces.shape, bool)
        first[:, 1:] = faces[:, 1:] != faces[:, :-1]
        tried = np.repeat(rows[near], first.sum(1))
        candidate_m = nearest_on_triangles(points_m[tried], self._triangles_m[faces[first]])
        candidate_gap_m = np.linalg.norm(candidate_m - points_m[tried], axis=-1)
        order = np.lexsort((candidate_gap_m, tried))
        best = order[np.flatnonzero(np.diff(tried[order], prepend=-1))]
        closer = best[candidate_gap_m[best] < gap_m[tried[best]]]
        found_m[tried[closer]], gap_m[tried[closer]] = candidate_m[closer], candidate_gap_m[closer]
        return last_m


def nearest_on_triangles(
    points_m: Float[np.ndarray, "pairs 3"], triangles_m: Float[np.ndarray, "pairs 3 3"]
) -> Float[np.ndarray, "pairs 3"]:
    """Nearest point of each point's own triangle, degenerate triangles included."""
    corners = [triangles_m[:, k] for k in range(3)]
    best_m, best_gap2 = np.empty_like(points_m), np.full(len(points_m), np.inf)
    for k in range(3):
        start, along = corners[k], corners[(k + 1) % 3] - corners[k]
        length2 = np.maximum(np.einsum("nd,nd->n", along, along), 1e-300)
        share = np.clip(np.einsum("nd,nd->n", points_m - start, along) / length2, 0.0, 1.0)
        on_edge = start + share[:, None] * along
        gap2 = np.einsum("nd,nd->n", points_m - on_edge, points_m - on_edge)
        best_m = np.where((gap2 < best_gap2)[:, None], on_edge, best_m)
        best_gap2 = np.minimum(best_gap2, gap2)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    area2 = np.linalg.norm(normal, axis=-1)
    unit = normal / np.maximum(area2, 1e-300)[:, None]
    foot = points_m - np.einsum("nd,nd->n", points_m - corners[0], unit)[:, None] * unit
    over = area2 > 1e-14
    for k in range(3):
        edge = corners[(k + 1) % 3] - corners[k]
        over &= np.einsum("nd,nd->n", np.cross(edge, foot - corners[k]), normal) >= 0
    return np.where(over[:, None], foot, best_m)


def closed_parts(triangles_m: Float[np.ndarray, "faces 3 3"]) -> list[Float[np.ndarray, "part_faces 3 3"]]:
    """Connected parts in which each edge is met once in either direction, so that they have an inside."""
    keys = np.rint(triangles_m.reshape(-1, 3) / _WELD_M).astype(np.int64)
    corners = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1, 3)
    count = int(corners.max()) + 1
    ends = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    part_of_face = connected_components(graph, directed=False)[1][corners[:, 0]]
    forward, backward = ends[:, 0] * count + ends[:, 1], ends[:, 1] * count + ends[:, 0]
    edges, times = np.unique(forward, return_counts=True)
    paired = np.isin(forward, edges[times == 1]) & np.isin(forward, backward)
    good_face = np.asarray(paired.reshape(3, -1).all(axis=0))
    return [
        triangles_m[part_of_face == part]
        for part in np.unique(part_of_face)
        if good_face[part_of_face == part].all() and (part_of_face == part).sum() >= 4
    ]


def inside_closed(
    points_m: Float[np.ndarray, "points 3"], triangles_m: Float[np.ndarray, "faces 3 3"]
) -> Bool[np.ndarray, "points"]:
    """Whether a closed part goes around each point with outward normals: by three rays, the majority decides."""
    low_m, high_m = triangles_m.reshape(-1, 3).min(0), triangles_m.reshape(-1, 3).max(0)
    within = np.flatnonzero(((points_m >= low_m) & (points_m <= high_m)).all(axis=1))
    inside = np.zeros(len(points_m), bool)
    for start in range(0, len(within), max(1, _PAIRS_AT_ONCE // len(triangles_m))):
        rows = within[start : start + max(1, _PAIRS_AT_ONCE // len(triangles_m))]
        votes = sum((_winding(points_m[rows], triangles_m, axis) > 0).astype(int) for axis in range(3))
        inside[rows] = votes >= 2
    return inside


def _winding(points_m: np.ndarray, triangles_m: np.ndarray, axis: int) -> Int[np.ndarray, "points"]:
    """Crossings of the ray from each point along +axis: +1 where it leaves through a face, -1 where it enters."""
    across = [(axis + 1) % 3, (axis + 2) % 3]
    target = points_m[:, None, across] + _RAY_SHIFT_M
    corners, heights = triangles_m[:, :, across], triangles_m[:, :, axis]
    weights = []
    for k in range(3):
        a, b = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        span = b - a
        weights.append(span[:, 0] * (target[..., 1] - a[:, 1]) - span[:, 1] * (target[..., 0] - a[:, 0]))
    total = weights[0] + weights[1] + weights[2]
    hit = ((weights[0] > 0) & (weights[1] > 0) & (weights[2] > 0)) | (
        (weights[0] < 0) & (weights[1] < 0) & (weights[2] < 0)
    )
    height = sum(w * heights[:, k] for k, w in enumerate(weights)) / np.where(total == 0, 1.0, total)
    above = hit & (height > points_m[:, None, axis])
    return (above * np.sign(total).astype(int)).sum(axis=1)
