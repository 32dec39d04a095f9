"""The nearest triangle of a mesh, and on which side of it a point lies."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.triangles import closest_point

from video2anim.geometry.mesh_query import MeshQuery
from video2anim.geometry.scene_mesh import box_mesh

SIZE_M = np.array([0.6, 0.4, 0.9])
REACH_M = 0.05


def triangles_m() -> np.ndarray:
    mesh = box_mesh(*SIZE_M)
    return mesh.vertices_m[mesh.faces]


def box_distance_m(points_m: np.ndarray) -> np.ndarray:
    """Signed distance to the same box, in closed form."""
    over_m = np.abs(points_m - [0.0, 0.5 * SIZE_M[1], 0.0]) - 0.5 * SIZE_M
    return np.linalg.norm(np.maximum(over_m, 0.0), axis=-1) + np.minimum(over_m.max(-1), 0.0)


def test_distances_and_sides_are_those_of_the_box_and_all_in_reach_are_found() -> None:
    points_m = np.random.default_rng(0).uniform([-0.4, -0.1, -0.6], [0.4, 0.5, 0.6], (20_000, 3))
    found, truth_m = MeshQuery.of(triangles_m()).nearest(points_m, REACH_M), box_distance_m(points_m)
    hit = found.face >= 0
    np.testing.assert_array_equal(hit, np.abs(truth_m) <= REACH_M)
    np.testing.assert_allclose(found.distance_m[hit], truth_m[hit], atol=1e-6)
    np.testing.assert_allclose(np.abs(box_distance_m(found.point_m[hit])), 0, atol=1e-6)
    assert (found.point_m[~hit] == points_m[~hit]).all()
    assert np.isposinf(found.distance_m[~hit]).all()


def test_the_face_is_the_one_below_the_point() -> None:
    points_m = np.array([[0.1, SIZE_M[1] + 0.02, 0.2], [0.1, SIZE_M[1] - 0.02, 0.2], [0.1, SIZE_M[1] + 0.2, 0.2]])
    corners_m = triangles_m()
    found = MeshQuery.of(corners_m).nearest(points_m, REACH_M)
    assert found.face[2] == -1
    np.testing.assert_allclose(found.distance_m[:2], [0.02, -0.02], atol=1e-6)
    np.testing.assert_allclose(corners_m[found.face[:2], :, 1], SIZE_M[1])


def test_against_all_triangles_of_a_shape_that_is_not_convex() -> None:
    shape = trimesh.creation.torus(0.4, 0.15, major_sections=24, minor_sections=10)
    points_m = np.random.default_rng(0).uniform(-0.8, 0.8, (400, 3))
    each_m = [closest_point(np.broadcast_to(one, (400, 3, 3)), points_m) for one in shape.triangles]
    brute_m = np.linalg.norm(np.stack(each_m) - points_m, axis=-1).min(0)
    found = MeshQuery(np.asarray(shape.vertices), np.asarray(shape.faces)).nearest(points_m)
    np.testing.assert_allclose(np.abs(found.distance_m), brute_m, atol=1e-6)
    np.testing.assert_array_equal(found.distance_m < 0, shape.contains(points_m))


def test_a_mesh_that_is_turned_inside_out_has_the_same_inside() -> None:
    points_m = np.random.default_rng(2).uniform([-0.4, -0.1, -0.6], [0.4, 0.5, 0.6], (2_000, 3)) + 5.0
    both = [MeshQuery.of(one + 5.0).nearest(points_m) for one in (triangles_m(), triangles_m()[:, ::-1])]
    assert (both[0].distance_m < 0).any()
    np.testing.assert_allclose(both[1].distance_m, both[0].distance_m, atol=1e-6)


def test_where_parts_overlap_is_inside() -> None:
    apart_m = np.array([0.0, 0.0, 0.3])
    both = MeshQuery.of(np.concatenate([triangles_m(), triangles_m() + apart_m]))
    points_m = np.random.default_rng(1).uniform([-0.4, -0.1, -0.6], [0.4, 0.5, 0.9], (5_000, 3))
    inside = np.minimum(box_distance_m(points_m), box_distance_m(points_m - apart_m)) < 0
    np.testing.assert_array_equal(both.nearest(points_m).distance_m < 0, inside)


@pytest.mark.parametrize("faces", [0, 1])
def test_nothing_to_reach_and_nobody_who_asks(faces: int) -> None:
    query = MeshQuery.of(np.ones((faces, 3, 3)) * np.arange(3)[:, None])
    assert (query.nearest(np.full((2, 3), 50.0), REACH_M).face == -1).all()
    assert len(query.nearest(np.zeros((0, 3))).face) == 0


def test_nothing_is_printed_even_where_kernels_are_compiled(tmp_path: Path) -> None:
    code = (
        "import numpy as np; from video2anim.geometry import mesh_kernels, mesh_query;"
        f"mesh_kernels.wp.config.kernel_cache_dir = {str(tmp_path)!r};"
        "mesh_query.MeshQuery.of(np.eye(3)[None]).nearest(np.zeros((1, 3)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=dict(os.environ)
    )
    assert done.stdout + done.stderr == ""
