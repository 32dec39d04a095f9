"""Ray casting on the CPU: a thin layer over Embree (through embreex). Needs no display and no OpenGL.

Embree's robust mode is on, so no ray passes between two triangles that share an edge; its cost is not measurable.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """First hits of a bundle of rays."""

    face: Int[np.ndarray, "rays"]
    """Triangle, -1 where nothing was hit."""
    distance: Float[np.ndarray, "rays"]
    """In multiples of the ray direction's length; infinite where nothing was hit."""
    barycentric: Float[np.ndarray, "rays 2"]
    """Weights of the triangle's second and third vertex."""


class RayCaster:
    """Casts rays against a triangle mesh."""

    def __init__(self, vertices_m: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
        self.face_count = len(faces)
        self._scene = None
        if self.face_count:
            self._scene = EmbreeScene(_device(), robust=True)
            self._vertices = np.ascontiguousarray(vertices_m, np.float32)
            TriangleMesh(self._scene, self._vertices, np.ascontiguousarray(faces, np.int32))

    def first_hits(self, origins_m: Float[np.ndarray, "rays 3"], directions: Float[np.ndarray, "rays 3"]) -> Hits:
        """Nearest triangle along each ray. Directions need not be unit vectors."""
        count = len(directions)
        if self._scene is None or not count:
            nothing = np.full(count, -1, np.int32)
            return Hits(nothing, np.full(count, np.inf, np.float32), np.zeros((count, 2), np.float32))
        found = self._scene.run(_rays(origins_m), _rays(directions), query="INTERSECT", output=1)
        face = found["primID"]
        distance = np.where(face >= 0, found["tfar"], np.float32(np.inf))
        return Hits(face, distance, np.stack([found["u"], found["v"]], -1))

    def blocked(
        self,
        origins_m: Float[np.ndarray, "rays 3"],
        directions: Float[np.ndarray, "rays 3"],
        reach: float | Float[np.ndarray, "rays"] = np.inf,
    ) -> Bool[np.ndarray, "rays"]:
        """Whether a ray hits anything within `reach` times its direction's length."""
        if self._scene is None or not len(directions):
            return np.zeros(len(directions), bool)
        reaches = np.broadcast_to(np.asarray(reach, np.float32), len(directions)).copy()
        return self._scene.run(_rays(origins_m), _rays(directions), reaches, query="OCCLUDED") == 0


def _rays(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)


@functools.lru_cache(maxsize=1)
def _device() -> EmbreeDevice:
    return EmbreeDevice()
