"""A scan of the room is brought into place, and says on which side of it and how far away points are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import trimesh

from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.geometry.sdf import SdfGrid
from video2anim.scene.scan import registered, scan_field
from video2anim.types import Mesh

SAMPLE_ERROR_M = 0.02
"""Distance is to samples 4 cm apart."""


def mesh_of(quads: Sequence[Sequence[tuple[float, float, float]]]) -> Mesh:
    """Two triangles for each four corners, seen from where the corners go around to the left."""
    first = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    vertices_m = np.array(quads, np.float64).reshape(-1, 3)
    return Mesh(vertices_m, faces, np.zeros((len(vertices_m), 3), np.uint8))


def ground(x0: float, z0: float, x1: float, z1: float, y: float = 0.0) -> list[tuple[float, float, float]]:
    """Faces up."""
    return [(x0, y, z0), (x0, y, z1), (x1, y, z1), (x1, y, z0)]


def upright(a: tuple[float, float], b: tuple[float, float], height_m: float) -> list[tuple[float, float, float]]:
    """Faces to the right of the way from the first place to the second, as seen from above with x right and z down."""
    return [(a[0], 0.0, a[1]), (b[0], 0.0, b[1]), (b[0], height_m, b[1]), (a[0], height_m, a[1])]


def open_box(x0: float, z0: float, x1: float, z1: float, height_m: float) -> list[list[tuple[float, float, float]]]:
    """Top and four sides that face outward."""
    corners = [(x0, z0), (x0, z1), (x1, z1), (x1, z0)]
    sides = [upright(corners[k], corners[(k + 1) % 4], height_m) for k in range(4)]
    return [ground(x0, z0, x1, z1, height_m), *sides]


def turned_inside_out(scan: Mesh) -> Mesh:
    return Mesh(scan.vertices_m, scan.faces[:, ::-1], scan.vertex_rgb)


def l_room() -> Mesh:
    """Floor and walls of an L of 4 x 4 m, and a box on the floor."""
    corners = [(0, 0), (4, 0), (4, 2.2), (1.8, 2.2), (1.8, 4), (0, 4)]
    walls = [upright(corners[k], corners[(k + 1) % len(corners)], 1.4) for k in range(6)]
    return mesh_of([ground(0, 0, 4, 2.2), ground(0, 2.2, 1.8, 4), *walls, *open_box(2.6, 0.8, 3.3, 1.3, 0.7)])


def test_long_faces_without_an_area_are_no_surface() -> None:
    """Each would be cut into a quarter of a million pieces."""
    room = l_room()
    ends_m = np.array([[-9e3, 1.0, 0.0], [0.0, 1.0, 0.0], [9e3, 1.0, 0.0]])
    faces = np.concatenate([room.faces, np.tile(len(room.vertices_m) + np.arange(3), (1000, 1))])
    odd = Mesh(np.concatenate([room.vertices_m, ends_m]), faces, np.zeros((len(room.vertices_m) + 3, 3), np.uint8))
    bounds_m = np.array([[0.5, 0.1, 0.5], [1.0, 0.5, 1.0]])
    np.testing.assert_array_equal(scan_field(odd, bounds_m, 0.1).sdf_m, scan_field(room, bounds_m, 0.1).sdf_m)


def pose(yaw_deg: float, shift_m: tuple[float, float, float]) -> np.ndarray:
    """A turn about the room's middle, then a shift."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    T, center_m = np.eye(4), np.array([1.8, 0.0, 1.8])
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = center_m + shift_m - T[:3, :3] @ center_m
    return T


def seen_points(scan: Mesh, count: int, rng: np.random.Generator, *, noise_m: float, strays: float) -> np.ndarray:
    """Points on the scan with noise; some are anywhere in the room instead."""
    triangles = scan.vertices_m[scan.faces]
    edge_a, edge_b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = np.linalg.norm(np.cross(edge_a, edge_b), axis=-1)
    face = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points_m = triangles[face, 0] + u * edge_a[face] + v * edge_b[face] + rng.normal(0, noise_m, (count, 3))
    stray = rng.random(count) < strays
    points_m[stray] = rng.uniform(scan.vertices_m.min(0), scan.vertices_m.max(0), (stray.sum(), 3))
    return points_m


