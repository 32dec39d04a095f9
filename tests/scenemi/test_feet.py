"""Leg inverse kinematics, the foot lock and the low-pass filter."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import FPS, planted_walk

from scenemi.foot_lock import contact_phases, lock_feet
from scenemi.metrics import TOES, jerk_m_s3
from video2anim.body.leg_ik import LEGS, move_ankles
from video2anim.body.skeleton import forward_kinematics
from video2anim.geometry.smoothing import low_pass


def test_ankles_reach_their_target_and_the_rest_stays() -> None:
    motion = planted_walk(40)
    root_m, rest = motion.T_world_root[:, :3, 3], motion.rest_joints_m
    joints_m, R_world_joint = forward_kinematics(motion.R_parent_joint, root_m, rest)
    leg, other = LEGS
    shift_m = np.random.default_rng(0).uniform(-0.05, 0.05, (40, 3))
    solved = move_ankles(motion.R_parent_joint, root_m, rest, leg, joints_m[:, leg.ankle] + shift_m)
    moved_m, R_moved = forward_kinematics(solved, root_m, rest)
    reach_m = np.linalg.norm(joints_m[:, leg.ankle] + shift_m - joints_m[:, leg.hip], axis=-1)
    bones_m = np.linalg.norm(rest[leg.knee] - rest[leg.hip]) + np.linalg.norm(rest[leg.ankle] - rest[leg.knee])
    within = reach_m < 0.998 * bones_m
    assert within.sum() > 20
    np.testing.assert_allclose((moved_m - joints_m)[within, leg.ankle], shift_m[within], atol=1e-4)
    np.testing.assert_allclose(R_moved[:, leg.ankle], R_world_joint[:, leg.ankle], atol=1e-9)
    untouched = [0, other.ankle, other.toe, 20]
    np.testing.assert_allclose(moved_m[:, untouched], joints_m[:, untouched])


def test_out_of_reach_targets_stretch_the_leg_and_no_more() -> None:
    motion = planted_walk(10)
    root_m, rest, leg = motion.T_world_root[:, :3, 3], motion.rest_joints_m, LEGS[0]
    target_m = motion.joints_world_m[:, leg.hip] + [0.0, -2.0, 0.5]
    solved = move_ankles(motion.R_parent_joint, root_m, rest, leg, target_m)
    joints_m, _ = forward_kinematics(solved, root_m, rest)
    bones_m = np.linalg.norm(rest[leg.knee] - rest[leg.hip]) + np.linalg.norm(rest[leg.ankle] - rest[leg.knee])
    np.testing.assert_allclose(
        np.linalg.norm(joints_m[:, leg.ankle] - joints_m[:, leg.hip], axis=-1), 0.999 * bones_m, rtol=1e-5
    )


def test_phases_close_short_gaps_and_drop_short_touches() -> None:
    touching = np.array([0, 1, 1, 1, 0, 1, 1, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1], dtype=bool)
    assert contact_phases(touching, 3) == [(1, 8), (15, 18)]


def test_feet_stand_still_in_contact_and_nothing_pops() -> None:
    motion = planted_walk(180)
    root_m = motion.T_world_root[:, :3, 3].copy()
    time_s = motion.frame_time_s
    root_m[:, 0] += 0.03 * np.sin(2.5 * time_s)
    root_m[:, 2] += 0.03 * np.sin(3.1 * time_s)
    skating_m, _ = forward_kinematics(motion.R_parent_joint, root_m, motion.rest_joints_m)
    locked = lock_feet(motion.R_parent_joint, root_m, motion.rest_joints_m, motion.contact, FPS)
    held_m, _ = forward_kinematics(locked.R_parent_joint, root_m, motion.rest_joints_m)
    assert locked.refused_phases == 0
    assert locked.held_phases >= 10
    for side, leg in enumerate(LEGS):
        planted = (motion.contact[1:, leg.toe] > 0.5) & (motion.contact[:-1, leg.toe] > 0.5)
        before = np.linalg.norm(np.diff(skating_m[:, TOES[side]], axis=0), axis=-1)[planted] * FPS
        after = np.linalg.norm(np.diff(held_m[:, TOES[side]], axis=0), axis=-1)[planted] * FPS
        assert before.mean() > 0.05
        assert after.max() < 0.01
    assert jerk_m_s3(held_m, FPS) < 1.3 * jerk_m_s3(skating_m, FPS)
    untouched = [0, 1, 2, 3, 15, 20, 21]
    np.testing.assert_allclose(held_m[:, untouched], skating_m[:, untouched])


def test_a_contact_label_that_the_motion_contradicts_is_refused() -> None:
    motion = planted_walk(90)
    contact = np.ones_like(motion.contact)
    locked = lock_feet(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m, contact, FPS)
    assert (locked.held_phases, locked.refused_phases) == (0, 2)
    np.testing.assert_array_equal(locked.R_parent_joint, motion.R_parent_joint)


def test_low_pass_takes_jitter_out_and_keeps_the_motion() -> None:
    motion = planted_walk(150)
    root_m = motion.T_world_root[:, :3, 3]
    noisy_m = root_m + np.random.default_rng(1).normal(0, 0.005, root_m.shape)
    R_smooth, smooth_m = low_pass(motion.R_parent_joint, noisy_m, motion.valid, fps=FPS, cutoff_hz=6.0)
    assert np.abs(smooth_m - root_m).mean() < 0.75 * np.abs(noisy_m - root_m).mean()
    joints_m, _ = forward_kinematics(R_smooth, root_m, motion.rest_joints_m)
    assert np.linalg.norm(joints_m - motion.joints_world_m, axis=-1).mean() < 0.005


def test_low_pass_leaves_invalid_frames_and_short_runs() -> None:
    motion = planted_walk(60)
    root_m = motion.T_world_root[:, :3, 3] + np.random.default_rng(1).normal(0, 0.005, (60, 3))
    valid = np.ones(60, dtype=bool)
    valid[[20, 25]] = False
    _, smooth_m = low_pass(motion.R_parent_joint, root_m, valid, fps=FPS, cutoff_hz=6.0)
    np.testing.assert_array_equal(smooth_m[20:26], root_m[20:26])
    assert np.abs(smooth_m[:20] - root_m[:20]).max() > 1e-4
    with pytest.raises(ValueError, match="cutoff_hz"):
        low_pass(motion.R_parent_joint, root_m, valid, fps=FPS, cutoff_hz=15.0)
