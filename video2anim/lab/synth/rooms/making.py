"""`Maker`: collects solids and surfaces of a `SceneObject`, and poses about the vertical."""

from __future__ import annotations

import numpy as np

from video2anim.lab.synth.rooms.primitives import Mesh
from video2anim.lab.synth.world import Material, Part, SceneObject, Surface


class Maker:
    """Parts of one object in its own frame: +Y up, resting on y = 0, front towards +Z."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.parts: list[Part] = []
        self.surfaces: list[Surface] = []

    def add(self, mesh: Mesh, material: Material, smooth: bool = False) -> None:
        vertices, faces = mesh
        self.parts.append(Part(np.asarray(vertices, float), np.asarray(faces, np.int64), material, smooth))

    def surface(self, kind: str, height_m: float, size_m: tuple[float, float], x: float = 0.0, z: float = 0.0) -> None:
        self.surfaces.append(Surface(kind, height_m, (x, z), size_m))

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def done(self, label: str, note: str) -> SceneObject:
        """The object, moved so that its origin is below the center of its bounding box.

        An object with surfaces keeps their heights; vertices below the floor (slanted ends of legs) are clamped to
        y = 0. Any other object is shifted to rest on y = 0.
        """
        meshes = [part.vertices_m for part in self.parts]
        if self.surfaces:
            meshes = [np.stack([v[:, 0], np.maximum(v[:, 1], 0.0), v[:, 2]], 1) for v in meshes]
        points = np.concatenate(meshes)
        low, high = points.min(0), points.max(0)
        rest = 0.0 if self.surfaces else low[1]
        origin = np.array([(low[0] + high[0]) / 2, rest, (low[2] + high[2]) / 2])
        parts = tuple(
            Part(vertices - origin, p.faces, p.material, p.smooth, p.vertex_rgb)
            for vertices, p in zip(meshes, self.parts, strict=True)
        )
        surfaces = tuple(
            Surface(s.kind, s.height_m, (float(s.center_m[0] - origin[0]), float(s.center_m[1] - origin[2])), s.size_m)
            for s in self.surfaces
        )
        return SceneObject(1, label, parts, np.eye(4), surfaces, note)


def pose(x: float, z: float, yaw: float, y: float = 0.0) -> np.ndarray:
    """T_world_object of an object whose front faces (sin yaw, 0, cos yaw); meters, radians."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def yaw_of(T_world_object: np.ndarray) -> float:
    """Heading of an upright object, radians."""
    return float(np.arctan2(T_world_object[0, 2], T_world_object[2, 2]))
