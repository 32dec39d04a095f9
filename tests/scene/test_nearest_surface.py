"""The nearest triangle of a solid, and on which side of it a point lies."""

from __future__ import annotations

import numpy as np

from video2anim.geometry.scene_mesh import box_mesh
from video2anim.scene.nearest_surface import nearest_surface

SIZE_M = np.array([0.6, 0.4, 0.9])
REACH_M = 0.05


def triangles_m() -> np.ndarray:
    mesh = box_mesh(*SIZE_M)
    return mesh.vertices_m[mesh.faces]


def box_distance_m(points_m: np.ndarray) -> np.ndarray:
    """Signed distance to the same box, in closed form."""
    over_m = np.abs(points_m - [0.0, 0.5 * SIZE_M[1], 0.0]) - 0.5 * SIZE_M
    return np.linalg.norm(np.maximum(over_m, 0.0), axis=-1) + np.minimum(over_m.max(-1), 0.0)


def test_distances_are_those_of_the_box_and_all_in_reach_are_found() -> None:
    points_m = np.random.default_rng(0).uniform([-0.4, -0.1, -0.6], [0.4, 0.5, 0.6], (20_000, 3))
    found, truth_m = nearest_surface(points_m, triangles_m(), reach_m=REACH_M), box_distance_m(points_m)
    # Beside an edge the side that is nearer by less than half a piece may be missed.
    assert np.abs(found.distance_m - truth_m[found.point]).max() < 0.002
    assert (np.sign(found.distance_m) == np.sign(truth_m[found.point])).all(), "also beside edges and corners"
    missed = np.setdiff1d(np.flatnonzero(np.abs(truth_m) < REACH_M - 0.002), found.point)
    assert len(missed) == 0
    assert (np.diff(found.point) > 0).all()


def test_the_face_is_the_one_below_the_point() -> None:
    points_m = np.array([[0.1, SIZE_M[1] + 0.02, 0.2], [0.1, SIZE_M[1] - 0.02, 0.2], [0.1, SIZE_M[1] + 0.2, 0.2]])
    corners_m = triangles_m()
    found = nearest_surface(points_m, corners_m, reach_m=REACH_M)
    assert found.point.tolist() == [0, 1]
    assert np.allclose(found.distance_m, [0.02, -0.02])
    assert np.allclose(corners_m[found.face, :, 1], SIZE_M[1])


def test_nothing_in_reach_and_nothing_to_reach() -> None:
    far_m = np.array([[5.0, 0.0, 0.0]])
    assert len(nearest_surface(far_m, triangles_m(), reach_m=REACH_M).point) == 0
    center_m = np.array([[0.0, 0.5 * SIZE_M[1], 0.0]])
    assert len(nearest_surface(center_m, triangles_m(), reach_m=REACH_M).point) == 0, "inside, far from all faces"
    low_m = np.array([[0.0, 0.5 * SIZE_M[1], 0.0], [0.0, 0.07, 0.0]])
    assert len(nearest_surface(low_m, triangles_m(), reach_m=REACH_M).point) == 0, "the box around them reaches a face"
    flat_m = np.zeros((4, 3, 3))
    assert len(nearest_surface(np.zeros((2, 3)), flat_m, reach_m=REACH_M).point) == 0
    assert len(nearest_surface(np.zeros((0, 3)), triangles_m(), reach_m=REACH_M).point) == 0
