"""Closed, colored meshes of cubes and boxes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from seen_boxes import LENS, Block, Shot, about_y, looking, shoot

from video2anim.geometry.carving import Voxels
from video2anim.geometry.solid_mesh import box_surface, mesh_of_voxels, outward, simplified, surface_colors
from video2anim.geometry.upright_box import UprightBox

ORIGIN_M = np.array([3.0, 0.5, -7.0])
SPACING_M = 0.05
FRONT_RGB, SIDE_RGB, TOP_RGB, ROOM_RGB = (0, 0, 250), (250, 0, 0), (0, 250, 0), (90, 90, 90)


def cubes(filled: np.ndarray) -> Voxels:
    return Voxels(filled, filled, ORIGIN_M, SPACING_M, ())


def shape_of(name: str) -> np.ndarray:
    """Filled cubes of things that furniture is made of."""
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


@pytest.mark.parametrize("most_faces", [10_000, 1200])
@pytest.mark.parametrize("name", SHAPES)
def test_mesh_of_cubes_is_closed_and_has_their_volume_and_bounds(name: str, most_faces: int) -> None:
    """Smoothing rounds edges off: thin legs lose up to a tenth of the whole volume."""
    filled = shape_of(name)
    vertices_m, faces = mesh_of_voxels(cubes(filled), most_faces)
    assert 0 < len(faces) <= most_faces
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
        counts.append(len(mesh_of_voxels(Voxels(filled, filled, np.zeros(3), 0.03, ()), 4000)[1]))
    assert max(counts) <= 4000


@settings(max_examples=40, deadline=None, derandomize=True)
@given(size=st.tuples(*[st.floats(0.02, 2.5)] * 3), most=st.integers(12, 5000), seed=st.integers(0, 1000))
def test_box_surface_is_closed_with_the_exact_volume(size: tuple[float, ...], most: int, seed: int) -> None:
    low_m = np.random.default_rng(seed).uniform(-5, 5, 3)
    vertices_m, faces = box_surface(low_m, low_m + np.array(size), most)
    assert len(faces) <= most
    mesh = checked(vertices_m, faces)
    assert mesh.volume == pytest.approx(np.prod(size), rel=1e-6)
    assert mesh.euler_number == 2
    np.testing.assert_allclose(mesh.bounds, [low_m, low_m + size], atol=1e-9)
    assert len(np.unique(faces)) == len(vertices_m), "every vertex belongs to a face"
    on_side = np.isclose(vertices_m, low_m, atol=1e-9) | np.isclose(vertices_m, low_m + size, atol=1e-9)
    assert on_side.any(1).all()


def test_box_surface_uses_what_it_may() -> None:
    """Cells are square where the box allows it, and no finer than asked for."""
    vertices_m, faces = box_surface(np.zeros(3), np.array([1.0, 0.5, 0.03]), 400)
    assert 300 < len(faces) <= 400
    assert len(np.unique(np.round(vertices_m[:, 2], 6))) == 2
    assert np.diff(np.unique(np.round(vertices_m[:, 0], 6))).max() < 0.15
    _, coarse = box_surface(np.zeros(3), np.array([1.0, 0.5, 0.03]), 4000, finest_m=0.1)
    assert len(coarse) == 4 * (10 * 5 + 10 * 1 + 5 * 1)


def test_simplified_leaves_small_meshes_alone() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices_m, faces = simplified(np.asarray(ball.vertices), np.asarray(ball.faces), 320)
    np.testing.assert_array_equal(vertices_m, ball.vertices)
    np.testing.assert_array_equal(faces, ball.faces)


@pytest.mark.parametrize("away_m", [0.0, 5000.0])
def test_simplified_keeps_a_ball_wherever_it_is(away_m: float) -> None:
    """Single precision in world coordinates would be half a millimetre coarse 5 km away; the ball is 4 cm large."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    middle_m = np.array([away_m, 0.0, -away_m])
    vertices_m, faces = simplified(np.asarray(ball.vertices) + middle_m, np.asarray(ball.faces), 600)
    assert 300 < len(faces) <= 600
    assert vertices_m.dtype == np.float64
    checked(vertices_m - middle_m, faces)
    radius_m = np.linalg.norm(vertices_m - middle_m, axis=1)
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


