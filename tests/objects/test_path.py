"""A carried object goes with the hand that has it, and rests where it was put."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import planted_walk, rotation, with_root_shift

from video2anim.geometry.projection import invert_rigid
from video2anim.geometry.scene_mesh import box_mesh
from video2anim.objects.path import BLEND_FRAMES, follow_hand, holding
from video2anim.types import BodyMotion, Hold, ObjectPath, PlacedObject
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

FRAMES = 60
LEFT, RIGHT = JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]
SHIFT_M = np.array([0.05, -0.02, 0.03])


def wrist_poses(motion: BodyMotion, wrist: int) -> np.ndarray:
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m
    )
    T_world_wrist = np.tile(np.eye(4), (motion.frame_count, 1, 1))
    T_world_wrist[:, :3, :3], T_world_wrist[:, :3, 3] = R_world_joint[:, wrist], joints_m[:, wrist]
    return T_world_wrist


def cup(T_world_object: np.ndarray, *holds: Hold) -> PlacedObject:
    path = ObjectPath(T_world_object, holds)
    return PlacedObject(2, "cup", box_mesh(0.1, 0.1, 0.1), 1.0, T_world_object[0], None, None, True, "", path=(path,))


def in_hand(motion: BodyMotion, wrist: int, *holds: Hold) -> PlacedObject:
    """A cup beside a wrist from the first to the last frame held; before and after it rests there."""
    T_wrist_object = np.eye(4)
    T_wrist_object[:3, :3], T_wrist_object[:3, 3] = rotation("z", np.array(0.7)), (0.02, -0.08, 0.05)
    frame = np.clip(np.arange(motion.frame_count), holds[0].first_frame, holds[-1].last_frame)
    return cup(wrist_poses(motion, wrist)[frame] @ T_wrist_object, *holds)


def bent(motion: BodyMotion) -> BodyMotion:
    """Refined: the root is shifted and the arms are turned a little."""
    R_parent_joint = motion.R_parent_joint.copy()
    for name, angle_rad in (("left_shoulder", 0.1), ("right_shoulder", -0.08), ("right_wrist", 0.2)):
        joint = JOINT_INDEX[name]
        R_parent_joint[:, joint] = R_parent_joint[:, joint] @ rotation("x", np.array(angle_rad))
    return motion.with_pose(translation_world_m=motion.T_world_root[:, :3, 3] + SHIFT_M, R_parent_joint=R_parent_joint)


def max_step_m(T_world_object: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(T_world_object[:, :3, 3], axis=0), axis=-1).max())


@pytest.mark.parametrize(("hand", "wrist"), [("left hand", LEFT), ("right hand", RIGHT)])
def test_it_keeps_its_pose_in_the_hand_and_rests_where_it_rested(hand: str, wrist: int) -> None:
    before = planted_walk(FRAMES)
    after = bent(before)
    item = in_hand(before, wrist, Hold(before.person_id, hand, 20, 45))
    moved = follow_hand(item, (before,), (after,))
    T_before, T = item.path[0].T_world_object, moved.path[0].T_world_object
    T_hand_object = invert_rigid(wrist_poses(before, wrist)) @ T_before
    inside = slice(20 + BLEND_FRAMES, 46 - BLEND_FRAMES)
    np.testing.assert_allclose(wrist_poses(after, wrist)[inside] @ T_hand_object[inside], T[inside], atol=1e-9)
    assert np.linalg.norm(T[30, :3, 3] - T_before[30, :3, 3]) > 0.02
    for rest in (slice(0, 20), slice(46, None)):
        np.testing.assert_array_equal(T[rest], T_before[rest])
    np.testing.assert_array_equal(moved.T_world_object, T[0])
    np.testing.assert_allclose(
        T[:, :3, :3].swapaxes(1, 2) @ T[:, :3, :3], np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-9
    )
    off_m = np.linalg.norm(T[:, :3, 3] - T_before[:, :3, 3], axis=-1).max()
    assert max_step_m(T) < max_step_m(T_before) + 0.4 * off_m, "it goes over in some frames"
    assert moved.holds == item.holds


def test_a_hold_of_the_whole_clip_has_no_place_to_come_from() -> None:
    before = planted_walk(FRAMES)
    item = in_hand(before, LEFT, Hold(before.person_id, "left hand", 0, FRAMES - 1))
    moved = follow_hand(item, (before,), (with_root_shift(before, np.tile(SHIFT_M, (FRAMES, 1))),))
    way_m = moved.path[0].T_world_object[:, :3, 3] - item.path[0].T_world_object[:, :3, 3]
    np.testing.assert_allclose(way_m, np.tile(SHIFT_M, (FRAMES, 1)), atol=1e-9)
    np.testing.assert_array_equal(moved.T_world_object, moved.path[0].T_world_object[0])


def test_a_hold_shorter_than_going_over_does_not_jump() -> None:
    before = planted_walk(FRAMES)
    item = in_hand(before, LEFT, Hold(before.person_id, "left hand", 30, 33))
    moved = follow_hand(item, (before,), (bent(before),))
    T_before, T = item.path[0].T_world_object, moved.path[0].T_world_object
    np.testing.assert_array_equal(np.delete(T, np.s_[30:34], 0), np.delete(T_before, np.s_[30:34], 0))
    assert np.abs(T[30:34] - T_before[30:34]).max() > 0.001
    assert max_step_m(T) < max_step_m(T_before) + 0.03


def test_from_hand_to_hand_it_does_not_go_back_between() -> None:
    before = planted_walk(FRAMES)
    after = with_root_shift(before, np.tile(SHIFT_M, (FRAMES, 1)))
    holds = (Hold(before.person_id, "left hand", 10, 29), Hold(before.person_id, "right hand", 30, 50))
    moved = follow_hand(in_hand(before, LEFT, *holds), (before,), (after,))
    way_m = moved.path[0].T_world_object[:, :3, 3] - in_hand(before, LEFT, *holds).path[0].T_world_object[:, :3, 3]
    np.testing.assert_allclose(way_m[15:46], np.tile(SHIFT_M, (31, 1)), atol=1e-9)
    assert np.abs(np.diff(way_m, axis=0)).max() < 0.4 * np.abs(SHIFT_M).max()


def test_with_both_hands_it_follows_their_middle_and_turns_with_them_about_the_vertical() -> None:
    before = planted_walk(FRAMES)
    R_parent_joint = before.R_parent_joint.copy()
    R_parent_joint[:, 0] = rotation("y", np.array(0.3)) @ R_parent_joint[:, 0]
    R_parent_joint[:, RIGHT] = R_parent_joint[:, RIGHT] @ rotation("x", np.array(0.5))
    after = before.with_pose(translation_world_m=before.T_world_root[:, :3, 3] + SHIFT_M, R_parent_joint=R_parent_joint)
    T_world_object = np.tile(np.eye(4), (FRAMES, 1, 1))
    T_world_object[:, :3, 3] = before.joints_world_m[:, [LEFT, RIGHT]].mean(1) + np.array([0.0, -0.1, 0.2])
    item = cup(T_world_object, Hold(before.person_id, "both hands", 0, FRAMES - 1))
    T = follow_hand(item, (before,), (after,)).path[0].T_world_object
    turn = rotation("y", np.array(0.3))
    np.testing.assert_allclose(T[:, :3, :3], np.tile(turn, (FRAMES, 1, 1)), atol=1e-6)
    expected_m = after.joints_world_m[:, [LEFT, RIGHT]].mean(1) + turn @ [0.0, -0.1, 0.2]
    np.testing.assert_allclose(T[:, :3, 3], expected_m, atol=1e-6)


def test_it_stays_with_bodies_that_stay_and_without_the_one_who_has_it() -> None:
    before = planted_walk(FRAMES)
    item = in_hand(before, LEFT, Hold(before.person_id, "left hand", 20, 45))
    same = follow_hand(item, (before,), (before,))
    np.testing.assert_allclose(same.path[0].T_world_object, item.path[0].T_world_object, atol=1e-9)
    other = replace(before, person_id=before.person_id + 1)
    np.testing.assert_array_equal(
        follow_hand(item, (other,), (bent(other),)).path[0].T_world_object, item.path[0].T_world_object
    )
    still = replace(item, path=())
    assert follow_hand(still, (before,), (bent(before),)) is still


def test_hands_that_hold_something_are_known() -> None:
    motion = planted_walk(FRAMES)
    own = (Hold(motion.person_id, "left hand", 3, 5), Hold(motion.person_id, "both hands", 10, 12))
    items = (in_hand(motion, LEFT, *own), in_hand(motion, LEFT, Hold(motion.person_id + 1, "left hand", 20, 22)))
    held = holding(items, motion)
    assert sorted(map(tuple, np.argwhere(held).tolist())) == sorted(
        [(frame, LEFT) for frame in (3, 4, 5, 10, 11, 12)] + [(frame, RIGHT) for frame in (10, 11, 12)]
    )
