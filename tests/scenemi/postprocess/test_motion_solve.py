"""The motion-in-scene solve on a walk with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from synthetic import FPS, planted_walk, with_root_shift

from scenemi.metrics import foot_skating_gmd, jerk_m_s3, mpjpe
from scenemi.postprocess.motion_solve import (
    PictureTarget,
    SceneMotion,
    SolveConfig,
    rows_along,
    solve_motions,
)
from scenemi.postprocess.solids import MovableSolid, Solids
from video2anim.body.anny_body import shaped_body
from video2anim.geometry.projection import invert_rigid, project
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.types import BodyMotion, Mesh
from video2anim.types.skeleton import forward_kinematics

FRAMES = 61
FLOOR = Solids()
NOTHING = Solids(floor=False)


def picture_of(motion: BodyMotion) -> PictureTarget:
    """The joints where the motion's own camera sees them."""
    camera_m = motion.joints_camera_m
    height_px = motion.intrinsics.fy_px * 1.73 / camera_m[:, 0, 2]
    seen = np.broadcast_to(motion.valid[:, None], camera_m.shape[:2])
    return PictureTarget(
        project(camera_m, motion.intrinsics), seen, height_px, invert_rigid(motion.T_world_camera),
        motion.intrinsics.matrix(),
    )  # fmt: skip


def given(motion: BodyMotion, picture: PictureTarget | None = None) -> SceneMotion:
    return SceneMotion(
        motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.contact, motion.rest_joints_m,
        shaped_body(motion.shape), FPS, np.zeros(motion.frame_count, bool), picture,
    )  # fmt: skip


def solved(motion: BodyMotion, solids: Solids, picture: PictureTarget | None = None) -> BodyMotion:
    found = solve_motions([given(motion, picture)], solids)
    return motion.with_pose(translation_world_m=found.translation_world_m[0], R_parent_joint=found.R_parent_joint[0])


def deepest_m(motion: BodyMotion, field: SdfGrid) -> float:
    body = shaped_body(motion.shape)
    joints_m, R = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    return float(-field.sample(body.vertices(R, joints_m).astype(np.float64)).min())


def pillar(x_m: float, z_m: float) -> SdfGrid:
    shape = trimesh.creation.box((0.3, 1.6, 0.3))
    shape.apply_translation((x_m, 0.8, z_m))
    mesh = Mesh(np.asarray(shape.vertices), np.asarray(shape.faces), np.zeros((8, 3), np.uint8))
    return build_sdf_grid([mesh], np.array([[-1.5, -0.3, z_m - 1], [1.5, 2.0, z_m + 1]]), 0.05, floor_y_m=None)


def test_rows_are_those_of_small_changes() -> None:
    motion = planted_walk(3)
    rng = np.random.default_rng(0)
    joint = np.array([0, 4, 11, 15, 21])
    offset_m = rng.normal(0, 0.1, (3, 5, 3))

    def points_m(d: np.ndarray, w: np.ndarray) -> np.ndarray:
        R = motion.R_parent_joint @ matrix_from_axis_angle(w)
        joints_m, R_world = forward_kinematics(R, motion.T_world_root[:, :3, 3] + d, motion.rest_joints_m)
        return joints_m[:, joint] + (R_world[:, joint] @ offset_m[..., None])[..., 0]

    rest = np.zeros((3, 3)), np.zeros((3, 22, 3))
    joints_m, R_world = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    every, direction = np.repeat(np.arange(5), 3), np.broadcast_to(np.tile(np.eye(3), (5, 1)), (3, 15, 3))
    J = rows_along(joints_m, R_world, points_m(*rest)[:, every], joint[every], direction).reshape(3, 5, 3, -1)
    d, w = rng.normal(size=(3, 3)), rng.normal(size=(3, 22, 3))
    change = (points_m(1e-6 * d, 1e-6 * w) - points_m(-1e-6 * d, -1e-6 * w)) / 2e-6
    x = np.concatenate([d, w.reshape(3, -1)], 1)
    np.testing.assert_allclose(np.einsum("tpcu,tu->tpc", J, x), change, atol=1e-6)


