"""Hands in pictures, and which of them takes or puts down what changes there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from seen_boxes import LENS
from synthetic import planted_walk

from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.objects.changes import Change
from video2anim.objects.hands import NEAR_M, Grip, HandPath, gaps_m, grip, hands_of, holders, reach
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

FRAMES, STEP = 200, 5
DEPTH_M = 3.0
NEAR_PX = NEAR_M * LENS.fx_px / DEPTH_M
FAR_AWAY = (20.0, 20.0)
BOX = (slice(120, 140), slice(150, 170))


def turned(yaw_rad: np.ndarray) -> np.ndarray:
    """About the vertical."""
    return matrix_from_axis_angle(np.reshape(yaw_rad, (-1, 1)) * np.array([0.0, 1.0, 0.0]))


def hand(
    pixels: np.ndarray | tuple[float, float], name: str = "right hand", person_id: int = 1, depth_m: float = DEPTH_M
) -> HandPath:
    """A hand of known place in the pictures of a camera at the world's origin."""
    pixels = np.array(np.broadcast_to(np.asarray(pixels, float), (FRAMES, 2)))
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, :2, 3] = (pixels - [LENS.cx_px, LENS.cy_px]) * depth_m / LENS.fx_px
    T[:, 2, 3] = depth_m
    return HandPath(person_id, name, T, pixels, np.full(FRAMES, depth_m), np.ones(FRAMES, bool))


def change(first: int = 20, last: int = 22, *, came: bool = False) -> Change:
    mask = np.zeros((LENS.height_px, LENS.width_px), bool)
    mask[BOX] = True
    return Change(mask, first, last, came, np.zeros((*mask.shape, 3), np.uint8))


def visit(
    first: int, last: int, above_px: float = 5.0, *, name: str = "right hand", person_id: int = 1, depth_m: float = 3.0
) -> HandPath:
    """A hand that is so far above the box from one frame to another, and else far away."""
    pixels = np.tile(FAR_AWAY, (FRAMES, 1))
    pixels[first : last + 1] = (160.0, BOX[0].start - above_px)
    return hand(pixels, name, person_id, depth_m)


def together(gap_m: np.ndarray | float, yaw_rad: np.ndarray | float = 0.0) -> tuple[HandPath, HandPath]:
    """Left and right hand so far apart, around a common middle that moves."""
    center_m = np.stack([np.linspace(-0.5, 0.5, FRAMES), np.zeros(FRAMES), np.full(FRAMES, DEPTH_M)], -1)
    across = turned(np.broadcast_to(yaw_rad, FRAMES))[:, :, 0] * np.reshape(gap_m, (-1, 1))
    made = []
    for name, side in (("left hand", -0.5), ("right hand", 0.5)):
        T = np.tile(np.eye(4), (FRAMES, 1, 1))
        T[:, :3, 3] = center_m + side * across
        made.append(HandPath(1, name, T, project(T[:, :3, 3], LENS), T[:, 2, 3], np.ones(FRAMES, bool)))
    return made[0], made[1]


def grip_of(*hands: HandPath, at: int = 0, came: bool = False) -> Grip:
    return Grip(change(came=came), 1, {one.name: one for one in hands}, {one.name: at for one in hands})


