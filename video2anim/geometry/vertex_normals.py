"""Normals of triangle meshes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def vertex_normals(
    vertices_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    undefined: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Float[np.ndarray, "vertices 3"]:
    """Unit normals, mean of the touching faces weighted by area; `undefined` where a vertex has no area around it."""
    corners = vertices_m[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(vertices_m), 3))
    for axis in range(3):
        normals[:, axis] = np.bincount(faces.ravel(), np.repeat(face_normals[:, axis], 3), minlength=len(vertices_m))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    flat = length[:, 0] < np.finfo(np.float32).tiny
    normals = normals / np.where(flat[:, None], 1.0, length)
    normals[flat] = undefined
    return normals
