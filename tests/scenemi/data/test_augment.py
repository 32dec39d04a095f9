"""Mirroring, warping, resampling, balance."""

from __future__ import annotations

import numpy as np
import pytest

from scenemi.data.augment import (
    STYLE_PARTS,
    WarpConfig,
    at_times,
    cropped,
    mirrored,
    random_times,
    resampled,
    restyled,
)
from scenemi.data.balance import BalanceConfig, clip_probabilities
from scenemi.data.interpolate import blended, cubic_taps
from scenemi.data.retarget import RetargetedMotion, retarget
from scenemi.data.source_clip import SourceClip
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, MIRROR_JOINT, forward_kinematics

FLIP = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def body() -> ShapedBody:
    return shaped_body(BodyShape("anny", dict(ADULT)))


@pytest.fixture(scope="module")
def walk(smpl_walk: SourceClip, body: ShapedBody) -> RetargetedMotion:
    return retarget(smpl_walk, body)


def joints(motion: RetargetedMotion, rest_joints_m: np.ndarray) -> np.ndarray:
    return forward_kinematics(motion.R_parent_joint, motion.translation_m, rest_joints_m)[0]


def test_mirroring_twice_changes_nothing(walk: RetargetedMotion) -> None:
    twice = mirrored(mirrored(walk))
    np.testing.assert_allclose(twice.R_parent_joint, walk.R_parent_joint, atol=1e-15)
    np.testing.assert_allclose(twice.translation_m, walk.translation_m, atol=1e-15)
    np.testing.assert_array_equal(twice.contact, walk.contact)


def test_a_mirrored_motion_is_the_reflection_of_all_joints(walk: RetargetedMotion, body: ShapedBody) -> None:
    rest = body.rest_joints_m
    symmetric = 0.5 * (rest + rest[MIRROR_JOINT] * FLIP)
    twin = mirrored(walk)
    np.testing.assert_allclose(joints(twin, symmetric), joints(walk, symmetric)[:, MIRROR_JOINT] * FLIP, atol=1e-12)
    assert np.abs(joints(twin, rest) - joints(walk, rest)[:, MIRROR_JOINT] * FLIP).max() < 0.02
    left, right = JOINT_INDEX["left_ankle"], JOINT_INDEX["right_ankle"]
    np.testing.assert_array_equal(twin.contact[:, left], walk.contact[:, right])
    np.testing.assert_allclose(np.linalg.det(twin.R_parent_joint), 1.0, atol=1e-9)
    assert [JOINT_NAMES[i] for i in MIRROR_JOINT[:3]] == ["pelvis", "right_hip", "left_hip"]


def test_cubic_taps_reproduce_frames_and_parabolas() -> None:
    count = np.array(20)
    rows, weights = cubic_taps(np.arange(20.0), np.full(20, count))
    values = np.arange(20.0) ** 2
    np.testing.assert_allclose(blended(values, rows, weights), values)
    inner = np.linspace(1.0, 18.0, 57)
    rows, weights = cubic_taps(inner, np.full(57, count))
    np.testing.assert_allclose(blended(values, rows, weights), inner**2, atol=1e-9)
    rows, _ = cubic_taps(np.array([-3.0, 25.0]), np.full(2, count))
    assert rows.min() >= 0
    assert rows.max() <= 19


def test_speeds_stay_in_their_range_and_are_smooth() -> None:
    times = random_times(np.random.default_rng(0), 200, 121)
    speed = np.diff(times, axis=1)
    config = WarpConfig()
    assert speed.min() >= config.slowest - 1e-9
    assert speed.max() <= config.fastest + 1e-9
    assert np.abs(np.diff(speed, axis=1)).max() < 0.02
    assert speed.mean(1).std() > 0.05
    np.testing.assert_array_equal(times[:, 0], 0.0)


def test_a_warp_at_speed_one_is_the_motion_itself(walk: RetargetedMotion) -> None:
    same = at_times(walk, np.arange(len(walk.translation_m), dtype=float))
    np.testing.assert_allclose(same.translation_m, walk.translation_m, atol=1e-12)
    np.testing.assert_allclose(same.R_parent_joint, walk.R_parent_joint, atol=1e-9)
    np.testing.assert_array_equal(same.contact, walk.contact)