def test_a_motion_that_fits_stays() -> None:
    truth = planted_walk(FRAMES)
    found = solved(truth, FLOOR, picture_of(truth))
    assert mpjpe(found.joints_world_m, truth.joints_world_m) < 0.004


def test_the_picture_brings_a_body_back_that_was_moved_across_the_sight() -> None:
    truth = planted_walk(FRAMES)
    moved = with_root_shift(truth, np.tile([0.0, 0.0, 0.06], (FRAMES, 1)))
    found = solved(moved, NOTHING, picture_of(truth))
    assert mpjpe(found.joints_world_m, truth.joints_world_m) < 0.25 * mpjpe(moved.joints_world_m, truth.joints_world_m)


def test_frames_that_the_picture_does_not_show_go_with_their_neighbors() -> None:
    truth = planted_walk(FRAMES)
    seen = picture_of(truth)
    moved = with_root_shift(truth, np.tile([0.0, 0.0, 0.06], (FRAMES, 1)))
    shown = seen.seen.copy()
    shown[25:35] = False
    found = solved(moved, NOTHING, replace(seen, seen=shown))
    off_m = np.linalg.norm(found.T_world_root[:, :3, 3] - truth.T_world_root[:, :3, 3], axis=1)
    assert off_m[25:35].max() < 0.03


def test_standing_feet_stop_and_no_jerk_is_added() -> None:
    truth = planted_walk(FRAMES)
    drift_m = np.stack([0.05 * np.sin(0.1 * np.arange(FRAMES)), np.zeros(FRAMES), np.zeros(FRAMES)], -1)
    raw = with_root_shift(truth, drift_m)
    found = solved(raw, FLOOR)
    stands = (truth.contact[1:] > 0.5) & (truth.contact[:-1] > 0.5)
    speed = [FPS * np.linalg.norm(np.diff(m.joints_world_m, axis=0), axis=-1)[stands] for m in (raw, found)]
    assert np.mean(speed[1]) < 0.2 * np.mean(speed[0])
    assert foot_skating_gmd(found.joints_world_m, FPS) <= foot_skating_gmd(raw.joints_world_m, FPS)
    assert jerk_m_s3(found.joints_world_m, FPS) < 1.1 * jerk_m_s3(raw.joints_world_m, FPS)


@pytest.mark.parametrize("height_m", [-0.04, 0.05])
def test_soles_meet_the_floor(height_m: float) -> None:
    truth = planted_walk(FRAMES)
    raw = with_root_shift(truth, np.tile([0.0, height_m, 0.0], (FRAMES, 1)))
    found = solved(raw, FLOOR)
    off_m = np.abs(found.joints_world_m[..., 1] - truth.joints_world_m[..., 1]).mean()
    assert off_m < 0.25 * abs(height_m)


def test_what_cannot_move_pushes_the_body_and_what_can_gives_way() -> None:
    """The picture shows the body where it is; a pillar stands in its shoulder."""
    truth = planted_walk(FRAMES)
    center_m = truth.joints_world_m[30, 16]
    field = pillar(float(center_m[0]) + 0.2, float(center_m[2]))
    assert deepest_m(truth, field) > 0.03
    pushed = solved(truth, Solids(field), picture_of(truth))
    away = np.diag([0.3, 0.05, 0.02]) ** 2
    found = solve_motions([given(truth, picture_of(truth))], Solids(None, (MovableSolid(field, away),)))
    kept = truth.with_pose(translation_world_m=found.translation_world_m[0], R_parent_joint=found.R_parent_joint[0])
    assert deepest_m(pushed, field) < 0.012
    moved = SdfGrid(field.sdf_m, field.origin_m + found.moved_m[0], field.spacing_m)
    assert deepest_m(kept, moved) < 0.01
    assert np.linalg.norm(found.moved_m[0]) > 0.02
    assert mpjpe(kept.joints_world_m, truth.joints_world_m) < 0.5 * mpjpe(pushed.joints_world_m, truth.joints_world_m)