@pytest.mark.parametrize(
    ("yaw_deg", "shift_m"), [(15.0, (0.3, 0.05, -0.2)), (-15.0, (-0.4, -0.05, 0.3)), (28.0, (0.5, 0.0, 0.5))]
)
def test_a_moved_room_is_found_again(yaw_deg: float, shift_m: tuple[float, float, float]) -> None:
    """One point in five is a stray, the others are off by 1 cm: every corner of the room is back within 5 cm."""
    rng = np.random.default_rng(0)
    scan, T_world_scan = l_room(), pose(yaw_deg, shift_m)
    points_m = transform_points(T_world_scan, seen_points(scan, 600, rng, noise_m=0.01, strays=0.2))
    found = registered(scan, points_m, rng)
    left = found.T_world_scan @ invert_rigid(T_world_scan)
    assert abs(np.rad2deg(np.arctan2(left[0, 2], left[0, 0]))) < 1.0
    off_m = transform_points(found.T_world_scan, scan.vertices_m) - transform_points(T_world_scan, scan.vertices_m)
    assert np.linalg.norm(off_m, axis=1).max() < 0.05
    R = found.T_world_scan[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(R[:, 1], [0, 1, 0], atol=1e-9, err_msg="it stays upright")
    assert found.before_m > 0.05
    assert found.after_m < 0.03


def test_a_room_in_place_stays_there() -> None:
    rng = np.random.default_rng(1)
    scan = l_room()
    found = registered(scan, seen_points(scan, 400, rng, noise_m=0.01, strays=0.2), rng)
    np.testing.assert_allclose(transform_points(found.T_world_scan, scan.vertices_m), scan.vertices_m, atol=0.02)
    assert found.after_m <= found.before_m < 0.03


def test_a_fit_that_makes_it_worse_is_refused() -> None:
    """Half of the points are right, and half are 0.1 m too high: lifted to the middle, the scan fits none of them."""
    rng = np.random.default_rng(2)
    scan = mesh_of([ground(0, 0, 3, 2)])
    points_m = seen_points(scan, 500, rng, noise_m=0.0, strays=0.0)
    points_m[rng.permutation(500)[:240], 1] += 0.1
    found = registered(scan, points_m, rng)
    np.testing.assert_array_equal(found.T_world_scan, np.eye(4))
    assert found.after_m == found.before_m
    assert found.before_m < 0.05, "the half that is right, and some of the other"


def test_the_same_random_numbers_give_the_same_place() -> None:
    """More points than are used."""
    scan = mesh_of([ground(0, 0, 1, 1), upright((0, 0), (1, 0), 1.0)])
    points_m = seen_points(scan, 4000, np.random.default_rng(3), noise_m=0.02, strays=0.1)
    points_m += np.array([0.1, 0.0, 0.05])
    first, again = (registered(scan, points_m, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first.T_world_scan, again.T_world_scan)
    assert (first.before_m, first.after_m) == (again.before_m, again.after_m)


def test_nothing_cannot_be_registered() -> None:
    scan = mesh_of([ground(0, 0, 1, 1)])
    empty = Mesh(scan.vertices_m, np.zeros((0, 3), np.int64), scan.vertex_rgb)
    for mesh, points_m in ((scan, np.zeros((0, 3))), (empty, np.zeros((5, 3)))):
        with pytest.raises(ValueError, match="want points and faces"):
            registered(mesh, points_m, np.random.default_rng(0))


BOUNDS_M = np.array([[-0.4, -0.3, -0.4], [3.4, 1.8, 3.4]])
WALL_M = 2.0
BOX_LOW_M, BOX_HIGH_M = np.array([1.0, -1.0, 1.2]), np.array([1.8, 0.7, 1.8])
"""The box has no bottom, so it is as good as one that goes on below the floor."""


def square_room() -> Mesh:
    """3 x 3 m, 2 m high, without a ceiling; where the box stands no floor was scanned."""
    (x0, _, z0), (x1, high, z1) = BOX_LOW_M, BOX_HIGH_M
    corners = [(0, 0), (3, 0), (3, 3), (0, 3)]
    walls = [upright(corners[k], corners[(k + 1) % 4], WALL_M) for k in range(4)]
    floor = [ground(0, 0, 3, z0), ground(0, z1, 3, 3), ground(0, z0, x0, z1), ground(x1, z0, 3, z1)]
    return mesh_of([*floor, *walls, *open_box(x0, z0, x1, z1, high)])


def nodes_m(grid: SdfGrid) -> np.ndarray:
    axes = [grid.origin_m[a] + grid.spacing_m * np.arange(grid.sdf_m.shape[a]) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def box_distance_m(points_m: np.ndarray) -> np.ndarray:
    q = np.abs(points_m - 0.5 * (BOX_LOW_M + BOX_HIGH_M)) - 0.5 * (BOX_HIGH_M - BOX_LOW_M)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def test_signs_and_distances_of_an_open_room() -> None:
    """Walls face inward and the box outward: free between them, solid in the box, behind the walls, under the floor.

    Distance is never too small and too large by at most 2 cm.
    """
    grid = scan_field(square_room(), BOUNDS_M, 0.1)
    points_m = nodes_m(grid)
    inward_m = np.minimum(points_m, 3 - points_m)[..., [0, 2]].min(-1)
    box_m, height_m = box_distance_m(points_m), points_m[..., 1]
    truth_m = np.minimum(np.minimum(inward_m, box_m), height_m)
    in_room = (inward_m > 0.01) & (height_m > 0.01)
    # The boundary itself has no side.
    free, in_box = in_room & (box_m > 0.01), in_room & (box_m < -0.01)
    assert free.sum() > 10_000
    assert in_box.sum() > 100
    assert (grid.sdf_m[free] > 0).all()
    assert (grid.sdf_m[in_box] < 0).all()
    excess_m = np.abs(grid.sdf_m) - np.abs(truth_m)
    for part in (free, in_box):
        assert excess_m[part].min() > -1e-6
        assert excess_m[part].max() < SAMPLE_ERROR_M
    behind = (inward_m < -0.01) & (height_m > 0.01) & (height_m < WALL_M)
    assert (grid.sdf_m[behind] < 0).all()
    under = height_m < -0.01
    assert (grid.sdf_m[under] <= height_m[under] + 1e-6).all()


def test_the_side_is_that_to_which_the_triangles_face() -> None:
    """A panel with a free side and a solid one; the other way round with its triangles turned."""
    panel = mesh_of([upright((-1, 0), (1, 0), 2.0)])
    bounds_m = np.array([[-0.2, 0.8, -0.4], [0.2, 1.2, 0.4]])
    probe = np.array([[0.0, 1.0, 0.3], [0.0, 1.0, -0.3]])
    straight, turned = (scan_field(m, bounds_m, 0.1).sample(probe) for m in (panel, turned_inside_out(panel)))
    np.testing.assert_allclose(straight, [0.3, -0.3], atol=SAMPLE_ERROR_M)
    np.testing.assert_allclose(turned, [-0.3, 0.3], atol=SAMPLE_ERROR_M)


def test_the_floor_always_counts() -> None:
    """A scan without a floor; its floor lies where the world's does, or where one says."""
    panel = mesh_of([upright((-1, 0), (1, 0), 2.0)])
    bounds_m = np.array([[-0.2, -0.4, 0.4], [0.2, 0.6, 1.0]])
    for floor_y_m in (0.0, 0.2):
        grid = scan_field(panel, bounds_m, 0.1, floor_y_m)
        points_m = nodes_m(grid)
        height_m = points_m[..., 1] - floor_y_m
        low = height_m < 0.35
        np.testing.assert_allclose(grid.sdf_m[low], height_m[low], atol=1e-6)
        high = height_m > points_m[..., 2]
        np.testing.assert_allclose(grid.sdf_m[high], points_m[..., 2][high], atol=SAMPLE_ERROR_M)


def test_a_thin_board_makes_nothing_solid_beside_it() -> None:
    """A table top of 3 cm: beside its edge and over its corners the space is free."""
    board = trimesh.creation.box((1.0, 0.03, 0.6))
    board.apply_translation([0.0, 0.7, 0.0])
    scan = Mesh(np.asarray(board.vertices), np.asarray(board.faces), np.zeros((8, 3), np.uint8))
    grid = scan_field(scan, np.array([[-1.0, 0.4, -0.8], [1.0, 1.0, 0.8]]), 0.05)
    q = np.abs(nodes_m(grid) - [0.0, 0.7, 0.0]) - [0.5, 0.015, 0.3]
    away_m = np.linalg.norm(np.maximum(q, 0), axis=-1)
    assert (grid.sdf_m[away_m > 0.03] > 0).all()
    inside = (q < -0.01).all(-1)
    assert inside.sum() > 20
    assert (grid.sdf_m[inside] < 0).all()


def test_the_grid_covers_its_bounds() -> None:
    grid = scan_field(mesh_of([ground(0, 0, 1, 1)]), np.array([[0.0, 0.0, 0.0], [1.0, 0.55, 0.3]]), 0.1)
    assert grid.sdf_m.shape == (11, 7, 4)
    assert grid.spacing_m == 0.1
    np.testing.assert_array_equal(grid.origin_m, [0.0, 0.0, 0.0])
