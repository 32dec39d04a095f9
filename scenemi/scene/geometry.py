"""Solid objects of any kind behind one question: which solid point is nearest?

A point inside a solid is its own nearest point. What is known as a surface only (a mesh without `fill`, a point set)
has no inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from scenemi.scene.mesh_surface import MeshSurface
from scenemi.scene.sdf_surface import SdfSolid
from video2anim.errors import InputError
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.checks import ROTATION_TOLERANCE


class Solid(Protocol):
    """Something solid in its own frame."""

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """Nearest solid points and distances; where none lies within reach, the point itself and infinity."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SceneGeometry:
    """One or more solids, each placed in the world."""

    parts: tuple[tuple[Float[np.ndarray, "4 4"], Solid], ...]
    """T_world_solid, solid."""

    @classmethod
    def of(cls, *solids: Solid) -> SceneGeometry:
        """Solids whose own frame is the world."""
        return cls(tuple((np.eye(4), solid) for solid in solids))

    @classmethod
    def from_mesh(
        cls, vertices_m: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], *, fill: bool = False
    ) -> SceneGeometry:
        """Triangles; see `MeshQuery`.

        Args:
            vertices_m: corners in the world.
            faces: corners of each triangle.
            fill: whether the inside of closed parts with outward normals is solid. Off, the surface alone is: scans
                are open, and a room's shell is closed around free space.

        Raises:
            InputError: no triangle, an index out of range, or a corner that is not finite.
        """
        vertices_m, faces = np.asarray(vertices_m, np.float64), np.asarray(faces, np.int64)
        if vertices_m.ndim != 2 or vertices_m.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise InputError(
                f"scene mesh: want vertices (V, 3) and at least one triangle (F, 3), got {vertices_m.shape} and "
                f"{faces.shape}; give no scene, or SceneGeometry.floor(), where nothing is known"
            )
        if faces.min() < 0 or faces.max() >= len(vertices_m):
            raise InputError(f"scene mesh: triangles name corners {faces.min()}..{faces.max()} of {len(vertices_m)}")
        if not np.isfinite(vertices_m[faces]).all():
            raise InputError("scene mesh: corners hold NaN or infinity; remove them from the file")
        return cls.of(MeshSurface(vertices_m[faces], fill=fill))

    @classmethod
    def from_points(cls, points_m: Float[np.ndarray, "points 3"]) -> SceneGeometry:
        """A point set; exact.

        Raises:
            InputError: no point, or one that is not finite.
        """
        points_m = np.asarray(points_m, np.float64)
        if points_m.ndim != 2 or points_m.shape[1] != 3 or not len(points_m):
            raise InputError(f"scene points: want at least one point (P, 3), got shape {points_m.shape}")
        if not np.isfinite(points_m).all():
            raise InputError("scene points: NaN or infinity among them; remove them first")
        return cls.of(PointSet(points_m))

    @classmethod
    def from_sdf(cls, grid: SdfGrid) -> SceneGeometry:
        """A signed-distance grid; negative is solid. Error: see `SdfSolid`.

        Raises:
            InputError: the grid has no solid.
        """
        return cls.of(SdfSolid(grid))

    @classmethod
    def floor(cls, y_m: float = 0.0) -> SceneGeometry:
        """Everything below a height; exact."""
        return cls.of(HalfSpace(y_m))

    def transformed(self, T_target_world: Float[np.ndarray, "4 4"]) -> SceneGeometry:
        """The scene moved rigidly: what was at p is at T p.

        Raises:
            ValueError: not a rigid motion.
        """
        rotation = T_target_world[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ValueError("SceneGeometry.transformed: want a rotation and a shift, distances must not change")
        return SceneGeometry(tuple((T_target_world @ T_world_solid, solid) for T_world_solid, solid in self.parts))

    def nearest(self, points_m: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Nearest solid point of each point, in the same frame."""
        points_m = np.asarray(points_m, np.float64)
        return self.nearest_within(points_m.reshape(-1, 3), np.inf)[0].reshape(points_m.shape)

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """As `Solid.nearest_within`, over all parts."""
        best_m, best_gap_m = points_m.copy(), np.full(len(points_m), np.inf)
        for T_world_solid, solid in self.parts:
            rotation, shift = T_world_solid[:3, :3], T_world_solid[:3, 3]
            found_m, gap_m = solid.nearest_within((points_m - shift) @ rotation, reach_m)
            closer = gap_m < best_gap_m
            best_m[closer] = found_m[closer] @ rotation.T + shift
            best_gap_m[closer] = gap_m[closer]
        return best_m, best_gap_m

    def touches(self, points_m: Float[np.ndarray, "points 3"], reach_m: float) -> Bool[np.ndarray, "points"]:
        """Whether a solid point lies within reach of each point."""
        touched = np.zeros(len(points_m), bool)
        for T_world_solid, solid in self.parts:
            rows = np.flatnonzero(~touched)
            local_m = (points_m[rows] - T_world_solid[:3, 3]) @ T_world_solid[:3, :3]
            touched[rows] = solid.nearest_within(local_m, reach_m)[1] <= reach_m
        return touched


class PointSet:
    """Points as solids."""

    def __init__(self, points_m: Float[np.ndarray, "solids 3"]) -> None:
        self._points_m, self._tree = points_m, KDTree(points_m)

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """See `Solid`."""
        gap_m, index = self._tree.query(points_m, distance_upper_bound=reach_m)
        near = np.isfinite(gap_m)
        return np.where(near[:, None], self._points_m[np.where(near, index, 0)], points_m), gap_m


@dataclass(frozen=True, slots=True)
class HalfSpace:
    """Everything at or below a height."""

    y_m: float

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """See `Solid`."""
        gap_m = np.maximum(points_m[:, 1] - self.y_m, 0.0)
        found_m = points_m - gap_m[:, None] * np.array([0.0, 1.0, 0.0])
        return found_m, np.where(gap_m <= reach_m, gap_m, np.inf)
