"""Voxels and basis points against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scene_motions import Window

from scenemi.scene.basis_points import anchor_vertices, bps
from scenemi.scene.boxes import Boxes
from scenemi.scene.geometry import HalfSpace, SceneGeometry
from scenemi.scene.voxels import DEFAULT_GRID, GridSpec, occupancy
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.motion import BodyShape


def frame_at(yaw: float, x: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    T[:3, 3] = x, 0.0, z
    return T


def test_voxel_centers_are_where_the_contract_says() -> None:
    centers_m = DEFAULT_GRID.centers_m()
    assert centers_m.shape == (48, 24, 48, 3)
    np.testing.assert_allclose(centers_m[0, 0, 0], [-2.35, 0.05, -2.35])
    np.testing.assert_allclose(centers_m[47, 23, 10], [2.35, 2.35, -1.35])


def test_occupancy_of_points_against_all_pairs() -> None:
    rng = np.random.default_rng(0)
    points_m, T = rng.uniform([-3, 0, -3], [3, 2.4, 3], (1500, 3)), frame_at(0.7, 0.4, -0.3)
    voxels = occupancy(SceneGeometry.from_points(points_m), T)
    local_m = (points_m - T[:3, 3]) @ T[:3, :3]
    expected = np.zeros(voxels.shape, bool)
    for plane in range(0, 48, 4):
        gap_m = np.linalg.norm(DEFAULT_GRID.centers_m()[plane][..., None, :] - local_m, axis=-1).min(-1)
        expected[plane] = gap_m <= 0.0501
    assert expected.sum() > 30
    np.testing.assert_array_equal(voxels[::4], expected[::4])


def test_occupancy_of_a_mesh_follows_its_exact_distance(furnished_room: trimesh.Trimesh) -> None:
    voxels = occupancy(SceneGeometry.from_mesh(furnished_room.vertices, furnished_room.faces), np.eye(4))
    centers_m = DEFAULT_GRID.centers_m().reshape(-1, 3)
    _, gap_m, _ = trimesh.proximity.closest_point(furnished_room, centers_m[::7])
    np.testing.assert_array_equal(voxels.ravel()[::7], gap_m <= 0.0501)
    assert voxels[:, 0].all()


def test_floor_fills_the_lowest_layer_only() -> None:
    voxels = occupancy(SceneGeometry.floor(), frame_at(1.0, 3.0, -2.0))
    assert voxels[:, 0].all()
    assert not voxels[:, 1:].any()


@pytest.mark.parametrize("grid", [DEFAULT_GRID, GridSpec((96, 48, 96), 0.05)])
def test_voxels_of_boxes_agree_with_the_general_way(grid: GridSpec) -> None:
    rng = np.random.default_rng(4)
    boxes = Boxes(
        rng.uniform([-2.6, 0, -2.6], [2.6, 2, 2.6], (12, 3)), rng.uniform(0.02, 0.6, (12, 3)), rng.uniform(-3, 3, 12)
    )
    np.testing.assert_array_equal(boxes.occupancy(grid), occupancy(SceneGeometry.of(boxes), np.eye(4), grid))


def test_box_distances_against_their_surface() -> None:
    rng = np.random.default_rng(5)
    boxes = Boxes(rng.uniform(-1, 1, (4, 3)), rng.uniform(0.1, 0.5, (4, 3)), rng.uniform(-3, 3, 4))
    points_m = rng.uniform(-2, 2, (500, 3))
    found_m, gap_m = boxes.nearest_within(points_m, np.inf)
    signed_m = boxes.signed_distance(points_m)
    np.testing.assert_allclose(gap_m, np.maximum(signed_m, 0.0), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found_m - points_m, axis=1), gap_m, atol=1e-9)
    assert (boxes.signed_distance(found_m) < 1e-9).all()
    assert (signed_m < -0.05).any()


def test_anchors_are_spread_alike_for_every_shape(adult: ShapedBody) -> None:
    anchors = anchor_vertices(adult)
    heavy = shaped_body(BodyShape("anny", {**ADULT, "weight": 0.9, "height": 0.7}))
    np.testing.assert_array_equal(anchor_vertices(heavy), anchors)
    np.testing.assert_array_equal(anchor_vertices(adult, 256)[:64], anchors)
    assert len(set(anchors.tolist())) == 64
    upright = np.broadcast_to(np.eye(3), (1, 22, 3, 3))
    skin_m = adult.vertices(upright, adult.rest_joints_m[None])[0]
    between_m = np.linalg.norm(skin_m[anchors][:, None] - skin_m[anchors], axis=-1) + 9 * np.eye(64)
    cover_m = np.linalg.norm(skin_m[:, None] - skin_m[anchors], axis=-1).min(1).max()
    # Farthest-point sampling: no skin is farther from its anchor than anchors are from each other.
    assert cover_m <= between_m.min() + 1e-5
    assert cover_m < 0.2


def test_offsets_against_all_points(walk: Window) -> None:
    rng = np.random.default_rng(6)
    solid_m, T = rng.uniform([-3, 0, -1], [3, 2, 4], (800, 3)), frame_at(-0.8, 0.0, 0.0)
    offsets_m = bps(SceneGeometry.from_points(solid_m), walk.anchors_m[:5], T[:3, :3])
    pairs_m = solid_m - walk.anchors_m[:5, :, None]
    nearest = np.take_along_axis(pairs_m, np.linalg.norm(pairs_m, axis=-1).argmin(-1)[..., None, None], 2)[:, :, 0]
    length_m = np.linalg.norm(nearest, axis=-1, keepdims=True)
    expected = (nearest @ T[:3, :3]) * np.minimum(1.0, 1.0 / length_m)
    np.testing.assert_allclose(offsets_m, expected, atol=1e-6)
    assert offsets_m.shape == (5, 64, 3)


def test_far_offsets_keep_their_direction() -> None:
    anchors_m = np.tile(np.array([0.0, 5.0, 0.0]), (1, 64, 1))
    np.testing.assert_allclose(bps(SceneGeometry.floor(), anchors_m, np.eye(3))[0, 0], [0.0, -1.0, 0.0])
    scene = SceneGeometry.of(HalfSpace(4.5))
    np.testing.assert_allclose(bps(scene, anchors_m, np.eye(3))[0, 0], [0.0, -0.5, 0.0])
