"""What stage keyframes may do besides moving roots: turn bodies, bring feet to their surface; and what the picture
keeps it from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from keyframe_problem import optimize, quality, root_m, scene
from synthetic import body_vertices, planted_walk, rotation, side_camera, with_root_shift

from video2anim.body.anny_body import shaped_body
from video2anim.body.leg_ik import LEGS, move_ankles
from video2anim.body.skeleton import JOINT_INDEX, forward_kinematics
from video2anim.cli.compose import pipeline_nodes
from video2anim.errors import UsageError
from video2anim.fitting.keyframe_legs import PlantedFeet, plant_feet
from video2anim.fitting.keyframe_moves import RootMoves, turned_about_y
from video2anim.fitting.keyframe_points import SkinSample
from video2anim.fitting.keyframe_sight import sight_of
from video2anim.geometry.sdf import SdfGrid
from video2anim.pipeline.config import resolve
from video2anim.types import BodyMotion, SceneModel

FRAMES = 41
RIGHT = LEGS[1]
WRISTS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]
FEET = [joint for leg in LEGS for joint in (leg.ankle, leg.toe)]


def standing(*, bent_m: float = 0.04, frames: int = FRAMES) -> BodyMotion:
    """Somebody who stands still at the origin, facing +Z, arms 40 degrees forward from the T-pose, soles on the floor;
    knees so far bent that the root is lower by `bent_m`. The camera looks along -X."""
    walk = planted_walk(frames)
    rest = walk.rest_joints_m
    R_parent_joint = np.tile(np.eye(3), (frames, 22, 1, 1))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        R_parent_joint[:, JOINT_INDEX[f"{side}_shoulder"]] = rotation("y", np.full(frames, sign * np.deg2rad(40)))
    body = shaped_body(walk.shape)
    sole_m = float(body.vertices(np.tile(np.eye(3), (1, 22, 1, 1)), rest[None])[..., 1].min())
    translation_m = np.tile([0.0, -sole_m - bent_m, 0.0], (frames, 1))
    for leg in LEGS:
        ankle_m = np.tile(rest[leg.ankle] - [0.0, sole_m, 0.0], (frames, 1))
        R_parent_joint = move_ankles(R_parent_joint, translation_m, rest, leg, ankle_m)
    contact = np.zeros((frames, 22))
    contact[:, FEET] = 1.0
    T_world_camera = np.tile(side_camera(0.0), (frames, 1, 1))
    still = replace(walk, contact=contact, T_world_camera=T_world_camera)
    return still.with_pose(translation_world_m=translation_m, R_parent_joint=R_parent_joint)


def turned(motion: BodyMotion, yaw_rad: float) -> BodyMotion:
    """The motion turned about its roots."""
    frames = motion.frame_count
    return RootMoves(np.zeros((frames, 3)), np.full(frames, yaw_rad)).apply(motion)


def yaw_of(motion: BodyMotion) -> np.ndarray:
    """Heading of the root's z axis (T,), positive from +Z to +X."""
    return np.arctan2(motion.R_parent_joint[:, 0, 0, 2], motion.R_parent_joint[:, 0, 2, 2])


def leaning() -> tuple[BodyMotion, SceneModel]:
    """Somebody whose hands touch a wall in front of him, half a meter to either side."""
    motion = standing()
    contact = motion.contact.copy()
    contact[:, WRISTS] = 1.0
    motion = replace(motion, contact=contact)
    wall_m = float(body_vertices(motion)[0, :, 2].max())
    return motion, scene(box_at_m=(0.0, 1.0, wall_m + 0.5), size_m=(3.0, 2.0, 1.0))


def planted(motion: BodyMotion, where: SceneModel, keyframes: np.ndarray, limit_m: float = 0.1) -> PlantedFeet:
    skin = SkinSample(shaped_body(motion.shape), spread=100, per_part=100).on(motion)
    grid = SdfGrid(where.sdf_m, where.sdf_origin_m, where.sdf_spacing_m)
    return plant_feet(motion, keyframes, skin, grid, contact_threshold=0.5, contact_points=5, limit_m=limit_m)


