"""Where nothing is said to touch anything, the lowest part carries the body, unless it flies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic import FPS, planted_walk, rotation, with_root_shift

from video2anim.humans.support import center_of_mass, vertical_acceleration_m_s2, with_support
from video2anim.types import BodyMotion
from video2anim.types.skeleton import FEET, JOINT_INDEX

FRAMES = 90
HANDS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]


def untold(motion: BodyMotion) -> BodyMotion:
    """Without contacts."""
    return replace(motion, contact=np.zeros_like(motion.contact))


def jump(takeoff: int, frames: int) -> np.ndarray:
    """Height of a ballistic flight."""
    time_s = np.clip((np.arange(FRAMES) - takeoff) / FPS, 0, frames / FPS)
    return 0.5 * 9.81 * time_s * (frames / FPS - time_s)


def test_the_standing_foot_carries_a_walk() -> None:
    motion = planted_walk(FRAMES)
    found = with_support(untold(motion), FPS)
    touching = np.flatnonzero(found.max(0))
    assert set(touching) <= set(FEET)
    carried = found.max(1) > 0.5
    assert carried.mean() > 0.9
    # The swinging foot is the lowest in the first and last frames of its swing at most.
    standing = motion.contact[:, list(FEET)] > 0.5
    assert (standing & (found[:, list(FEET)] > 0.5)).any(1)[carried].mean() > 0.9


def test_known_contacts_stay_as_they_are() -> None:
    motion = planted_walk(FRAMES)
    assert (motion.contact.max(1) > 0.5).all()
    np.testing.assert_array_equal(with_support(motion, FPS), motion.contact)


def test_a_flight_is_carried_by_nothing() -> None:
    motion = planted_walk(FRAMES, speed_m_s=0.0)
    takeoff, frames = 40, 14
    flies = np.zeros(FRAMES, bool)
    flies[takeoff + 1 : takeoff + frames] = True
    contact = np.where(flies[:, None], 0.0, motion.contact)
    jumps = with_root_shift(replace(motion, contact=contact), jump(takeoff, frames)[:, None] * [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(with_support(jumps, FPS), contact)


def test_who_is_on_the_hands_is_carried_by_them() -> None:
    """Upside down with arms beside the head, swaying a little."""
    motion = planted_walk(FRAMES, speed_m_s=0.0)
    R = motion.R_parent_joint.copy()
    for side, sign in (("left", 1), ("right", -1)):
        R[:, JOINT_INDEX[f"{side}_shoulder"]] = rotation("z", np.full(FRAMES, sign * 1.4))
        R[:, JOINT_INDEX[f"{side}_elbow"]] = np.eye(3)
    R[:, 0] = rotation("x", np.pi + 0.05 * np.sin(np.arange(FRAMES) / 10))
    on_hands = untold(motion).with_pose(translation_world_m=motion.T_world_root[:, :3, 3], R_parent_joint=R)
    found = with_support(on_hands, FPS)
    assert (found[:, HANDS].max(1) == 1).mean() > 0.95
    assert not np.delete(found, HANDS, axis=1).any()


def test_invalid_frames_touch_nothing() -> None:
    motion = untold(planted_walk(FRAMES))
    valid = np.zeros(FRAMES, bool)
    found = with_support(replace(motion, valid=valid), FPS)
    assert not found.any()
    valid[20:30] = True
    found = with_support(replace(motion, valid=valid), FPS)
    assert found[20:30].any(1).all()
    assert not found[~valid].any()


def test_the_acceleration_of_a_fall_is_that_of_gravity() -> None:
    found = vertical_acceleration_m_s2(jump(0, FRAMES), FPS)
    np.testing.assert_allclose(found[5:-5], -9.81, rtol=1e-6)
    assert len(vertical_acceleration_m_s2(np.zeros(3), FPS)) == 3


def test_the_center_of_mass_of_an_upright_body_is_in_its_trunk() -> None:
    joints_m = planted_walk(30).joints_world_m
    center_m = center_of_mass(joints_m)[:, 1]
    assert (center_m > joints_m[:, JOINT_INDEX["pelvis"], 1] - 0.05).all()
    assert (center_m < joints_m[:, JOINT_INDEX["spine3"], 1]).all()