def test_hands_are_beyond_the_wrists_and_where_the_camera_sees_them() -> None:
    motion = planted_walk(60)
    motion = replace(motion, valid=np.arange(60) != 7)
    lens = motion.intrinsics.resized(320, 180)
    left, right = hands_of(motion, lens)
    _, R = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    for found, side in ((left, "left"), (right, "right")):
        assert (found.name, found.person_id) == (f"{side} hand", motion.person_id)
        center_m = found.T_world_hand[:, :3, 3]
        wrist_m, elbow_m = (motion.joints_world_m[:, JOINT_INDEX[f"{side}_{name}"]] for name in ("wrist", "elbow"))
        beyond_m = np.linalg.norm(center_m - wrist_m, axis=-1)
        assert (np.abs(beyond_m - 0.09) < 0.03).all()
        np.testing.assert_allclose(
            np.linalg.norm(center_m - elbow_m, axis=-1),
            beyond_m + np.linalg.norm(wrist_m - elbow_m, axis=-1),
            atol=1e-5,
        )
        np.testing.assert_allclose(found.T_world_hand[:, :3, :3], R[:, JOINT_INDEX[f"{side}_wrist"]], atol=1e-6)
        camera_m = transform_points(invert_rigid(motion.T_world_camera), center_m[:, None])[:, 0]
        np.testing.assert_allclose(found.depth_m, camera_m[:, 2], atol=1e-9)
        np.testing.assert_allclose(found.pixels[found.valid], project(camera_m, lens)[found.valid], atol=1e-6)
        np.testing.assert_array_equal(found.valid, motion.valid)
    assert (left.depth_m < right.depth_m).all(), "the camera is to the body's left"


def test_a_hand_behind_the_camera_is_not_seen() -> None:
    motion = planted_walk(10)
    T_world_camera = motion.T_world_camera.copy()
    T_world_camera[:, 0, 3] = 0.0
    left, right = hands_of(replace(motion, T_world_camera=T_world_camera), motion.intrinsics)
    assert not left.valid.any()
    assert right.valid.all()


def test_reach_covers_the_hand_and_three_hands_around_it() -> None:
    one, other = hand((60.0, 120.0)), hand((220.0, 120.0), depth_m=2 * DEPTH_M)
    covered = reach([one, other], LENS)
    assert covered.shape == (LENS.height_px, LENS.width_px)
    row, column = np.mgrid[: LENS.height_px, : LENS.width_px]
    for x, radius in ((60, 3 * NEAR_PX), (220, 1.5 * NEAR_PX)):
        away = np.hypot(row - 120, column - x)
        assert covered[away < radius - 2].all()
        assert not covered[(away > radius + 2) & (np.abs(column - x) < 80)].any()


def test_reach_follows_the_hand_where_it_is_seen() -> None:
    moving = hand(np.stack([np.linspace(-60.0, 500.0, FRAMES), np.full(FRAMES, 100.0)], -1))
    assert reach([moving], LENS)[100].all()
    hidden = replace(moving, valid=np.zeros(FRAMES, bool))
    assert not reach([hidden], LENS).any()
    assert not reach([hand((-500.0, 100.0))], LENS).any()
    assert not reach([], LENS).any()


def test_gaps_are_lengths_at_the_hand_s_distance() -> None:
    mask = change().mask
    found = gaps_m(visit(10, 20, above_px=30.0), mask, LENS)
    np.testing.assert_allclose(found[10:21], 30.0 * DEPTH_M / LENS.fx_px, rtol=0.05)
    np.testing.assert_allclose(gaps_m(hand((160.0, 130.0)), mask, LENS), 0.0)
    assert np.isinf(gaps_m(hand((160.0, -30.0)), mask, LENS)).all()
    unseen = replace(hand((160.0, 130.0)), valid=np.zeros(FRAMES, bool))
    assert np.isinf(gaps_m(unseen, mask, LENS)).all()


def test_the_nearest_hand_comes_first() -> None:
    hands = [visit(95, 112, above, name=name) for above, name in ((12.0, "left hand"), (2.0, "right hand"))]
    for order in (hands, hands[::-1]):
        found = grip(change(), order, STEP, LENS)
        assert found is not None
        assert list(found.hands) == ["right hand", "left hand"]
        assert found.hands["right hand"] is hands[1]
        assert found.person_id == 1


@pytest.mark.parametrize(("came", "frame"), [(False, 109), (True, 102)])
def test_it_is_taken_when_the_hand_leaves_and_put_down_when_it_comes(came: bool, frame: int) -> None:
    found = grip(change(20, 22, came=came), [visit(102, 109)], STEP, LENS)
    assert found is not None
    assert found.frames == {"right hand": frame}
    assert found.frame("right hand") == frame
    assert found.frame("left hand") == frame, "of a hand that is not near: when the nearest does it"