def step_under_right_foot(motion: BodyMotion, height_m: float) -> SceneModel:
    """A floor and a step whose top is so high, under the right foot alone; it goes on below the floor, where a union of
    distance fields would else show a surface."""
    z_m = motion.joints_world_m[0, RIGHT.ankle, 2]
    return scene(box_at_m=(-0.5, 0.5 * height_m - 0.15, z_m), size_m=(1.0, height_m + 0.3, 0.8))


def sole_height_m(motion: BodyMotion, leg: int) -> np.ndarray:
    """Height (T,) of the mean of a foot's five lowest vertices."""
    parts = shaped_body(motion.shape).vertex_part
    foot = np.isin(parts, (LEGS[leg].ankle, LEGS[leg].toe))
    return np.sort(body_vertices(motion)[:, foot, 1], axis=1)[:, :5].mean(axis=1)


@pytest.mark.parametrize("wrong_deg", [-8.0, 8.0])
def test_a_wrong_turn_is_found_by_the_hands_on_a_wall(wrong_deg: float) -> None:
    truth, wall = leaning()
    raw = turned(truth, np.deg2rad(wrong_deg))
    done, ctx = optimize(raw, wall, yaw=True)
    found = done.people[0]
    left_deg = np.rad2deg(yaw_of(found))
    assert np.abs(left_deg).max() < 0.25 * abs(wrong_deg)
    np.testing.assert_allclose(quality(ctx, "turn mean"), abs(wrong_deg), rtol=0.25)
    np.testing.assert_array_equal(found.R_parent_joint[:, 1:], raw.R_parent_joint[:, 1:])
    _, root_only = optimize(raw, wall)
    assert quality(ctx, "contact distance after") < 0.5 * quality(root_only, "contact distance after")
    assert quality(ctx, "penetration max after") < 0.5 * quality(root_only, "penetration max after")


def test_a_wrong_turn_that_changes_is_followed_without_a_pop() -> None:
    truth, wall = leaning()
    wrong_rad = np.deg2rad(8.0) * np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES)
    raw = RootMoves(np.zeros((FRAMES, 3)), wrong_rad).apply(truth)
    done, _ = optimize(raw, wall, yaw=True)
    left_rad = yaw_of(done.people[0])
    assert np.abs(left_rad).max() < 0.5 * np.abs(wrong_rad).max()
    assert np.abs(np.diff(left_rad)).max() < np.abs(np.diff(wrong_rad)).max()


def test_points_and_motions_turn_alike() -> None:
    motion = planted_walk(3)
    found = turned_about_y(motion.joints_world_m, motion.joints_world_m[:, :1], np.full((3, 1, 1), 0.3))
    np.testing.assert_allclose(turned(motion, 0.3).joints_world_m, found, atol=1e-9)
    np.testing.assert_allclose(yaw_of(turned(motion, 0.3)) - yaw_of(motion), 0.3)


def test_where_neither_turn_nor_leg_matters_both_change_nothing() -> None:
    truth = planted_walk(FRAMES)
    plain, _ = optimize(truth, scene())
    np.testing.assert_array_equal(plain.people[0].R_parent_joint, truth.R_parent_joint)
    legs, ctx = optimize(truth, scene(), leg_ik=True)
    assert quality(ctx, "feet brought to their surface") == 0
    np.testing.assert_array_equal(root_m(legs.people[0]), root_m(plain.people[0]))
    np.testing.assert_array_equal(legs.people[0].R_parent_joint, truth.R_parent_joint)
    yaw, _ = optimize(truth, scene(), yaw=True)
    assert np.abs(root_m(yaw.people[0]) - root_m(plain.people[0])).max() < 0.002
    assert np.rad2deg(np.abs(yaw_of(yaw.people[0]) - yaw_of(truth))).max() < 0.5


