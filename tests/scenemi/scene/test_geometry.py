"""Nearest solid points of every kind of scene against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from trimesh.triangles import closest_point

from scenemi.scene.boxes import Boxes
from scenemi.scene.geometry import SceneGeometry
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.types.scene import Mesh


def points_around(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-2.4, -0.2, -2.4], [2.4, 2.4, 2.4], (count, 3))


def brute_force_m(points_m: np.ndarray, triangles_m: np.ndarray) -> np.ndarray:
    best_m = np.full(len(points_m), np.inf)
    for triangle in triangles_m:
        found = closest_point(np.broadcast_to(triangle, (len(points_m), 3, 3)), points_m)
        best_m = np.minimum(best_m, np.linalg.norm(found - points_m, axis=1))
    return best_m


def test_nearest_on_a_triangle_is_nearer_than_any_point_of_it() -> None:
    rng = np.random.default_rng(0)
    points, triangles = rng.normal(size=(300, 3)), rng.normal(size=(300, 3, 3))
    triangles[:20, 2] = triangles[:20, 1]  # degenerate
    found = closest_point(triangles, points)
    weights = rng.dirichlet(np.ones(3) * 0.5, 4000)
    sampled = np.einsum("sk,nkd->nsd", weights, triangles)
    best = np.linalg.norm(sampled - points[:, None], axis=-1).min(1)
    gap = np.linalg.norm(found - points, axis=-1)
    assert (gap <= best + 1e-9).all()
    assert (best - gap).max() < 0.1
    # The found point lies in the triangle: its distance to it is zero.
    np.testing.assert_allclose(closest_point(triangles, found), found, atol=1e-7)


def test_mesh_surface_against_all_triangles(furnished_room: trimesh.Trimesh) -> None:
    scene = SceneGeometry.from_mesh(furnished_room.vertices, furnished_room.faces)
    points_m = points_around(3000)
    gap_m = np.linalg.norm(scene.nearest(points_m) - points_m, axis=1)
    truth_m = brute_force_m(points_m, np.asarray(furnished_room.triangles))
    np.testing.assert_allclose(gap_m, truth_m, atol=1e-6)


def test_points_against_all_points() -> None:
    rng = np.random.default_rng(2)
    solid_m, points_m = rng.uniform(-1, 1, (400, 3)), rng.uniform(-2, 2, (5, 60, 3))
    found_m = SceneGeometry.from_points(solid_m).nearest(points_m)
    best = np.linalg.norm(points_m[..., None, :] - solid_m, axis=-1).argmin(-1)
    np.testing.assert_array_equal(found_m, solid_m[best])


def test_filled_mesh_has_an_inside_even_where_parts_overlap(furnished_room: trimesh.Trimesh) -> None:
    scene = SceneGeometry.from_mesh(furnished_room.vertices, furnished_room.faces, fill=True)
    points_m = points_around(4000)
    inside = np.zeros(len(points_m), bool)
    for part in furnished_room.split(only_watertight=True):
        inside |= part.contains(points_m)
    assert inside.sum() > 100
    still = (scene.nearest(points_m) == points_m).all(axis=1)
    np.testing.assert_array_equal(still, inside)


def test_a_room_shell_with_inward_normals_stays_free_inside() -> None:
    shell = trimesh.creation.box((4.0, 2.5, 4.0))
    shell.invert()
    scene = SceneGeometry.from_mesh(shell.vertices, shell.faces, fill=True)
    np.testing.assert_allclose(scene.nearest(np.array([0.0, 0.0, 1.5])), [0.0, 0.0, 2.0], atol=1e-9)


def test_distance_grid_against_the_boxes_it_was_built_from() -> None:
    boxes = Boxes(
        np.array([[0.5, 0.4, 0.2], [-0.8, 0.3, -0.6]]), np.array([[0.3, 0.4, 0.5], [0.25, 0.3, 0.6]]), np.zeros(2)
    )
    solids = []
    for center, half in zip(boxes.center_m, boxes.half_m, strict=True):
        mesh = trimesh.creation.box(2 * half).apply_translation(center)
        solids.append(Mesh(mesh.vertices, mesh.faces, np.zeros((len(mesh.vertices), 3), np.uint8)))
    grid = build_sdf_grid(solids, np.array([[-1.6, -0.2, -1.6], [1.6, 1.6, 1.6]]), 0.05)
    points_m = np.random.default_rng(3).uniform([-1.5, 0.0, -1.5], [1.5, 1.5, 1.5], (3000, 3))
    truth_m = np.minimum(boxes.signed_distance(points_m), points_m[:, 1])
    found_m = SceneGeometry.from_sdf(grid).nearest(points_m)
    error_m = np.abs(np.linalg.norm(found_m - points_m, axis=1) - np.maximum(truth_m, 0.0))
    over_floor = boxes.signed_distance(points_m) > points_m[:, 1] + 0.2
    assert error_m[over_floor].max() < 1e-6
    assert np.quantile(error_m, 0.95) < 0.01
    assert error_m.max() < 0.045, "corners are rounded by the grid"
    on_surface_m = np.minimum(boxes.signed_distance(found_m), found_m[:, 1])[truth_m > 0]
    assert np.abs(on_surface_m).max() < 0.01


def test_a_moved_scene_answers_as_moved_points(furnished_room: trimesh.Trimesh) -> None:
    solids = SceneGeometry.from_mesh(furnished_room.vertices, furnished_room.faces)
    scene = SceneGeometry((*solids.parts, *SceneGeometry.floor(-0.1).parts))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_axis_angle(np.array([0.3, -1.1, 0.2])), [0.5, -0.2, 2.0]
    points_m = points_around(200)
    moved_m = points_m @ T[:3, :3].T + T[:3, 3]
    expected = scene.nearest(points_m) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(scene.transformed(T).nearest(moved_m), expected, atol=1e-9)
    with pytest.raises(ValueError, match="rotation and a shift"):
        scene.transformed(np.diag([2.0, 2.0, 2.0, 1.0]))


def test_floor_is_solid_below() -> None:
    found = SceneGeometry.floor(0.2).nearest(np.array([[1.0, 1.2, 3.0], [1.0, -1.0, 3.0]]))
    np.testing.assert_allclose(found, [[1.0, 0.2, 3.0], [1.0, -1.0, 3.0]])


def test_bad_scenes_are_named() -> None:
    with pytest.raises(InputError, match="at least one triangle"):
        SceneGeometry.from_mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    with pytest.raises(InputError, match=r"0\.\.7 of 3"):
        SceneGeometry.from_mesh(np.zeros((3, 3)), np.array([[0, 1, 7]]))
    with pytest.raises(InputError, match="NaN"):
        SceneGeometry.from_mesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match="at least one point"):
        SceneGeometry.from_points(np.zeros((0, 3)))
    with pytest.raises(InputError, match="no surface"):
        SceneGeometry.from_sdf(SdfGrid(np.ones((3, 3, 3), np.float32), np.zeros(3), 0.1))
