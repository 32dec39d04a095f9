"""Colored meshes of floor and room surface, from a plate and its metric depth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.geometry.projection import backproject, invert_rigid, project, transform_points
from video2anim.types.camera import Intrinsics
from video2anim.types.scene import Mesh, Texture

_MOST_CELLS = 64
"""Cells along a side at most."""
_UNSEEN_FLOOR_RGB = (128, 128, 128)


def empty_mesh() -> Mesh:
    """A mesh without vertices."""
    return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))


def floor_patch(
    low_xz_m: Float[np.ndarray, "2"],
    high_xz_m: Float[np.ndarray, "2"],
    plate_rgb: UInt8[np.ndarray, "height width 3"],
    floor_mask: Bool[np.ndarray, "height width"],
    T_world_camera: Float[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
    *,
    most_vertices: int = 12_000,
    finest_m: float = 0.05,
) -> Mesh:
    """Grid on y = 0, facing up, colored where the picture shows the floor; elsewhere the floor's median color."""
    extent = np.maximum(high_xz_m - low_xz_m, finest_m)
    step_m = max(finest_m, float(np.sqrt(extent.prod() / most_vertices)))
    columns, rows = (max(2, int(np.ceil(e / step_m)) + 1) for e in extent)
    x, z = np.meshgrid(np.linspace(low_xz_m[0], high_xz_m[0], columns), np.linspace(low_xz_m[1], high_xz_m[1], rows))
    vertices = np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3)
    camera_m = transform_points(invert_rigid(T_world_camera), vertices)
    ahead = camera_m[:, 2] > 0.05
    camera_m[~ahead] = (0.0, 0.0, 1.0)
    pixels = project(camera_m, intrinsics)
    inside = ahead & (pixels >= 0).all(1) & (pixels <= [intrinsics.width_px - 1, intrinsics.height_px - 1]).all(1)
    u, v = (np.where(inside, np.round(pixels[:, k]), 0).astype(int) for k in (0, 1))
    shown = inside & floor_mask[v, u]
    usual = np.median(plate_rgb[floor_mask], axis=0) if floor_mask.any() else np.array(_UNSEEN_FLOOR_RGB)
    rgb = np.where(shown[:, None], plate_rgb[v, u], usual.astype(np.uint8)).astype(np.uint8)
    return Mesh(vertices.astype(np.float32), grid_faces(rows, columns), rgb)


def grid_faces(rows: int, columns: int) -> Int[np.ndarray, "faces 3"]:
    """Triangles of a grid of vertices; with x along columns and z along rows they face +y."""
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])


def room_surface(
    depth_m: Float[np.ndarray, "height width"],
    wanted: Bool[np.ndarray, "height width"],
    rgb: UInt8[np.ndarray, "height width 3"],
    T_world_camera: Float[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
    *,
    break_ratio: float = 0.1,
) -> Mesh:
    """Triangulated depth grid, cut where the depth steps by more than the ratio; triangles face the camera."""
    height, width = depth_m.shape
    faces = grid_faces(height, width)
    flat = depth_m.ravel()[faces]
    keep = wanted.ravel()[faces].all(1) & (flat.max(1) < flat.min(1) * (1 + break_ratio))
    faces = faces[keep]
    if not len(faces):
        return empty_mesh()
    used, local = np.unique(faces, return_inverse=True)
    points = transform_points(T_world_camera, backproject(depth_m, intrinsics).reshape(-1, 3)[used])
    return Mesh(points.astype(np.float32), local.reshape(-1, 3).astype(np.int64), rgb.reshape(-1, 3)[used])


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
