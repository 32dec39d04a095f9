"""The nearest triangle of a mesh, and which side of it a point is on, by NVIDIA Warp's tree of boxes on the CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_FARTHEST_M = 1e6
"""Reach that stands for none in single precision, whose square must be finite."""

_ON_SURFACE_M = 1e-6
"""Distances below this are zero: the rounding of single precision some meters from the origin, where meshes are stored
in it."""


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
    """A mesh that is asked for the triangles nearest to points.

    Which triangle is nearest is found in single precision, so beside slivers another one may be taken: of 36,644 points
    around furniture of two clips of V2A-Bench 0.02 % are more than 0.1 mm too far, at most 1.4 mm. Inside is where the
    generalized winding number (Jacobson et al. 2013) exceeds one half: parts may overlap and have small holes, and all
    triangles face the same way, outward or inward.
    """

    def __init__(self, vertices_m: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
        from video2anim.geometry.mesh_kernels import wp

        self._triangles_m, self._mesh = np.asarray(vertices_m, np.float64)[faces], None
        if len(faces):
            a, b, c = (self._triangles_m - self._triangles_m.mean((0, 1))).swapaxes(0, 1)
            outward = faces if np.einsum("nd,nd->", a, np.cross(b, c)) >= 0 else faces[:, ::-1]
            self._mesh = wp.Mesh(
                wp.array(np.ascontiguousarray(vertices_m, np.float32), dtype=wp.vec3, device="cpu"),
                wp.array(np.ascontiguousarray(outward, np.int32).reshape(-1), dtype=wp.int32, device="cpu"),
                support_winding_number=True,
            )

    @classmethod
    def of(cls, triangles_m: Float[np.ndarray, "faces 3 3"]) -> MeshQuery:
        """Triangles given by their corners."""
        return cls(triangles_m.reshape(-1, 3), np.arange(3 * len(triangles_m)).reshape(-1, 3))

    def nearest(self, points_m: Float[np.ndarray, "points 3"], reach_m: float = np.inf) -> Nearest:
        """Nearest triangles within reach; none where the mesh has no triangle."""
        from trimesh.triangles import closest_point

        from video2anim.geometry.mesh_kernels import nearest_triangle, wp

        count, points_m = len(points_m), np.asarray(points_m, np.float64)
        face, inside = np.full(count, -1, np.int32), np.zeros(count, bool)
        if self._mesh is not None and count:
            points, reach = np.ascontiguousarray(points_m, np.float32), min(reach_m, _FARTHEST_M)
            wp.launch(nearest_triangle, count, [self._mesh.id, points, reach], [face, inside], device="cpu")
        hit, nearest_m, gap_m = face >= 0, points_m.copy(), np.full(count, np.inf)
        nearest_m[hit] = closest_point(self._triangles_m[face[hit]], points_m[hit])
        gap_m[hit] = np.linalg.norm(nearest_m[hit] - points_m[hit], axis=1)
        gap_m[gap_m < _ON_SURFACE_M] = 0
        return Nearest(face, nearest_m, np.where(inside, -gap_m, gap_m))
