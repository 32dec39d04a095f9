"""Closed meshes of cubes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from video2anim.networks.solid_mesh import Voxels, mesh_of_voxels, outward, simplified

ORIGIN_M = np.array([3.0, 0.5, -7.0])
SPACING_M = 0.05


def cubes(filled: np.ndarray) -> Voxels:
    return Voxels(filled, ORIGIN_M, SPACING_M)


def shape_of(name: str) -> np.ndarray:
    """Filled cubes of objects that furniture is made of."""
    filled = np.zeros((24, 16, 14), bool)
    if name == "block":
        filled[:] = True
    elif name == "table":
        filled[:, -2:] = True
        for x in (slice(0, 2), slice(-2, None)):
            filled[x, :, :2] = filled[x, :, -2:] = True
    elif name == "stairs":
        for step in range(4):
            filled[6 * step :, 4 * step : 4 * step + 4] = True
    elif name == "frame":
        filled[:, :, 5:9] = True
        filled[6:18, 4:12] = False
    else:
        filled[:6], filled[-6:] = True, True
    return filled


SHAPES = ("block", "table", "stairs", "frame", "two pieces")


def checked(vertices_m: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    """The mesh, if it is closed, turned outward and free of NaN."""
    assert np.isfinite(vertices_m).all()
    mesh = trimesh.Trimesh(vertices_m, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    return mesh


@pytest.mark.parametrize("max_faces", [10_000, 1200])
@pytest.mark.parametrize("name", SHAPES)
def test_mesh_of_cubes_is_closed_and_has_their_volume_and_bounds(name: str, max_faces: int) -> None:
    """Smoothing rounds edges off: thin legs lose up to a tenth of the whole volume."""
    filled = shape_of(name)
    vertices_m, faces = mesh_of_voxels(cubes(filled), max_faces)
    assert 0 < len(faces) <= max_faces
    mesh = checked(vertices_m, faces)
    assert mesh.volume == pytest.approx(filled.sum() * SPACING_M**3, rel=0.1)
    index = np.argwhere(filled)
    low_m, high_m = ORIGIN_M + SPACING_M * index.min(0), ORIGIN_M + SPACING_M * (index.max(0) + 1)
    assert (vertices_m >= ORIGIN_M - 1e-9).all(), "never outside all cubes, filled or not"
    assert (vertices_m <= ORIGIN_M + SPACING_M * np.array(filled.shape) + 1e-9).all()
    np.testing.assert_allclose(mesh.bounds, [low_m, high_m], atol=0.2 * SPACING_M)


@pytest.mark.parametrize(("name", "pieces", "holes"), [("block", 1, 0), ("frame", 1, 1), ("two pieces", 2, 0)])
def test_pieces_and_holes_are_kept(name: str, pieces: int, holes: int) -> None:
    """Euler's number is two for every piece, less two for every hole."""
    mesh = checked(*mesh_of_voxels(cubes(shape_of(name)), 10_000))
    assert mesh.body_count == pieces
    assert mesh.euler_number == 2 * (pieces - holes)


def test_surface_lies_between_filled_and_empty_cubes() -> None:
    mesh = checked(*mesh_of_voxels(cubes(shape_of("table")), 10_000))
    filled = shape_of("table")
    at_m = ORIGIN_M + SPACING_M * (np.argwhere(np.ones_like(filled)) + 0.5)
    inside = mesh.contains(at_m).reshape(filled.shape)
    assert (inside == filled).mean() > 0.97


def test_one_cube_and_a_wall_of_cubes_are_solids() -> None:
    checked(*mesh_of_voxels(cubes(np.ones((1, 1, 1), bool)), 100))
    wall = checked(*mesh_of_voxels(cubes(np.ones((20, 20, 1), bool)), 10_000))
    assert wall.volume == pytest.approx(400 * SPACING_M**3, rel=0.1)


def test_no_cubes_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one filled cube"):
        mesh_of_voxels(cubes(np.zeros((3, 3, 3), bool)), 100)


def test_ragged_cubes_give_a_closed_mesh() -> None:
    filled = np.zeros((2, 3, 2), bool)
    filled[(0, 0, 1, 1), (1, 2, 0, 1), (0, 1, 0, 1)] = True
    checked(*mesh_of_voxels(cubes(filled), 1000))


def test_face_limit_holds_for_tables_with_thin_legs() -> None:
    counts = []
    for size, thick in (((28, 28, 26), 3), ((22, 28, 20), 2), ((22, 28, 29), 3)):
        filled = np.zeros(size, bool)
        filled[:, -thick:] = True
        for x in (slice(0, 3), slice(-3, None)):
            filled[x, :, :3] = filled[x, :, -3:] = True
        counts.append(len(mesh_of_voxels(Voxels(filled, np.zeros(3), 0.03), 4000)[1]))
    assert max(counts) <= 4000


def test_simplified_leaves_small_meshes_alone() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices_m, faces = simplified(np.asarray(ball.vertices), np.asarray(ball.faces), 320)
    np.testing.assert_array_equal(vertices_m, ball.vertices)
    np.testing.assert_array_equal(faces, ball.faces)


@pytest.mark.parametrize("away_m", [0.0, 5000.0])
def test_simplified_keeps_a_ball_wherever_it_is(away_m: float) -> None:
    """Single precision in world coordinates would be half a millimeter coarse 5 km away; the ball is 4 cm large."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    center_m = np.array([away_m, 0.0, -away_m])
    vertices_m, faces = simplified(np.asarray(ball.vertices) + center_m, np.asarray(ball.faces), 600)
    assert 300 < len(faces) <= 600
    assert vertices_m.dtype == np.float64
    checked(vertices_m - center_m, faces)
    radius_m = np.linalg.norm(vertices_m - center_m, axis=1)
    np.testing.assert_allclose(radius_m, 0.02, atol=2e-4)


def test_a_closed_mesh_that_would_tear_stays_as_it_was() -> None:
    """A cube of which the simplification to 40 faces has open edges."""
    cube = trimesh.creation.box().subdivide().subdivide()
    assert isinstance(cube, trimesh.Trimesh)
    vertices_m, faces = simplified(np.asarray(cube.vertices), np.asarray(cube.faces), 40)
    np.testing.assert_array_equal(faces, cube.faces)
    np.testing.assert_array_equal(vertices_m, cube.vertices)


@pytest.mark.parametrize("inside_out", [False, True])
def test_faces_are_turned_outward(inside_out: bool) -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    faces = np.asarray(box.faces)[:, ::-1] if inside_out else np.asarray(box.faces)
    turned = outward(np.asarray(box.vertices) - 10.0, faces)
    assert trimesh.Trimesh(box.vertices, turned, process=False).volume == pytest.approx(6.0)