def test_resampling_picks_frames_or_interpolates(walk: RetargetedMotion) -> None:
    half = resampled(walk, 60.0)
    np.testing.assert_array_equal(half.translation_m, walk.translation_m[::2])
    back = resampled(resampled(walk, 30.0, 50.0), 50.0)
    frames = min(len(back.translation_m), len(walk.translation_m)) - 2
    np.testing.assert_allclose(back.translation_m[2:frames], walk.translation_m[2:frames], atol=2e-3)
    turn = np.swapaxes(back.R_parent_joint[2:frames], -1, -2) @ walk.R_parent_joint[2:frames]
    assert np.linalg.norm(axis_angle_from_matrix(turn), axis=-1).max() < 0.05
    with pytest.raises(ValueError, match="above 0"):
        resampled(walk, 0.0)


def test_cropping_checks_its_range(walk: RetargetedMotion) -> None:
    np.testing.assert_array_equal(cropped(walk, 3, 9).contact, walk.contact[3:9])
    with pytest.raises(ValueError, match="start < stop"):
        cropped(walk, 5, 5)


def test_power_balances_between_seconds_and_groups() -> None:
    kinds, sources, seconds = ["walk"] * 9 + ["sit"], ["a"] * 10, np.ones(10)
    alike = clip_probabilities(kinds, sources, seconds, BalanceConfig(power=1.0))
    np.testing.assert_allclose(alike, 0.1)
    even = clip_probabilities(kinds, sources, seconds, BalanceConfig(power=0.0, repeat_cap=100))
    np.testing.assert_allclose(even[-1], 0.5)
    between = clip_probabilities(kinds, sources, seconds)
    assert 0.1 < between[-1] < 0.5


def test_no_clip_repeats_beyond_the_cap() -> None:
    kinds, sources = ["walk"] * 9 + ["sit"], ["a"] * 10
    seconds = np.array([10.0] * 9 + [0.5])
    share = clip_probabilities(kinds, sources, seconds, BalanceConfig(power=0.0, repeat_cap=3.0))
    np.testing.assert_allclose(share[-1], 3.0 * 0.5 / 90.5)
    np.testing.assert_allclose(share.sum(), 1.0)


def test_sources_get_their_share_and_weight() -> None:
    kinds, sources, seconds = ["walk"] * 4, ["a", "a", "b", "c"], np.ones(4)
    share = clip_probabilities(kinds, sources, seconds, BalanceConfig(source_share={"c": 0.1}))
    np.testing.assert_allclose(share[3], 0.1)


def test_restyled_moves_arms_and_trunk_but_no_leg() -> None:
    rng = np.random.default_rng(5)
    time = np.linspace(0, 4, 121)[:, None, None]
    swing = 0.4 * np.sin(2 * np.pi * time + rng.uniform(0, 6, (1, 22, 3)))
    R = matrix_from_axis_angle(np.stack([swing, swing]))
    moved = np.array([JOINT_INDEX[name] for part in STYLE_PARTS for name in part])
    still = np.setdiff1d(np.arange(22), moved)
    made = restyled(R, np.random.default_rng(6))
    np.testing.assert_array_equal(made[:, :, still], R[:, :, still])
    assert (np.abs(made[:, :, moved] - R[:, :, moved]).max((1, 3, 4)) > 0.02).all()
    np.testing.assert_allclose(made @ np.swapaxes(made, -1, -2), np.broadcast_to(np.eye(3), made.shape), atol=1e-6)
    ratio = spread(made) / spread(R)
    assert (ratio < 1.7).all()
    assert (ratio > 0.55).all()
    for part in STYLE_PARTS:
        of_part = ratio[:, [JOINT_INDEX[name] for name in part]]
        assert (np.abs(np.log(of_part.mean(1))) > 0.05).any(), "some window swings more or less widely"
        assert (np.ptp(of_part, axis=1) < 0.1).all(), "all joints of a part alike"


def test_swings_over_half_a_turn_keep_their_size() -> None:
    turn = np.linspace(0, 2 * np.pi, 121)[:, None, None] * np.array([0.0, 1.0, 0.0])
    R = matrix_from_axis_angle(np.broadcast_to(turn, (1, 121, 22, 3)))
    made = restyled(R, np.random.default_rng(6))
    np.testing.assert_allclose(spread(made), spread(R), rtol=1e-6)


def spread(R: np.ndarray) -> np.ndarray:
    """Mean distance of neighboring frames (batch, joints): as wide as a joint swings."""
    return np.linalg.norm(np.diff(R, axis=1), axis=(-2, -1)).mean(1)
