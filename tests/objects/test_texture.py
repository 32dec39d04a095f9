"""Textures of low meshes, and what draws without them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from video2anim.geometry.scene_mesh import with_vertex_colors
from video2anim.objects.texture import textured
from video2anim.types import Mesh, Texture


def painted(points_m: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """A color for every place and every side."""
    return np.clip(128 + 60 * points_m + 20 * normals, 0, 255).astype(np.uint8)


def box(size_m: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.box(extents=size_m)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def sampled(texture: Texture, uv: np.ndarray) -> np.ndarray:
    rows, columns = texture.image_rgb.shape[:2]
    column, row = (uv * [columns, rows]).astype(int).T
    return texture.image_rgb[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]


@pytest.mark.parametrize("size_m", [(1.0, 1.0, 1.0), (2.0, 0.05, 0.7), (0.04, 1.8, 0.04)])
def test_every_place_of_a_face_finds_its_own_color(size_m: tuple[float, float, float]) -> None:
    vertices_m, faces = box(size_m)
    texture = textured(vertices_m, faces, painted, 0.004)
    weight = np.random.default_rng(0).dirichlet(np.ones(3), size=(len(faces), 40))
    points_m = weight @ vertices_m[faces]
    normals = np.repeat(trimesh.Trimesh(vertices_m, faces, process=False).face_normals[:, None], 40, 1)
    found = sampled(texture, (weight @ texture.corner_uv.astype(np.float64)).reshape(-1, 2))
    wanted = painted(points_m.reshape(-1, 3), normals.reshape(-1, 3))
    # A texel of a large face is 1 cm: less than 2 steps of color.
    assert np.abs(found.astype(int) - wanted).max() <= 3


def test_texels_are_no_finer_than_asked_and_the_picture_keeps_its_size() -> None:
    vertices_m, faces = box((1.0, 1.0, 1.0))
    coarse, fine = (textured(vertices_m, faces, painted, finest_m) for finest_m in (0.1, 1e-4))
    assert coarse.image_rgb.shape[0] < fine.image_rgb.shape[0] <= 512
    assert fine.image_rgb.shape[1] == 512
    assert fine.corner_uv.min() >= 0
    assert fine.corner_uv.max() <= 1


def test_a_mesh_with_colors_per_vertex_has_the_same_surface_and_the_texture_s_colors() -> None:
    vertices_m, faces = box((1.0, 0.6, 0.4))
    texture = textured(vertices_m, faces, painted, 0.004)
    gray = np.full((len(vertices_m), 3), 127, np.uint8)
    low = Mesh(vertices_m.astype(np.float32), faces, gray)
    dense = with_vertex_colors(low, (texture,), cell_m=0.1)
    before, after = (trimesh.Trimesh(m.vertices_m, m.faces, process=False) for m in (low, dense))
    assert after.area == pytest.approx(before.area, rel=1e-5)
    assert after.volume == pytest.approx(before.volume, rel=1e-5)
    edges = dense.vertices_m[dense.faces] - np.roll(dense.vertices_m[dense.faces], 1, 1)
    assert np.linalg.norm(edges, axis=-1).max() < 0.11
    normals = np.zeros((len(dense.vertices_m), 3))
    normals[dense.faces] = after.face_normals[:, None]
    assert np.abs(dense.vertex_rgb.astype(int) - painted(dense.vertices_m, normals)).max() <= 3


def test_without_a_texture_a_mesh_stays_as_it_is() -> None:
    vertices_m, faces = box((1.0, 1.0, 1.0))
    mesh = Mesh(vertices_m.astype(np.float32), faces, np.zeros((8, 3), np.uint8))
    assert with_vertex_colors(mesh, ()) is mesh
