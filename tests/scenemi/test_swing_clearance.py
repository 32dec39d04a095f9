"""Swinging toes clear the floor, and nothing else moves."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import FPS, planted_walk

from scenemi.metrics import HORIZONTAL, jerk_m_s3
from scenemi.swing_clearance import SwingConfig, clear_swings
from video2anim.body.leg_ik import LEGS, move_ankles
from video2anim.body.skeleton import forward_kinematics
from video2anim.types import BodyMotion


def joints_of(R_parent_joint: np.ndarray, motion: BodyMotion) -> np.ndarray:
    return forward_kinematics(R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)[0]


def cleared(motion: BodyMotion, contact: np.ndarray | None = None, config: SwingConfig | None = None) -> np.ndarray:
    root_m = motion.T_world_root[:, :3, 3]
    contact = motion.contact if contact is None else contact
    return clear_swings(motion.R_parent_joint, root_m, motion.rest_joints_m, contact, FPS, config)


def dragging_walk(by_m: float = 0.0) -> BodyMotion:
    """A walk whose ankles stay at their standing height, less `by_m`, while they swing."""
    motion = planted_walk(150)
    root_m, R = motion.T_world_root[:, :3, 3], motion.R_parent_joint
    for leg in LEGS:
        ankle_m = motion.joints_world_m[:, leg.ankle].copy()
        standing = motion.contact[:, leg.toe] > 0.5
        ankle_m[~standing, 1] = ankle_m[standing, 1].mean() - by_m
        R = move_ankles(R, root_m, motion.rest_joints_m, leg, ankle_m)
    return motion.with_pose(translation_world_m=root_m, R_parent_joint=R)


def test_dragged_toes_are_raised_and_standing_feet_stay() -> None:
    motion, config = dragging_walk(), SwingConfig()
    solved = cleared(motion)
    before_m, after_m = motion.joints_world_m, joints_of(solved, motion)
    for leg in LEGS:
        standing = motion.contact[:, leg.toe] > 0.5
        # The clip's first frame is the end of a touch that is too short to count.
        held = standing & (np.arange(len(standing)) > 0)
        own = [leg.ankle, leg.toe]
        np.testing.assert_allclose(after_m[held][:, own], before_m[held][:, own])
        stand_m = np.median(before_m[standing, leg.toe, 1])
        speed_m_s = np.linalg.norm(np.gradient(before_m[:, leg.toe][:, HORIZONTAL], axis=0), axis=1) * FPS
        away = np.convolve(standing, np.ones(7), "same") == 0
        swinging = away & (speed_m_s > 0.5)
        assert swinging.sum() > 10
        assert (after_m[swinging, leg.toe, 1] - stand_m).min() > 0.8 * config.clearance_m
        assert (after_m[:, leg.toe, 1] - before_m[:, leg.toe, 1]).max() < 1.2 * config.clearance_m
    assert jerk_m_s3(after_m, FPS) < 1.1 * jerk_m_s3(before_m, FPS)
    others = [j for j in range(22) if j not in {k for leg in LEGS for k in (leg.knee, leg.ankle, leg.toe)}]
    np.testing.assert_allclose(after_m[:, others], before_m[:, others], atol=1e-12)


def test_a_good_walk_stays_as_it_is() -> None:
    motion = planted_walk(150)
    lifted_m = joints_of(cleared(motion), motion) - motion.joints_world_m
    assert np.abs(lifted_m).max() < 0.004, "only the first and last frames of a swing are low"


@pytest.mark.parametrize("contact", ["none", "all"])
def test_without_swings_or_without_touches_nothing_happens(contact: str) -> None:
    motion = dragging_walk()
    told = np.full_like(motion.contact, 0.0 if contact == "none" else 1.0)
    np.testing.assert_array_equal(cleared(motion, told), motion.R_parent_joint)


def test_a_foot_that_rests_without_a_label_stays_down() -> None:
    """The toe is still, whatever its contact label says."""
    motion = planted_walk(60)
    R = np.repeat(motion.R_parent_joint[:1], 60, axis=0)
    still = motion.with_pose(
        translation_world_m=np.repeat(motion.T_world_root[:1, :3, 3], 60, axis=0), R_parent_joint=R
    )
    told = np.ones_like(motion.contact)
    told[20:40] = 0.0
    np.testing.assert_array_equal(cleared(still, told), R)


def test_no_foot_is_raised_by_more_than_the_limit() -> None:
    motion = dragging_walk(by_m=0.15)
    raised_m = joints_of(cleared(motion), motion) - motion.joints_world_m
    toes = [leg.toe for leg in LEGS]
    assert 0.03 < raised_m[:, toes, 1].max() <= SwingConfig().most_m + 1e-6
