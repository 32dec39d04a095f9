"""Small meshes: none, an object in the world, a box, several as one."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from video2anim.geometry.projection import transform_points
from video2anim.types.scene import Mesh, RoomPiece, Texture

_MAX_CELLS = 20_000
"""Of a mesh, of two triangles each."""


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


@functools.lru_cache(maxsize=64)
def with_vertex_colors(mesh: Mesh, textures: tuple[Texture, ...], cell_m: float = 0.03) -> Mesh:
    """A textured mesh as one with a color per vertex, its edges halved to `cell_m` or less, for what draws no textures.

    Meshes without a texture stay as they are. Faces do not share vertices. Of large meshes the cells are wider.
    The last results are kept: a scene is drawn from several sides.
    """
    if not textures:
        return mesh
    texture = textures[0]
    faces = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    corners_m = mesh.vertices_m.astype(np.float64)[mesh.faces]
    vertices = np.concatenate([corners_m, texture.corner_uv.astype(np.float64)], -1).reshape(-1, 5)
    double_m2 = np.linalg.norm(np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]), axis=1)
    vertices, faces = _halved(vertices, faces, max(cell_m, float(np.sqrt(double_m2.sum() / _MAX_CELLS))))
    rows, columns = texture.image_rgb.shape[:2]
    column, row = (np.clip(vertices[:, 3 + k] * size, 0, size - 1).astype(int) for k, size in ((0, columns), (1, rows)))
    return Mesh(vertices[:, :3].astype(np.float32), faces, texture.image_rgb[row, column])


def colored(piece: RoomPiece) -> Mesh:
    """A piece of the room with a color per vertex."""
    return with_vertex_colors(piece.mesh, piece.textures)


def _halved(
    vertices: Float[np.ndarray, "vertices coordinates"], faces: Int[np.ndarray, "faces 3"], longest_m: float
) -> tuple[Float[np.ndarray, "finer coordinates"], Int[np.ndarray, "cells 3"]]:
    """Triangles cut in two at the middle of their longest edge until none is longer (by the first three coordinates);
    neighbors cut a common edge alike."""
    done = [np.zeros((0, 3), faces.dtype)]
    while len(faces):
        ends = np.stack([faces, np.roll(faces, -1, 1)], -1)
        length_m = np.linalg.norm(np.diff(vertices[ends][..., :3], axis=2)[:, :, 0], axis=-1)
        long = length_m.max(1) > longest_m
        done.append(faces[~long])
        turn = (length_m[long].argmax(1)[:, None] + np.arange(3)) % 3
        faces = np.take_along_axis(faces[long], turn, 1)
        edges, center = np.unique(np.sort(faces[:, :2], 1), axis=0, return_inverse=True)
        center = len(vertices) + center.reshape(-1)
        vertices = np.concatenate([vertices, vertices[edges].mean(1)])
        a, b, c = faces.T
        faces = np.concatenate([np.stack([a, center, c], 1), np.stack([center, b, c], 1)])
    return vertices, np.concatenate(done)
