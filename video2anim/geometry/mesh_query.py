"""The nearest triangle of a mesh, and which side of it a point is on, by NVIDIA Warp's tree of boxes on the CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_FARTHEST_M = 1e6
"""Reach that stands for none in single precision, whose square must be finite."""

_ON_SURFACE_M = 1e-6
"""Distances below this are zero: the rounding of single precision some meters from the origin."""


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The nearest triangle of each point."""

    face: Int[np.ndarray, "points"]
    """Its number, -1 where none is in reach."""
    point_m: Float[np.ndarray, "points 3"]
    """The nearest point on it; the point itself where none is in reach."""
    distance_m: Float[np.ndarray, "points"]
    """Negative inside, infinite where no triangle is in reach."""


class MeshQuery:
    """A mesh that is asked for the triangles nearest to points: exact to single precision.

    Inside is where the generalized winding number (Jacobson et al. 2013) exceeds one half: parts may overlap and have
    small holes, and triangles face outward.
    """

    def __init__(self, vertices_m: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
        from video2anim.geometry.mesh_kernels import wp

        self._mesh = None
        if len(faces):
            self._mesh = wp.Mesh(
                wp.array(np.ascontiguousarray(vertices_m, np.float32), dtype=wp.vec3, device="cpu"),
                wp.array(np.ascontiguousarray(faces, np.int32).reshape(-1), dtype=wp.int32, device="cpu"),
                support_winding_number=True,
            )

    @classmethod
    def of(cls, triangles_m: Float[np.ndarray, "faces 3 3"]) -> MeshQuery:
        """Triangles given by their corners."""
        return cls(triangles_m.reshape(-1, 3), np.arange(3 * len(triangles_m)).reshape(-1, 3))

    def nearest(self, points_m: Float[np.ndarray, "points 3"], reach_m: float = np.inf) -> Nearest:
        """Nearest triangles within reach; none where the mesh has no triangle."""
        from video2anim.geometry.mesh_kernels import nearest_triangle, wp

        count = len(points_m)
        if self._mesh is None or not count:
            return Nearest(np.full(count, -1), np.array(points_m, np.float64), np.full(count, np.inf))
        found_m, face = np.empty((count, 3), np.float32), np.empty(count, np.int32)
        inside = np.empty(count, bool)
        points = np.ascontiguousarray(points_m, np.float32)
        reach = min(reach_m, _FARTHEST_M)
        wp.launch(nearest_triangle, count, [self._mesh.id, points, reach], [face, found_m, inside], device="cpu")
        nearest_m = np.where(face[:, None] >= 0, found_m, points_m)
        gap_m = np.linalg.norm(nearest_m - points_m, axis=1)
        gap_m[gap_m < _ON_SURFACE_M] = 0
        gap_m[face < 0] = np.inf
        return Nearest(face, nearest_m, np.where(inside, -gap_m, gap_m))
