"""Closed meshes of solids that are given as cubes, for networks that make objects of pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_SMOOTHING_ROUNDS = 6
"""Rounds of Taubin smoothing, which takes the stairs off and keeps the volume."""


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Cubes; cube (i, j, k) has its lowest corner at origin + spacing * (i, j, k)."""

    filled: Bool[np.ndarray, "x y z"]
    origin_m: Float[np.ndarray, "3"]
    spacing_m: float


def mesh_of_voxels(
    voxels: Voxels, max_faces: int
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Closed surface around the filled cubes, in axes of the cubes (marching cubes, smoothed, simplified).

    Raises:
        ValueError: no cube is filled.
    """
    import trimesh
    from skimage.measure import marching_cubes

    if not voxels.filled.any():
        raise ValueError("mesh_of_voxels: want at least one filled cube, got none")
    low = voxels.origin_m
    high = low + voxels.spacing_m * np.array(voxels.filled.shape)
    filled, spacing_m = voxels.filled, voxels.spacing_m
    while True:
        found = marching_cubes(np.pad(without_pinches(filled), 1).astype(np.float32), 0.5)
        mesh = trimesh.Trimesh((found[0] - 0.5) * spacing_m + low, found[1], process=True)
        trimesh.smoothing.filter_taubin(mesh, iterations=_SMOOTHING_ROUNDS)
        vertices, faces = simplified(np.asarray(mesh.vertices), np.asarray(mesh.faces), max_faces)
        if len(faces) <= max_faces or max(filled.shape) <= 4:
            return np.clip(vertices, low, high), outward(vertices, faces)
        # No simplification keeps it closed: fewer cubes have fewer faces.
        filled, spacing_m = _halved(filled), 2 * spacing_m


def without_pinches(filled: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Cubes that touch at an edge alone get a third one beside them: four faces at one edge bound no solid."""
    filled = filled.copy()
    while True:
        before = int(filled.sum())
        for axis in range(3):
            block = np.moveaxis(filled, axis, 0)
            a, b, c, d = block[:, :-1, :-1], block[:, :-1, 1:], block[:, 1:, :-1], block[:, 1:, 1:]
            falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
            b |= falling
            a |= rising
        if int(filled.sum()) == before:
            return filled


def _halved(filled: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Cubes of twice the size, filled where any of their eight is."""
    padded = np.pad(filled, [(0, n % 2) for n in filled.shape])
    x, y, z = (n // 2 for n in padded.shape)
    return np.asarray(padded.reshape(x, 2, y, 2, z, 2).any((1, 3, 5)), bool)


def simplified(
    vertices_m: np.ndarray, faces: np.ndarray, max_faces: int, *, keep_closed: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Fewer faces by quadric error; as it was where that would tear a closed surface that is to be kept closed."""
    import fast_simplification
    import trimesh

    if len(faces) <= max_faces:
        return vertices_m, faces
    closed = keep_closed and trimesh.Trimesh(vertices_m, faces, process=False).is_watertight
    # Single precision around the middle, not around the world's origin.
    center = vertices_m.mean(0)
    for share, eagerness in ((1.0, 3), (1.0, 5), (0.85, 5), (0.6, 5), (0.6, 7), (0.4, 7)):
        fewer = fast_simplification.simplify(
            (vertices_m - center).astype(np.float32), faces.astype(np.int32), target_count=int(share * max_faces),
            agg=eagerness,
        )  # fmt: skip
        kept = trimesh.Trimesh(fewer[0] + center, fewer[1], process=True)
        if len(kept.faces) <= max_faces and (kept.is_watertight or not closed):
            return np.asarray(kept.vertices, np.float64), np.asarray(kept.faces, np.int64)
    return vertices_m, faces


def outward(vertices_m: np.ndarray, faces: np.ndarray) -> Int[np.ndarray, "faces 3"]:
    """Faces turned so that the enclosed volume is positive."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    volume = np.einsum("nd,nd->n", a, np.cross(b, c)).sum()
    return (faces if volume >= 0 else faces[:, ::-1]).astype(np.int64)
