"""Penetration depth of points in objects, and fast selection of a clip's body points near a place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from video2anim.lab.synth.world import Part, SceneObject

Points = Float[np.ndarray, "points 3"]
_CHUNK = 2_000_000


def penetration_m(objects: Sequence[SceneObject], points_m: Points) -> Float[np.ndarray, "points"]:
    """Depth of each world point inside objects, meters: distance to the nearest face of the solid; 0 outside.

    Where solids overlap, the largest depth counts. Exact for closed solids with outward faces. A point is inside an
    open surface (some external meshes) if its winding number exceeds 0.5.
    """
    points = PointSet(points_m)
    depth = np.zeros(len(points))
    for obj in objects:
        rows, own = points.depth_m(obj)
        depth[rows] = np.maximum(depth[rows], own)
    return depth


class PointSet:
    """World points, sorted along x so that those inside an object's bounding box are found fast."""

    def __init__(self, points_m: Points) -> None:
        points = np.asarray(points_m, float).reshape(-1, 3)
        self._order = np.argsort(points[:, 0])
        self._ordered = points[self._order]
        self._x = np.ascontiguousarray(self._ordered[:, 0])

    def __len__(self) -> int:
        return len(self._x)

    def near(self, center_m: Float[np.ndarray, "3"], reach_m: float) -> Points:
        """Points whose x and z are within `reach_m` of a center."""
        first, last = np.searchsorted(self._x, [center_m[0] - reach_m, center_m[0] + reach_m])
        some = self._ordered[first:last]
        return some[np.abs(some[:, 2] - center_m[2]) < reach_m]

    def depth_m(self, obj: SceneObject) -> tuple[Int[np.ndarray, "inside"], Float[np.ndarray, "inside"]]:
        """Indices of the points in the object's bounding box, and their depths in the object."""
        R, t = obj.T_world_object[:3, :3], obj.T_world_object[:3, 3]
        low, high = world_box(obj)
        first, last = np.searchsorted(self._x, [low[0], high[0]])
        some = self._ordered[first:last]
        inside = (some[:, 1] > low[1]) & (some[:, 1] < high[1]) & (some[:, 2] > low[2]) & (some[:, 2] < high[2])
        rows = np.flatnonzero(inside)
        local = (some[rows] - t) @ R
        depth = np.zeros(len(rows))
        for part in obj.parts if len(rows) else ():
            near = np.flatnonzero(((local > part.vertices_m.min(0)) & (local < part.vertices_m.max(0))).all(1))
            if len(near):
                depth[near] = np.maximum(depth[near], part_depth_m(part, local[near]))
        return self._order[first + rows], depth

    def max_depth_m(self, obj: SceneObject) -> float:
        """Depth of the deepest point in the object; 0 if none is inside."""
        return float(self.depth_m(obj)[1].max(initial=0.0))


def clearance_ok(objects: Sequence[SceneObject], points_m: Points, tolerance_m: float = 0.002) -> bool:
    """Whether no point is deeper than the tolerance in any of the objects."""
    return bool(penetration_m(objects, points_m).max(initial=0.0) <= tolerance_m)


def world_box(obj: SceneObject) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Minimum and maximum corner of the object's bounding box in the world."""
    corners = obj.merged()[0]
    return corners.min(0), corners.max(0)


def part_depth_m(part: Part, points_m: Points) -> Float[np.ndarray, "points"]:
    """Depth of points inside one part; points in the object's frame."""
    depth = np.zeros(len(points_m))
    for vertices, faces in solids_of(part):
        near = np.flatnonzero(((points_m > vertices.min(0)) & (points_m < vertices.max(0))).all(1))
        if len(near) == 0:
            continue
        normals, offsets = _planes(vertices, faces)
        gap = vertices @ normals.T - offsets
        rows = max(1, _CHUNK // len(faces))
        for start in range(0, len(near), rows):
            some = near[start : start + rows]
            if gap.max() <= 1e-6:
                own = np.maximum((offsets - points_m[some] @ normals.T).min(1), 0.0)
            else:
                own = _general_depth(points_m[some], vertices, faces)
            depth[some] = np.maximum(depth[some], own)
    return depth


def solids_of(part: Part) -> Iterator[tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]]:
    """The connected components of a part, each as vertices and faces."""
    faces, count = np.asarray(part.faces, np.int64), len(part.vertices_m)
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
    pieces, piece_of = connected_components(graph, directed=False)
    if pieces == 1:
        yield part.vertices_m, faces
        return
    of_face = piece_of[faces[:, 0]]
    order = np.argsort(of_face, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(of_face[order])) + 1):
        used, own = np.unique(faces[rows], return_inverse=True)
        yield part.vertices_m[used], own.reshape(-1, 3)