def test_a_foot_inside_a_step_is_put_on_it() -> None:
    motion = standing(frames=101)
    contact = motion.contact.copy()
    outside = np.ones(101, bool)
    outside[38:63] = False
    contact[np.ix_(outside, [RIGHT.ankle, RIGHT.toe])] = 0.0
    motion = replace(motion, contact=contact)
    keyframes = np.arange(0, 101, 5)
    found = planted(motion, step_under_right_foot(motion, 0.06), keyframes)
    done = found.motion
    assert (found.moved, found.left) == (5, 0)
    np.testing.assert_allclose(sole_height_m(done, 1)[40:61], 0.06, atol=0.004)
    np.testing.assert_allclose(sole_height_m(done, 0), sole_height_m(motion, 0), atol=1e-6)
    bones_m = np.linalg.norm(np.diff(done.joints_world_m[:, [RIGHT.hip, RIGHT.knee, RIGHT.ankle]], axis=1), axis=-1)
    before_m = np.linalg.norm(np.diff(motion.joints_world_m[:, [RIGHT.hip, RIGHT.knee, RIGHT.ankle]], axis=1), axis=-1)
    np.testing.assert_allclose(bones_m, before_m, atol=1e-9)
    hip_m, knee_m, ankle_m = (done.joints_world_m[:, joint] for joint in (RIGHT.hip, RIGHT.knee, RIGHT.ankle))
    bend_m = knee_m - 0.5 * (hip_m + ankle_m)
    assert (bend_m[:, 2] > 5 * np.abs(bend_m[:, 0])).all(), "the knee bends forward as before"
    assert bend_m[50, 2] > bend_m[0, 2] + 0.03
    for shown in (motion, done):
        orientation = forward_kinematics(shown.R_parent_joint, root_m(shown), shown.rest_joints_m)[1]
        np.testing.assert_allclose(orientation[:, RIGHT.ankle], np.tile(np.eye(3), (101, 1, 1)), atol=1e-9)
    far = np.r_[0:36, 65:101]
    np.testing.assert_array_equal(done.R_parent_joint[far], motion.R_parent_joint[far])
    touched = [RIGHT.hip, RIGHT.knee, RIGHT.ankle]
    others = np.delete(np.arange(22), touched)
    np.testing.assert_array_equal(done.R_parent_joint[:, others], motion.R_parent_joint[:, others])
    np.testing.assert_array_equal(root_m(done), root_m(motion))
    assert np.abs(np.diff(ankle_m[:, 1])).max() < 0.02, "6 cm in 5 frames, and no pop"


def test_a_foot_in_the_air_comes_down_as_far_as_its_leg_reaches() -> None:
    lifted_m = 0.05
    bent, straight = (with_root_shift(standing(bent_m=m), np.tile([0, lifted_m, 0], (FRAMES, 1))) for m in (0.1, 0.02))
    keyframes = np.arange(0, FRAMES, 5)
    found = planted(bent, scene(), keyframes)
    assert (found.moved, found.left) == (18, 0)
    np.testing.assert_allclose(sole_height_m(found.motion, 0), 0.0, atol=0.004)
    assert found.largest_m == pytest.approx(lifted_m, abs=0.004)
    found = planted(straight, scene(), keyframes)
    assert (found.moved, found.left, found.largest_m) == (0, 18, 0.0)
    assert found.motion is straight


def test_a_foot_deeper_than_the_limit_is_left_alone() -> None:
    motion = standing()
    where = step_under_right_foot(motion, 0.08)
    keyframes = np.arange(0, FRAMES, 5)
    assert planted(motion, where, keyframes, limit_m=0.1).moved == 9
    found = planted(motion, where, keyframes, limit_m=0.05)
    assert (found.moved, found.left) == (0, 9)
    assert found.motion is motion


def test_keyframes_that_crowd_at_a_gap_make_no_pop() -> None:
    """The last frame before a gap is a keyframe besides the regular one before it; the foot touches in one of them."""
    motion = standing()
    contact = motion.contact.copy()
    contact[21:, [RIGHT.ankle, RIGHT.toe]] = 0.0
    motion = replace(motion, contact=contact)
    done = planted(motion, step_under_right_foot(motion, 0.06), np.array([0, 5, 10, 15, 20, 21, 30, 35, 40])).motion
    assert np.abs(np.diff(done.joints_world_m[:, RIGHT.ankle, 1])).max() < 0.015


