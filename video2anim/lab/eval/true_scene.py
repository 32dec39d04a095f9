"""The true scene near the people as a signed distance field, and true meshes in the world."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from video2anim.artifacts.user_files import read_mesh_file
from video2anim.geometry.projection import transform_points
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.lab.eval.truth import TrueObject, Truth
from video2anim.types import Mesh

SPACING_M = 0.04
"""Spacing of the field's nodes; larger if it would have more than `MAX_NODES`."""
MAX_NODES = 2_500_000
_EXACT_M = 0.3
"""Nodes nearer to a solid than this get their exact distance, the others that of a coarser field."""
_COARSER = 3
_MARGIN_M = 0.8
"""Margin of the field around the true joints."""
_BELOW_FLOOR_M = 0.2
_NOT_SOLID = ("floor", "wall", "ceiling", "door", "window", "picture", "rug", "skirting")
"""Labels that are represented by the planes of the room, or lie flat on them."""


def read_glb(path: Path) -> Mesh:
    """Mesh of a GLB file in the object's frame, with coincident vertices merged. Unchanged files are read once.

    Raises:
        InputError: the file is missing or holds no mesh.
    """
    return _read_glb(path, path.stat().st_mtime_ns if path.exists() else 0)


@functools.lru_cache(maxsize=128)
def _read_glb(path: Path, changed_ns: int) -> Mesh:
    mesh = read_mesh_file(path)
    places, index = np.unique(mesh.vertices_m.round(6), axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    real = (faces != np.roll(faces, 1, axis=1)).all(1)
    return Mesh(places, faces[real], np.full((len(places), 3), 160, np.uint8))


def world_mesh(item: TrueObject) -> Mesh:
    """Mesh of a true object in the true world."""
    mesh = read_glb(item.file)
    return Mesh(transform_points(item.T_world_object, mesh.vertices_m), mesh.faces, mesh.vertex_rgb)


def true_field(truth: Truth) -> SdfGrid:
    """Signed distance to furniture, floor and walls near the true people.

    Objects consist of closed parts that overlap, so each connected part is a separate solid. Walls are the sides of the
    room's box; doors and windows are closed. Carried objects are left out.
    """
    joints_m = np.concatenate([person.joints_world_m.reshape(-1, 3) for person in truth.people])
    bounds_m = np.stack([joints_m.min(0) - _MARGIN_M, joints_m.max(0) + _MARGIN_M])
    bounds_m[0, 1] = -_BELOW_FLOOR_M
    spacing_m = max(SPACING_M, float(np.cbrt(np.ptp(bounds_m, axis=0).prod() / MAX_NODES)))
    solids = [
        part
        for item in truth.objects
        if item.label not in _NOT_SOLID and not item.is_moving
        for part in connected_parts(world_mesh(item))
        if _reaches(part.vertices_m, bounds_m)
    ]
    grid = _two_level_field(solids, bounds_m, spacing_m)
    return SdfGrid(_with_walls(grid, truth), grid.origin_m, grid.spacing_m)


def _two_level_field(solids: Sequence[Mesh], bounds_m: Float[np.ndarray, "2 3"], spacing_m: float) -> SdfGrid:
    """A field that is exact near the solids and interpolated from a coarser one elsewhere, where it is smooth."""
    grid = build_sdf_grid(solids, bounds_m, spacing_m, floor_y_m=0.0, reach_m=_EXACT_M)
    coarse = build_sdf_grid(solids, bounds_m, _COARSER * spacing_m, floor_y_m=0.0)
    far = np.nonzero(np.abs(grid.sdf_m) >= _EXACT_M)
    coarse_m = coarse.sample(grid.origin_m + grid.spacing_m * np.stack(far, -1))
    sdf_m = grid.sdf_m.copy()
    outside_m = np.minimum(sdf_m[far], np.maximum(coarse_m, _EXACT_M))
    sdf_m[far] = np.where(sdf_m[far] > 0, outside_m, np.minimum(sdf_m[far], coarse_m))
    return SdfGrid(sdf_m, grid.origin_m, grid.spacing_m)


def connected_parts(mesh: Mesh) -> list[Mesh]:
    """Connected components of a mesh."""
    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    count = len(mesh.vertices_m)
    links = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(count, count))
    _, label = connected_components(links, directed=False)
    parts = []
    for number in np.unique(label[mesh.faces[:, 0]]):
        faces = mesh.faces[label[mesh.faces[:, 0]] == number]
        kept, index = np.unique(faces, return_inverse=True)
        parts.append(Mesh(mesh.vertices_m[kept], index.reshape(-1, 3), mesh.vertex_rgb[kept]))
    return parts


def _reaches(vertices_m: np.ndarray, bounds_m: Float[np.ndarray, "2 3"]) -> bool:
    return bool(
        (vertices_m.max(0) > bounds_m[0] - _MARGIN_M).all() and (vertices_m.min(0) < bounds_m[1] + _MARGIN_M).all()
    )


def _with_walls(grid: SdfGrid, truth: Truth) -> np.ndarray:
    x0, x1, z0, z1 = truth.room_bounds_m
    x, z = (grid.origin_m[a] + grid.spacing_m * np.arange(grid.sdf_m.shape[a]) for a in (0, 2))
    walls = np.minimum(np.minimum(x - x0, x1 - x)[:, None], np.minimum(z - z0, z1 - z)[None, :])
    return np.minimum(grid.sdf_m, walls[:, None, :].astype(np.float32))