def test_two_people_share_a_solid_that_gives_way() -> None:
    first = planted_walk(FRAMES)
    second = with_root_shift(first, np.tile([0.0, 0.0, 3.0], (FRAMES, 1)))
    beside_m = first.joints_world_m[30, 16]
    field = pillar(float(beside_m[0]) + 0.2, float(beside_m[2]))
    solid = MovableSolid(field, np.diag([0.3, 0.05, 0.02]) ** 2)
    alone = solve_motions([given(first)], Solids(None, (solid,)))
    both = solve_motions([given(first), given(second)], Solids(None, (solid,)))
    np.testing.assert_allclose(both.moved_m, alone.moved_m, atol=1e-6)
    np.testing.assert_allclose(both.translation_world_m[0], alone.translation_world_m[0], atol=1e-6)


def test_solids_out_of_reach_are_as_if_they_were_not_there() -> None:
    field = pillar(0.3, 0.0)
    far = replace(Solids(None, (MovableSolid(field, np.eye(3)),)), reach_m=0.3)
    points_m = np.random.default_rng(0).uniform([-2, 0, -2], [2, 2, 2], (5000, 3))
    moved_m = np.array([[0.1, 0.0, -0.2]])
    exact_m, exact_owner = replace(far, reach_m=np.inf).distance_m(points_m, moved_m)
    found_m, owner = far.distance_m(points_m, moved_m)
    near = exact_m < 0.3
    np.testing.assert_array_equal(found_m[near], exact_m[near])
    np.testing.assert_array_equal(owner[near], exact_owner[near])
    assert (found_m[~near] >= 0.3).all()
    assert (owner != exact_owner).any()


def test_a_body_that_nothing_is_near_stays() -> None:
    motion = planted_walk(FRAMES)
    high = replace(
        given(with_root_shift(motion, np.tile([0.0, 5.0, 0.0], (FRAMES, 1)))), contact=np.zeros((FRAMES, 22))
    )
    found = solve_motions([high], Solids(None, (MovableSolid(pillar(0.3, 0.0), np.eye(3)),)))
    np.testing.assert_allclose(found.translation_world_m[0], high.translation_world_m, atol=1e-12)
    np.testing.assert_allclose(found.moved_m, 0.0, atol=1e-12)


def test_fixed_frames_stay() -> None:
    raw = with_root_shift(planted_walk(FRAMES), np.tile([0.0, -0.04, 0.0], (FRAMES, 1)))
    start = given(raw)
    fixed = np.zeros(FRAMES, bool)
    fixed[::20] = True
    found = solve_motions([replace(start, fixed=fixed)], FLOOR)
    np.testing.assert_allclose(found.translation_world_m[0][fixed], start.translation_world_m[fixed], atol=1e-12)
    np.testing.assert_allclose(found.R_parent_joint[0][fixed], start.R_parent_joint[fixed], atol=1e-12)
    assert np.abs(found.translation_world_m[0][10] - start.translation_world_m[10]).max() > 0.01


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_shortest_motions_work(frames: int) -> None:
    raw = planted_walk(frames)
    assert np.isfinite(solved(raw, FLOOR, picture_of(raw)).joints_world_m).all()


def test_more_iterations_change_little() -> None:
    raw = with_root_shift(planted_walk(FRAMES), np.tile([0.02, -0.03, 0.02], (FRAMES, 1)))
    few, many = (solve_motions([given(raw)], FLOOR, SolveConfig(iterations=n)).translation_world_m[0] for n in (8, 30))
    assert np.abs(few - many).max() < 0.003