def _planes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct outward normals and offsets of the faces with a positive area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    real = area > 1e-12
    normals = cross[real] / area[real, None]
    planes = np.concatenate([normals, (normals * a[real]).sum(1, keepdims=True)], 1)
    _, first = np.unique(np.round(planes, 9), axis=0, return_index=True)  # the two halves of a quad are one plane
    return planes[first, :3], planes[first, 3]


def _general_depth(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Depth in a non-convex solid: winding number, then distance to the nearest triangle."""
    depth = np.zeros(len(points))
    inside = np.flatnonzero(_winding(points, vertices, faces) > 0.5)
    if len(inside):
        depth[inside] = np.sqrt(_triangle_distance2(points[inside], vertices, faces))
    return depth


def _winding(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    top = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("pfi,pfi->pf", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return (2 * np.arctan2(top, la * lb * lc + ab * lc + bc * la + ca * lb)).sum(1) / (4 * np.pi)


def _triangle_distance2(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Squared distance of each point to the nearest triangle: to its plane if the projection is inside, else to an
    edge."""
    corner = [vertices[faces[:, k]] for k in range(3)]
    cross = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    area2 = np.maximum((cross**2).sum(1), 1e-24)
    within = np.ones((len(points), len(faces)), bool)
    best = np.full((len(points), len(faces)), np.inf)
    for k in range(3):
        a, edge = corner[k], corner[(k + 1) % 3] - corner[k]
        from_a = points[:, None] - a[None]
        share = np.clip(np.einsum("pfi,fi->pf", from_a, edge) / np.maximum((edge**2).sum(1), 1e-18), 0, 1)
        best = np.minimum(best, ((from_a - share[..., None] * edge) ** 2).sum(2))
        within &= np.einsum("pfi,fi->pf", from_a, np.cross(cross, edge)) >= 0
    plane = np.einsum("pfi,fi->pf", points[:, None] - corner[0][None], cross) ** 2 / area2
    return np.where(within, plane, best).min(1)


class SweepIndex:
    """Body points of a whole clip, thinned to a grid and sorted by cell so that those near a place are found fast."""

    def __init__(self, points_m: Points, grid_m: float = 0.02, cell_m: float = 0.25) -> None:
        points = np.asarray(points_m, float).reshape(-1, 3)
        self.low, self.high = points.min(0), points.max(0)
        key = np.floor((points - self.low) / grid_m).astype(np.int64)
        span = key.max(0) + 1
        _, chosen = np.unique((key[:, 0] * span[1] + key[:, 1]) * span[2] + key[:, 2], return_index=True)
        kept = points[chosen]
        self._cell_m = cell_m
        cell = np.floor((kept[:, [0, 2]] - self.low[[0, 2]]) / cell_m).astype(np.int64)
        self._columns = int(cell[:, 1].max()) + 1
        number = cell[:, 0] * self._columns + cell[:, 1]
        order = np.argsort(number, kind="stable")
        self.points, self._number = kept[order], number[order]

    def near(self, low_xz: np.ndarray, high_xz: np.ndarray) -> Points:
        """Points of the grid cells that a floor rectangle (x, z) touches; these include some outside it."""
        first = np.floor((low_xz - self.low[[0, 2]]) / self._cell_m).astype(np.int64)
        last = np.floor((high_xz - self.low[[0, 2]]) / self._cell_m).astype(np.int64)
        z0, z1 = max(int(first[1]), 0), min(int(last[1]), self._columns - 1)
        if z1 < z0:
            return self.points[:0]
        rows = []
        for ix in range(max(int(first[0]), 0), int(last[0]) + 1):
            a, b = np.searchsorted(self._number, [ix * self._columns + z0, ix * self._columns + z1 + 1])
            if b > a:
                rows.append(self.points[a:b])
        return np.concatenate(rows) if rows else self.points[:0]
