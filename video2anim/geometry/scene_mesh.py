"""Small meshes: none, a grid's triangles, an object in the world, a box, several as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from video2anim.geometry.projection import transform_points
from video2anim.types.scene import Mesh, Texture

_MOST_CELLS = 64
"""Cells along a side at most."""


def empty_mesh() -> Mesh:
    """A mesh without vertices."""
    return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    if not meshes:
        return empty_mesh()
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])[:-1]
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.vertex_rgb for mesh in meshes]),
    )


def grid_faces(rows: int, columns: int) -> Int[np.ndarray, "faces 3"]:
    """Triangles of a grid of vertices; with x along columns and z along rows they face +y."""
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])


def world_mesh(mesh: Mesh, T_world_object: Float[np.ndarray, "4 4"], scale: float) -> Mesh:
    """An object's mesh in the world."""
    vertices = transform_points(T_world_object, scale * mesh.vertices_m.astype(np.float64))
    return Mesh(vertices.astype(np.float32), mesh.faces, mesh.vertex_rgb)


def box_mesh(width_m: float, height_m: float, depth_m: float, rgb: tuple[int, int, int] = (150, 150, 150)) -> Mesh:
    """Watertight box on y = 0, centered in x and z."""
    import trimesh

    box = trimesh.creation.box(extents=(width_m, height_m, depth_m))
    vertices = np.asarray(box.vertices, np.float64) + np.array([0.0, 0.5 * height_m, 0.0])
    return Mesh(vertices, np.asarray(box.faces, np.int64), np.tile(np.array(rgb, np.uint8), (len(vertices), 1)))


def with_vertex_colors(mesh: Mesh, textures: tuple[Texture, ...], cell_m: float = 0.03) -> Mesh:
    """A textured mesh as one with a color per vertex, its faces divided into cells, for what draws no textures.

    Meshes without a texture stay as they are. Faces do not share vertices.
    """
    if not textures:
        return mesh
    texture = textures[0]
    corners = mesh.vertices_m.astype(np.float64)[mesh.faces]
    longest_m = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    count = np.clip(np.ceil(longest_m / cell_m), 1, _MOST_CELLS).astype(int)
    rows, columns = texture.image_rgb.shape[:2]
    vertices, faces, colors, first = [], [], [], 0
    for n in np.unique(count):
        chosen = count == n
        weight, pattern = _cells(int(n))
        vertices.append((weight @ corners[chosen]).reshape(-1, 3))
        u, v = np.moveaxis(weight @ texture.corner_uv[chosen].astype(np.float64), -1, 0)
        column = np.clip(u * columns, 0, columns - 1).astype(int)
        row = np.clip(v * rows, 0, rows - 1).astype(int)
        colors.append(texture.image_rgb[row, column].reshape(-1, 3))
        starts = first + len(weight) * np.arange(chosen.sum())
        faces.append((starts[:, None, None] + pattern).reshape(-1, 3))
        first += len(weight) * int(chosen.sum())
    return Mesh(np.concatenate(vertices).astype(np.float32), np.concatenate(faces), np.concatenate(colors))


def _cells(n: int) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "cells 3"]]:
    """A triangle divided n times along each side: weights of its corners, and the small triangles."""
    row, column = (grid.ravel() for grid in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
    inside = row + column <= n
    number = np.cumsum(inside) - 1
    grid = np.where(inside, number, -1).reshape(n + 1, n + 1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[:-1, 1:], grid[1:, 1:]
    up = np.stack([a, b, c], -1).reshape(-1, 3)
    down = np.stack([b, d, c], -1).reshape(-1, 3)
    cells = np.concatenate([up[(up >= 0).all(1)], down[(down >= 0).all(1)]])
    i, j = row[inside], column[inside]
    return np.stack([n - i - j, i, j], -1) / n, cells
