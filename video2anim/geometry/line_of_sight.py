"""Which points of a mesh a camera sees."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.geometry.projection import NEAR_M, project
from video2anim.geometry.vertex_normals import vertex_normals
from video2anim.types.camera import Intrinsics


def visible_vertices(
    vertices_camera_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    intrinsics: Intrinsics,
    *,
    tolerance_m: float = 0.05,
) -> Bool[np.ndarray, "vertices"]:
    """Vertices in front of the camera, inside the picture, facing it, and not behind another vertex.

    The cells of a z-buffer hold the nearest point of the surface; a vertex deeper than that by more than the tolerance
    is hidden. Cells are a little larger than the spacing of the vertices, so that a surface has no holes in the buffer.
    """
    z = vertices_camera_m[:, 2]
    normals = vertex_normals(vertices_camera_m, faces, undefined=(0.0, 0.0, 0.0))
    facing = np.einsum("ij,ij->i", normals, vertices_camera_m) < 0
    seen = np.zeros(len(z), dtype=bool)
    candidate = np.flatnonzero((z > NEAR_M) & facing)
    if not len(candidate):
        return seen
    pixels = project(vertices_camera_m[candidate], intrinsics)
    inside = (pixels >= -0.5).all(-1) & (pixels < [intrinsics.width_px - 0.5, intrinsics.height_px - 0.5]).all(-1)
    candidate, pixels = candidate[inside], pixels[inside]
    if not len(candidate):
        return seen
    low = pixels.min(0)
    extent = np.maximum(np.ptp(pixels, axis=0), 1e-6)
    cell_px = max(1.5 * float(np.sqrt(extent.prod() / len(candidate))), 1e-6)
    shape = np.floor(extent / cell_px).astype(np.int64) + 1
    surface = surface_points(vertices_camera_m, faces)
    index = np.floor((project(surface, intrinsics) - low) / cell_px).astype(np.int64)
    kept = ((index >= 0) & (index < shape)).all(-1)
    nearest = np.full(int(shape.prod()), np.inf)
    np.minimum.at(nearest, index[kept, 0] * shape[1] + index[kept, 1], surface[kept, 2])
    own = np.floor((pixels - low) / cell_px).astype(np.int64)
    seen[candidate[z[candidate] <= nearest[own[:, 0] * shape[1] + own[:, 1]] + tolerance_m]] = True
    return seen


def surface_points(
    vertices_camera_m: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "points 3"]:
    """Corners, middles of the edges and centroids of the triangles that lie before the camera."""
    corners = vertices_camera_m[faces]
    corners = corners[(corners[..., 2] > NEAR_M).all(-1)]
    middles = 0.5 * (corners + np.roll(corners, 1, axis=1))
    return np.concatenate([corners.reshape(-1, 3), middles.reshape(-1, 3), corners.mean(1)])
