"""Closed meshes from outlines."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_chain import run_chain
from synthetic_room import BOX_SIZE_M, make_room

from video2anim.geometry.prism_mesh import OutlineCells, front_plane, outline_cells, prism_of_outline


def test_box_mesh_is_closed_and_stands_in_its_frame() -> None:
    found = run_chain(make_room()).meshes.objects[0]
    mesh = trimesh.Trimesh(found.mesh.vertices_m, found.mesh.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    low, high = mesh.bounds
    assert low[1] == pytest.approx(0, abs=1e-6)
    assert np.abs(low + high)[[0, 2]].max() < 1e-5
    assert len(found.mesh.faces) <= 5000
    assert found.method.startswith("extrusion")
    # The outline holds a sliver of side and top: up to a quarter larger than the front.
    assert 0.9 < mesh.extents[0] / BOX_SIZE_M[0] < 1.25
    assert 0.9 < mesh.extents[1] / BOX_SIZE_M[1] < 1.25
    # The outline is a few pixels too wide, so some of its rim has the wall's and the floor's colors.
    blue = found.mesh.vertex_rgb.astype(int)
    assert (blue[:, 2] > blue[:, 0] + 20).mean() > 0.8


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.3, 0.95))
def test_any_outline_gives_a_watertight_prism(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.random((9, 11)) < share
    cells[4, 5] = True
    rows, columns = np.nonzero(cells)
    centers = np.stack([columns + 0.5, rows + 0.5], -1) * 0.1
    outline_m = (centers[:, None] + rng.uniform(-0.05, 0.05, (1, 30, 2))).reshape(-1, 2)
    outline = outline_cells(outline_m, most_cells=100)
    relief = rng.normal(0, 0.05, outline.cells.shape)
    prism = prism_of_outline(outline, 0.4, relief)
    mesh = trimesh.Trimesh(prism.vertices_m, prism.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0


def test_prism_volume() -> None:
    outline = OutlineCells(np.ones((3, 2), dtype=bool), np.zeros(2), np.array([0.5, 0.2]))
    prism = prism_of_outline(outline, 0.3)
    assert trimesh.Trimesh(prism.vertices_m, prism.faces, process=False).volume == pytest.approx(1.0 * 0.6 * 0.3)


@pytest.mark.parametrize("yaw", [-0.5, 0.0, 0.6])
def test_front_plane_finds_the_yaw(yaw: float) -> None:
    rng = np.random.default_rng(1)
    along = rng.uniform(-0.6, 0.6, 500)
    points = np.stack([along * np.cos(yaw), rng.uniform(0, 1, 500), -4 - along * np.sin(yaw)], -1)
    points += rng.normal(0, 0.02, points.shape)
    plane = front_plane(points, np.array([0.0, 1.6, 0.0]))
    assert plane.yaw_rad == pytest.approx(yaw, abs=0.05)
    assert np.linalg.det(plane.R_world_front) == pytest.approx(1.0)