def test_no_hand_is_near_beyond_a_hand_s_length() -> None:
    assert grip(change(), [visit(95, 112, NEAR_PX - 2)], STEP, LENS) is not None
    assert grip(change(), [visit(95, 112, NEAR_PX + 2)], STEP, LENS) is None
    # The same pixels are a longer way at twice the distance.
    assert grip(change(), [visit(95, 112, 0.6 * NEAR_PX, depth_m=2 * DEPTH_M)], STEP, LENS) is None
    assert grip(change(), [], STEP, LENS) is None


@pytest.mark.parametrize(("first", "last", "near"), [(40, 70, False), (140, 190, False), (60, 100, True)])
def test_a_hand_that_is_there_at_another_time_did_nothing(first: int, last: int, near: bool) -> None:
    """The change is between frames 100 and 110."""
    assert (grip(change(20, 22), [visit(first, last)], STEP, LENS) is not None) == near


def test_a_change_at_the_end_of_the_clip_or_its_start_has_a_hand() -> None:
    last = FRAMES // STEP - 1
    for moment, frame in (((0, 1), 0), ((last - 1, last), FRAMES - 1)):
        found = grip(change(*moment), [visit(frame, frame)], STEP, LENS)
        assert found is not None
        assert found.frames == {"right hand": frame}


def test_the_nearest_person_takes_it() -> None:
    hands = [visit(95, 112, above, name=name, person_id=person) for above, name, person in (
        (9.0, "left hand", 1), (12.0, "right hand", 1), (3.0, "left hand", 2), (15.0, "right hand", 2),
    )]  # fmt: skip
    found = grip(change(), hands, STEP, LENS)
    assert found is not None
    assert found.person_id == 2
    assert {name: one.person_id for name, one in found.hands.items()} == {"left hand": 2, "right hand": 2}


def test_both_hands_hold_it_together_where_they_keep_their_distance() -> None:
    yaw_rad = np.linspace(0.0, 1.0, FRAMES)
    left, right = together(0.4 + 0.01 * np.sin(np.arange(FRAMES)), yaw_rad)
    found = holders([grip_of(left, right), grip_of(left, right, came=True)], 20, 150)
    assert list(found) == ["both hands"]
    both = found["both hands"]
    assert (both.name, both.person_id) == ("both hands", 1)
    center_m = 0.5 * (left.T_world_hand + right.T_world_hand)[:, :3, 3]
    np.testing.assert_allclose(both.T_world_hand[:, :3, 3], center_m, atol=1e-9)
    np.testing.assert_allclose(both.T_world_hand[:, :3, :3], turned(yaw_rad), atol=1e-6)
    np.testing.assert_allclose(both.depth_m, center_m[:, 2], atol=1e-9)
    np.testing.assert_allclose(both.pixels, project(center_m, LENS), atol=1.0)


def test_hands_whose_distance_changes_hold_it_one_or_the_other() -> None:
    left, right = together(0.4 + 0.15 * np.sin(np.arange(FRAMES) / 15))
    found = holders([grip_of(left, right)], 20, 150)
    assert set(found) == {"left hand", "right hand"}
    assert found["left hand"] is left
    assert found["right hand"] is right


def test_only_the_stretch_of_the_hold_counts() -> None:
    gap_m = np.full(FRAMES, 0.4)
    gap_m[:50] = np.linspace(1.5, 0.4, 50)
    left, right = together(gap_m)
    assert list(holders([grip_of(left, right)], 50, 150)) == ["both hands"]
    assert set(holders([grip_of(left, right)], 0, 150)) == {"left hand", "right hand"}


def test_a_hand_that_is_near_at_one_end_alone_holds_it_alone() -> None:
    left, right = together(0.4)
    for grips in ([grip_of(left, right), grip_of(right, came=True)], [grip_of(left), grip_of(right, came=True)]):
        assert set(holders(grips, 20, 150)) == {"left hand", "right hand"}
    assert list(holders([grip_of(right)], 20, 150)) == ["right hand"]