BLOCK = Block((0.2, 0.4, -3.0), (1.0, 0.8, 0.6), -0.5)


def painted(block: Block, others: list[Block] | None = None) -> tuple[Shot, np.ndarray]:
    """A camera that sees front, top and the right side, and the picture with a color for each."""
    shot = shoot([block, *(others or [])], looking((0.0, 1.6, 0.0), (0.1, 0.4, -3.0)))
    own = shot.normal @ block.R_world_block
    picture = np.full((*shot.shown.shape, 3), ROOM_RGB, np.uint8)
    for axis, rgb in ((0, SIDE_RGB), (1, TOP_RGB), (2, FRONT_RGB)):
        picture[shot.mask(0) & (np.abs(own[..., axis]) > 0.9)] = rgb
    return shot, picture


def colors_of(
    block: Block, mirrored: tuple[str, ...], others: list[Block] | None = None, scale: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in axes of the block about its middle, and their colors."""
    shot, picture = painted(block, others)
    middle_m, half = np.array(block.middle_m) @ block.R_world_block, 0.5 * np.array(block.size_m)
    box = UprightBox(block.R_world_block, middle_m - half, middle_m + half, np.ones(3, bool))
    vertices_m, _ = box_surface(box.low_m, box.high_m, 4000, finest_m=0.05)
    large = picture.repeat(scale, 0).repeat(scale, 1)
    view = shot.view(shot.mask(0))
    return vertices_m - middle_m, surface_colors(
        vertices_m @ box.R_world_box.T, large, view, box, mirrored, tolerance_m=0.05
    )


def face(vertices_m: np.ndarray, axis: int, side: int) -> np.ndarray:
    """Vertices on one side of the block, off its edges."""
    half = 0.5 * np.array(BLOCK.size_m)
    rest = [k for k in range(3) if k != axis]
    on = np.isclose(vertices_m[:, axis], side * half[axis], atol=1e-6)
    return on & (np.abs(vertices_m[:, rest]) < half[rest] - 0.06).all(1)


def share(rgb: np.ndarray, wanted: tuple[int, int, int]) -> float:
    assert len(rgb) > 10
    return float((rgb == wanted).all(1).mean())


def seen_side() -> int:
    """Which of the two sides along the block's x the camera sees."""
    shot, _ = painted(BLOCK)
    side = (shot.normal @ BLOCK.R_world_block)[shot.mask(0)][:, 0]
    assert (side > 0.9).any() != (side < -0.9).any()
    return 1 if (side > 0.9).any() else -1


@pytest.mark.parametrize("scale", [1, 3])
def test_seen_vertices_have_the_colors_of_the_picture_at_any_size(scale: int) -> None:
    vertices_m, rgb = colors_of(BLOCK, (), scale=scale)
    assert rgb.dtype == np.uint8
    assert share(rgb[face(vertices_m, 0, seen_side())], SIDE_RGB) == 1
    assert share(rgb[face(vertices_m, 1, 1)], TOP_RGB) == 1
    assert share(rgb[face(vertices_m, 2, 1)], FRONT_RGB) == 1
    assert share(rgb, ROOM_RGB) < 0.05, "only the outline may mix with the room"


def test_hidden_vertices_have_the_colors_of_their_mirror_image() -> None:
    hidden = -seen_side()
    vertices_m, rgb = colors_of(BLOCK, ("x", "z"))
    assert share(rgb[face(vertices_m, 0, hidden)], SIDE_RGB) > 0.95
    assert share(rgb[face(vertices_m, 2, -1)], FRONT_RGB) > 0.95


def test_without_symmetry_hidden_vertices_have_the_nearest_color() -> None:
    """The hidden side is nearest to the front and the top; no color of the other side comes there."""
    vertices_m, rgb = colors_of(BLOCK, ())
    left = rgb[face(vertices_m, 0, -seen_side())]
    assert share(left, SIDE_RGB) == 0
    assert share(left, FRONT_RGB) + share(left, TOP_RGB) > 0.9
    _, only_x = colors_of(BLOCK, ("x",))
    assert share(only_x[face(vertices_m, 0, -seen_side())], SIDE_RGB) > 0.95


def test_what_stands_before_the_thing_does_not_color_it() -> None:
    """A post hides the middle of the front: vertices there have the color of the front beside it."""
    post = Block((0.1, 0.5, -2.2), (0.08, 1.0, 0.08))
    vertices_m, rgb = colors_of(BLOCK, (), [post])
    shot, _ = painted(BLOCK, [post])
    assert shot.mask(1).sum() > 500
    assert share(rgb[face(vertices_m, 2, 1)], FRONT_RGB) > 0.97


def test_vertices_far_behind_the_seen_surface_are_not_seen() -> None:
    """A vertex 0.3 m behind the front, just under the top: it has the color of the top, not of its own pixel."""
    shot, picture = painted(BLOCK)
    own_normal = shot.normal @ BLOCK.R_world_block
    on_top = shot.world_m[shot.mask(0) & (own_normal[..., 1] > 0.9)]
    on_front = shot.world_m[shot.mask(0) & (own_normal[..., 2] > 0.9)]
    highest_m = on_front[on_front[:, 1].argmax()]
    ray = highest_m - shot.T_world_camera[:3, 3]
    behind_m = highest_m + 0.3 * ray / np.linalg.norm(ray)
    box = UprightBox(np.eye(3), np.zeros(3), np.ones(3), np.ones(3, bool))
    vertices_m = np.concatenate([on_top, highest_m[None], behind_m[None]])
    for tolerance_m, expected in ((0.05, TOP_RGB), (0.5, FRONT_RGB)):
        rgb = surface_colors(vertices_m, picture, shot.view(shot.mask(0)), box, (), tolerance_m)
        np.testing.assert_array_equal(rgb[-2], FRONT_RGB)
        np.testing.assert_array_equal(rgb[-1], expected)


def test_nothing_seen_is_gray() -> None:
    shot, picture = painted(BLOCK)
    box = UprightBox(about_y(0.0), np.zeros(3), np.ones(3), np.ones(3, bool))
    behind_camera = np.array([[0.0, 1.0, 5.0], [0.3, 0.2, 4.0]])
    rgb = surface_colors(behind_camera, picture, shot.view(shot.mask(0)), box, ("x",), 0.05)
    np.testing.assert_array_equal(rgb, np.full((2, 3), 127, np.uint8))


def test_pixels_of_a_larger_picture_are_found_by_their_middles() -> None:
    """Pixel u of the depth map covers pixels 3u to 3u + 2 of the picture: its middle is 3u + 1."""
    shot, _ = painted(BLOCK)
    picture = np.zeros((3 * LENS.height_px, 3 * LENS.width_px, 3), np.uint8)
    picture[..., 0] = np.arange(3 * LENS.width_px) % 251
    picture[..., 1] = (np.arange(3 * LENS.height_px) % 251)[:, None]
    rows, columns = np.nonzero(shot.mask(0))
    box = UprightBox(np.eye(3), np.zeros(3), np.ones(3), np.ones(3, bool))
    rgb = surface_colors(shot.world_m[rows, columns], picture, shot.view(shot.mask(0)), box, (), 0.05)
    np.testing.assert_array_equal(rgb[:, 0], (3 * columns + 1) % 251)
    np.testing.assert_array_equal(rgb[:, 1], (3 * rows + 1) % 251)