def test_the_stage_joins_roots_and_legs() -> None:
    in_front = np.diag([1.0, -1.0, -1.0, 1.0])
    in_front[:3, 3] = [0.0, 1.2, 4.0]
    motion = replace(standing(bent_m=0.08), T_world_camera=np.tile(in_front, (FRAMES, 1, 1)))
    where = step_under_right_foot(motion, 0.06)
    _, root_only = optimize(motion, where)
    done, ctx = optimize(motion, where, leg_ik=True)
    assert quality(root_only, "contact distance after") > 0.015, "one root cannot serve two feet"
    assert quality(ctx, "contact distance after") < 0.005
    assert quality(ctx, "feet left off their surface") == 0
    assert quality(ctx, "penetration max after") < quality(root_only, "penetration max after")
    np.testing.assert_allclose(sole_height_m(done.people[0], 0), 0.0, atol=0.006)
    np.testing.assert_allclose(sole_height_m(done.people[0], 1), 0.06, atol=0.006)


def slab(axis: int, face_m: float) -> SceneModel:
    """A solid as tall as a man, across +Z (2) or +X (0), that ends at a face and reaches half a meter behind it."""
    at_m, size_m = np.array([0.0, 1.0, 0.0]), np.array([2.5, 2.0, 2.5])
    at_m[axis], size_m[axis] = face_m - 0.25, 0.5
    return scene(tuple(at_m), tuple(size_m))


@pytest.mark.parametrize("weight", [100.0, 1e5])
def test_a_solid_beside_the_body_does_not_push_it_off_its_picture(weight: float) -> None:
    motion = standing()
    where = slab(2, 0.05)
    limit_m = 0.05 * np.ptp(shaped_body(motion.shape).rest_vertices_m[:, 1])
    free, told = optimize(motion, where, weight_penetration=weight, picture_limit_ratio=10.0)
    shift_m = root_m(free.people[0]) - root_m(motion)
    assert shift_m[:, 2].min() > limit_m + 0.05, "without a limit it goes"
    assert not any("picture" in warning for warning in told.warnings)
    done, ctx = optimize(motion, where, weight_penetration=weight)
    shift_m = root_m(done.people[0]) - root_m(motion)
    assert np.linalg.norm(shift_m[:, 1:], axis=1).max() < limit_m + 0.001
    assert shift_m[:, 2].min() > 0.9 * limit_m
    assert np.abs(shift_m[:, 0]).max() < 0.05
    assert quality(ctx, "keyframes held in their picture") == 1.0
    assert quality(ctx, "penetration left for the picture") == quality(ctx, "penetration max after") > 0.02
    assert any("from where the picture shows it" in warning for warning in ctx.warnings)


def test_a_solid_behind_the_body_pushes_it_along_the_sight_as_before() -> None:
    motion = standing()
    where = slab(0, 0.05)
    free, _ = optimize(motion, where, picture_limit_ratio=10.0)
    done, ctx = optimize(motion, where)
    shift_m = root_m(done.people[0]) - root_m(motion)
    assert shift_m[:, 0].min() > 0.15, "farther than it may go across"
    assert np.abs(root_m(done.people[0]) - root_m(free.people[0])).max() < 0.005
    assert quality(ctx, "keyframes held in their picture") == 0.0
    assert not any("picture" in warning for warning in ctx.warnings)


def test_the_limit_is_a_share_of_the_body_and_the_error_of_its_landmarks() -> None:
    motion = standing()
    frames = np.array([0, 5])
    sight = sight_of(motion, frames, stature_m=1.7, limit_ratio=0.05, reprojection_px=5.0)
    np.testing.assert_allclose(sight.direction[:, 2], 0.0)
    np.testing.assert_allclose(np.linalg.norm(sight.direction, axis=1), 1.0)
    assert (sight.direction[:, 0] < -0.9).all()
    np.testing.assert_allclose(sight.limit_m, 0.05 * 1.7 + 5.0 * 4.0 / 500.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("option", "value"), [("yaw_lever_m", 0.0), ("leg_ik_limit_m", -0.1), ("picture_limit_ratio", -0.01)]
)
def test_impossible_options_are_named(option: str, value: float) -> None:
    with pytest.raises(UsageError, match=f"keyframes.{option}: want .* got {value:g}"):
        resolve(pipeline_nodes(), "p", [("test", {"keyframes": {option: value}})])
