"""What a body rests on where the scene has nothing, and where a motion touches its scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import planted_walk, rotation

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import believed, on_own_body, posed_vertices, touches
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.scene.supports import Support, rested_places, standing_solid
from video2anim.types import BodyMotion, Mesh
from video2anim.types.skeleton import FEET, JOINT_INDEX, TOUCHING_PARTS

FRAMES = 60
PELVIS, SPINE, WRIST = (JOINT_INDEX[name] for name in ("pelvis", "spine3", "left_wrist"))
SITTING = {"left_hip": -1.5, "right_hip": -1.5, "left_knee": 1.5, "right_knee": 1.5}


def still(turned_rad: dict[str, float], *, pelvis_m: float = 0.9, z_m: float = 0.0) -> BodyMotion:
    """A T-pose with some joints turned about x, at rest, nothing in contact; the pelvis at a height."""
    walk = planted_walk(FRAMES)
    R_parent_joint = np.tile(np.eye(3), (FRAMES, 22, 1, 1))
    for name, angle_rad in turned_rad.items():
        R_parent_joint[:, JOINT_INDEX[name]] = rotation("x", np.full(FRAMES, angle_rad))
    posed = walk.with_pose(
        translation_world_m=np.tile([0.0, pelvis_m, z_m], (FRAMES, 1)), R_parent_joint=R_parent_joint
    )
    return replace(posed, contact=np.zeros((FRAMES, 22)))


def touching(motion: BodyMotion, joint: int, frames: slice = slice(None)) -> BodyMotion:
    contact = motion.contact.copy()
    contact[frames, joint] = 1.0
    return replace(motion, contact=contact)


def after_each_other(*motions: BodyMotion) -> BodyMotion:
    first = planted_walk(FRAMES * len(motions))
    moved = first.with_pose(
        translation_world_m=np.concatenate([one.T_world_root[:, :3, 3] for one in motions]),
        R_parent_joint=np.concatenate([one.R_parent_joint for one in motions]),
    )
    return replace(moved, contact=np.concatenate([one.contact for one in motions]))


def found_of(motion: BodyMotion) -> list[Support]:
    return rested_places(motion, shaped_body(motion.shape))


def solid_of(support: Support, motion: BodyMotion) -> Mesh | None:
    made = standing_solid(support, [(motion, shaped_body(motion.shape))])
    return None if made is None else world_mesh(*made, 1.0)


def placed_at(x_m: float, z_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[[0, 2], 3] = x_m, z_m
    return pose


def skin_m(motion: BodyMotion, joint: int) -> np.ndarray:
    body = shaped_body(motion.shape)
    return posed_vertices(motion, body, np.flatnonzero(body.vertex_part == joint), np.array([0]))[0]


def test_somebody_who_sits_on_air_gets_a_seat_down_to_the_floor() -> None:
    motion = touching(still(SITTING, pelvis_m=0.6), PELVIS)
    (seat,) = found_of(motion)
    lowest_m = skin_m(motion, PELVIS)[:, 1].min()
    assert (seat.kind, seat.level, len(seat.nearest_m)) == ("seat", True, FRAMES)
    assert seat.carries
    assert seat.top_m == pytest.approx(lowest_m, abs=0.01)
    solid = solid_of(seat, motion)
    assert solid is not None
    assert solid.vertices_m[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    assert solid.vertices_m[:, 1].max() == pytest.approx(lowest_m, abs=0.01)


def test_a_seat_rests_on_tops_not_beside_sides() -> None:
    """A post beside the skin carries nobody, so the floor is nearest; a box under it does, be it 2 cm too high."""
    motion = touching(still(SITTING, pelvis_m=0.6), PELVIS)
    (seat,) = found_of(motion)
    x_m, low_m, z_m = seat.nearest_m.mean(0)
    post, box = (
        world_mesh(box_mesh(width_m, height_m, width_m), placed_at(x_m + way_m, z_m), 1.0)
        for width_m, height_m, way_m in ((0.1, 2.0, 0.12), (0.6, low_m + 0.02, 0.0))
    )
    beside_m, on_m, both_m = (seat.gaps_m(solids, reach_m=0.3) for solids in ([post], [box], [post, box]))
    np.testing.assert_allclose(beside_m, low_m, atol=0.01)
    np.testing.assert_allclose(on_m, -0.02, atol=0.005)
    np.testing.assert_allclose(both_m, on_m, atol=0.005)


def test_sitting_down_twice_at_one_place_is_one_seat_and_far_away_another() -> None:
    sits = touching(still(SITTING, pelvis_m=0.6), PELVIS)
    stands, aside = still({}), touching(still(SITTING, pelvis_m=0.6, z_m=3.0), PELVIS)
    # Two frames beside each change of place are not at rest.
    assert [len(one.nearest_m) for one in found_of(after_each_other(sits, stands, sits))] == [2 * FRAMES - 4]
    assert [len(one.nearest_m) for one in found_of(after_each_other(sits, stands, aside))] == [FRAMES - 2] * 2


def test_legs_that_go_under_the_seat_leave_a_slab() -> None:
    drawn_back = still({**SITTING, "left_knee": 2.3, "right_knee": 2.3}, pelvis_m=0.6)
    motion = touching(drawn_back, PELVIS)
    (seat,) = found_of(motion)
    solid = solid_of(seat, motion)
    assert solid is not None
    assert np.ptp(solid.vertices_m[:, 1]) == pytest.approx(0.1, abs=1e-6)


def test_where_the_body_passes_there_is_no_seat() -> None:
    aside = still({})
    leg_m = aside.rest_joints_m[JOINT_INDEX["left_hip"], 0]
    aside = aside.with_pose(
        translation_world_m=aside.T_world_root[:, :3, 3] - [leg_m, 0.0, 0.0], R_parent_joint=aside.R_parent_joint
    )
    motion = after_each_other(touching(still(SITTING, pelvis_m=0.6), PELVIS), aside)
    (seat,) = found_of(motion)
    assert solid_of(seat, motion) is None


def test_a_back_leans_on_what_is_behind_it_but_is_not_carried() -> None:
    motion = touching(still({"pelvis": -0.3}), SPINE)
    (rest,) = found_of(motion)
    normal = rest.T_world_top[:3, 1]
    assert not rest.level
    assert not rest.carries
    np.testing.assert_allclose(normal, [0.0, np.sin(0.3), np.cos(0.3)], atol=1e-6)
    ahead_m = skin_m(motion, SPINE) @ normal
    assert rest.T_world_top[:3, 3] @ normal == pytest.approx(ahead_m.min(), abs=0.01)


def test_a_palm_that_looks_down_rests_on_something_level() -> None:
    motion = touching(still({}), WRIST)
    (rest,) = found_of(motion)
    assert (rest.kind, rest.level, rest.carries) == ("left hand", True, False)
    assert rest.top_m == pytest.approx(skin_m(motion, WRIST)[:, 1].min(), abs=0.01)


def test_flickers_and_flying_parts_rest_on_nothing() -> None:
    sits = still(SITTING, pelvis_m=0.6)
    flickers = replace(sits, contact=sits.contact.copy())
    flickers.contact[np.arange(FRAMES) % 8 < 5, PELVIS] = 1.0
    way_m = np.outer(np.arange(FRAMES) / 30, [0.0, 0.0, 1.5])
    flies = touching(
        sits.with_pose(translation_world_m=sits.T_world_root[:, :3, 3] + way_m, R_parent_joint=sits.R_parent_joint),
        PELVIS,
    )
    assert found_of(flickers) == []
    assert found_of(flies) == []
    assert believed(flies, shaped_body(flies.shape)).max() == 0.0


def test_a_hand_on_the_own_body_touches_nothing_else() -> None:
    hanging = still({})
    R_parent_joint = hanging.R_parent_joint.copy()
    R_parent_joint[:, JOINT_INDEX["left_shoulder"]] = rotation("z", np.full(FRAMES, -1.65))
    hanging = hanging.with_pose(translation_world_m=hanging.T_world_root[:, :3, 3], R_parent_joint=R_parent_joint)
    motion, spread = touching(hanging, WRIST), touching(still({}), WRIST)
    body, frames = shaped_body(motion.shape), np.arange(FRAMES)
    assert on_own_body(motion, body, WRIST, frames).all()
    assert not on_own_body(spread, body, WRIST, frames).any()
    assert found_of(motion) == []
    assert believed(spread, body)[:, WRIST].min() == 1.0


@pytest.mark.parametrize(("over_m", "stands"), [(0.02, True), (0.06, False)])
def test_a_motion_touches_where_it_is_near_and_slow_and_the_picture_says_so(over_m: float, stands: bool) -> None:
    walk = planted_walk(90)
    root_m = walk.T_world_root[:, :3, 3] + [0.0, over_m, 0.0]
    motion = walk.with_pose(translation_world_m=root_m, R_parent_joint=walk.R_parent_joint)
    body = shaped_body(motion.shape)
    floor = build_sdf_grid([], np.array([[-2.0, -0.5, -2.0], [2.0, 2.0, 6.0]]), 0.1)
    found = touches(motion, body, floor, walk.contact)
    feet = list(FEET)
    planted = walk.contact[:, feet] > 0.5
    assert (found[:, feet] > 0.5)[~planted].sum() == 0
    assert ((found[:, feet] > 0.5)[planted].mean() > 0.6) == stands
    assert found[:, [j for joints in TOUCHING_PARTS.values() for j in joints if j not in feet]].max() == 0.0


def test_feet_that_nobody_saw_stand_where_they_are_near_and_slow() -> None:
    walk = planted_walk(90)
    hidden = replace(walk, valid=np.zeros(90, bool), contact=np.zeros((90, 22)))
    floor = build_sdf_grid([], np.array([[-2.0, -0.5, -2.0], [2.0, 2.0, 6.0]]), 0.1)
    found = touches(hidden, shaped_body(walk.shape), floor, hidden.contact)[:, list(FEET)] > 0.5
    planted = walk.contact[:, list(FEET)] > 0.5
    assert (found & planted).sum() > 0.6 * planted.sum()
    assert (found & ~planted).sum() < 0.2 * planted.sum()
