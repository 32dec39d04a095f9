"""Nearest points on a triangle mesh, and which points its closed parts enclose."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.mesh_query import MeshQuery

_WELD_DIGITS = 5
"""Corners that are equal to this many decimals (0.01 mm) are one: files repeat a corner for each of its normals."""


class MeshSurface:
    """Triangles (faces, 3, 3), as a surface or as the solid that closed parts enclose; see `MeshQuery`."""

    def __init__(self, triangles_m: Float[np.ndarray, "faces 3 3"], *, fill: bool = False) -> None:
        self._surface = MeshQuery.of(triangles_m)
        self._closed = MeshQuery.of(closed_parts(triangles_m)) if fill else None

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """See `scenemi.scene.geometry.Solid`."""
        found = self._surface.nearest(points_m, reach_m)
        inside = (
            np.zeros(len(points_m), bool) if self._closed is None else self._closed.nearest(points_m).distance_m < 0
        )
        return (
            np.where(inside[:, None], points_m, found.point_m),
            np.where(inside, 0.0, np.abs(found.distance_m)),
        )


def closed_parts(triangles_m: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "closed 3 3"]:
    """Triangles of the connected parts that are watertight with outward normals, so that they have an inside."""
    import trimesh

    corners = np.arange(3 * len(triangles_m)).reshape(-1, 3)
    mesh = trimesh.Trimesh(triangles_m.reshape(-1, 3), corners, process=False)
    mesh.merge_vertices(digits_vertex=_WELD_DIGITS)
    parts = [part for part in mesh.split(only_watertight=True) if part.is_winding_consistent and part.volume > 0]
    return np.concatenate([np.zeros((0, 3, 3)), *(part.triangles for part in parts)])
