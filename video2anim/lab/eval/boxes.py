"""Oriented boxes and surfaces: overlap, Chamfer distance, height of the supporting surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, KDTree

from video2anim.geometry.projection import transform_points
from video2anim.types import Mesh

SURFACE_POINTS = 4000
"""Points per surface of the Chamfer distance."""
_RAYS = 40
"""Number of rays along each side of a footprint that search for its supporting surface."""
_LEVEL_M = 0.04
"""Range of height in which a surface counts as level; cushions are level within it."""
_THINNEST_M = 1e-3
"""Extent given to a box that is flat along an axis."""


@dataclass(frozen=True, slots=True, eq=False)
class OrientedBox:
    """A box around a mesh, aligned with the axes of the mesh's frame."""

    T_world_box: Float[np.ndarray, "4 4"]
    """Its origin is the center of the box."""
    half_m: Float[np.ndarray, "3"]

    @property
    def center_m(self) -> Float[np.ndarray, "3"]:
        return self.T_world_box[:3, 3]

    @property
    def volume_m3(self) -> float:
        return float(8 * self.half_m.prod())

    def halfspaces(self) -> Float[np.ndarray, "6 4"]:
        """Rows (n, d) with n.x + d <= 0 inside."""
        normals = np.concatenate([self.T_world_box[:3, :3].T, -self.T_world_box[:3, :3].T])
        return np.column_stack([normals, -normals @ self.center_m - np.tile(self.half_m, 2)])


def box_of(vertices_m: Float[np.ndarray, "vertices 3"], T_world_object: Float[np.ndarray, "4 4"]) -> OrientedBox:
    """Oriented box of an object from its vertices in the object's frame."""
    low, high = vertices_m.min(0), vertices_m.max(0)
    T_world_box = np.array(T_world_object, dtype=np.float64)
    T_world_box[:3, 3] = transform_points(T_world_box, 0.5 * (low + high)[None])[0]
    return OrientedBox(T_world_box, np.maximum(0.5 * (high - low), 0.5 * _THINNEST_M))


def box_iou_3d(a: OrientedBox, b: OrientedBox) -> float:
    """Volume of the intersection over that of the union, exact for boxes of any orientation."""
    planes = np.concatenate([a.halfspaces(), b.halfspaces()])
    # The largest sphere inside all twelve planes; its radius is 0 if the boxes do not intersect.
    best = linprog(
        [0, 0, 0, -1], A_ub=np.column_stack([planes[:, :3], np.ones(len(planes))]), b_ub=-planes[:, 3],
        bounds=[(None, None)] * 3 + [(0, None)],
    )  # fmt: skip
    if not best.success or best.x[3] < 1e-7:
        return 0.0
    shared = float(ConvexHull(HalfspaceIntersection(planes, best.x[:3]).intersections).volume)
    return shared / (a.volume_m3 + b.volume_m3 - shared)


def surface_points(mesh: Mesh, rng: np.random.Generator, count: int = SURFACE_POINTS) -> Float[np.ndarray, "count 3"]:
    """Points distributed uniformly over the area of a mesh, in its frame."""
    corners = mesh.vertices_m.astype(np.float64)[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    total = area.sum()
    # Stratified along the cumulated area: less noise than independent draws.
    at = (np.arange(count) + rng.uniform(size=count)) / count * total
    face = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
    u, v = rng.uniform(size=(2, count, 1))
    root = np.sqrt(u)
    a, b, c = (corners[face, k] for k in range(3))
    return (1 - root) * a + root * (1 - v) * b + root * v * c


def chamfer_m(a_m: Float[np.ndarray, "points 3"], b_m: Float[np.ndarray, "others 3"]) -> float:
    """Mean of the two mean distances to the nearest point of the other set. Meters, lower is better."""
    to_b, _ = KDTree(b_m).query(a_m)
    to_a, _ = KDTree(a_m).query(b_m)
    return float(0.5 * (np.mean(to_b) + np.mean(to_a)))


def rest_height_m(mesh: Mesh) -> float:
    """Height of the largest supporting surface, such as a chair's seat or a table's top. Meters, frame of the mesh.

    Vertical rays on a grid over the footprint hit the mesh; the result is from the 4 cm of height with the most hits.
    """
    import trimesh

    low, high = mesh.vertices_m.min(0).astype(np.float64), mesh.vertices_m.max(0).astype(np.float64)
    x, z = (np.linspace(low[axis], high[axis], _RAYS + 2)[1:-1] for axis in (0, 2))
    across, along = (grid.ravel() for grid in np.meshgrid(x, z))
    starts = np.stack([across, np.full(len(across), high[1] + 0.1), along], -1)
    solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    down = np.tile([0.0, -1.0, 0.0], (len(starts), 1))
    landed, _, _ = solid.ray.intersects_location(starts, down, multiple_hits=False)
    if not len(landed):
        return float(high[1])
    heights = np.sort(landed[:, 1])
    many = np.searchsorted(heights, heights + _LEVEL_M, side="right") - np.arange(len(heights))
    first = int(np.argmax(many))
    return float(np.median(heights[first : first + many[first]]))
