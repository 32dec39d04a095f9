"""Which points of a mesh a camera sees."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.geometry.projection import project
from video2anim.types.camera import Intrinsics


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Area-weighted unit normals; zero for vertices of no face."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normal = np.cross(b - a, c - a)
    normals = np.stack(
        [
            sum(np.bincount(faces[:, k], face_normal[:, axis], minlength=len(vertices)) for k in range(3))
            for axis in range(3)
        ],
        -1,
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)


def visible_vertices(
    vertices_camera_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    intrinsics: Intrinsics,
    *,
    tolerance_m: float = 0.05,
) -> Bool[np.ndarray, "vertices"]:
    """Vertices in front of the camera, inside the picture, facing it, and not behind another vertex.

    The z-buffer's cells hold the nearest facing vertex; a vertex deeper than that by more than the tolerance is hidden.
    Cells are as large as the spacing of the vertices, so that a surface has no holes in the buffer.
    """
    z = vertices_camera_m[:, 2]
    normals = vertex_normals(vertices_camera_m, faces)
    facing = np.einsum("ij,ij->i", normals, vertices_camera_m) < 0
    candidate = np.flatnonzero((z > 0.05) & facing)
    if not len(candidate):
        return np.zeros(len(z), dtype=bool)
    pixels = project(vertices_camera_m[candidate], intrinsics)
    inside = (pixels >= -0.5).all(-1) & (pixels < [intrinsics.width_px - 0.5, intrinsics.height_px - 0.5]).all(-1)
    candidate, pixels = candidate[inside], pixels[inside]
    seen = np.zeros(len(z), dtype=bool)
    if not len(candidate):
        return seen
    extent = np.maximum(np.ptp(pixels, axis=0), 1e-6)
    cell_px = max(1.5 * float(np.sqrt(extent.prod() / len(candidate))), 1e-6)
    cell = np.floor((pixels - pixels.min(0)) / cell_px).astype(np.int64)
    key = cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    nearest = np.full(int(key.max()) + 1, np.inf)
    np.minimum.at(nearest, key, z[candidate])
    seen[candidate[z[candidate] <= nearest[key] + tolerance_m]] = True
    return seen
