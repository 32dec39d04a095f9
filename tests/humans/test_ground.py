"""Up and floor from motion whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import planted_walk

from video2anim.body.anny_body import shaped_body
from video2anim.humans.ground import floor_height, level_frame
from video2anim.types.skeleton import forward_kinematics


@pytest.mark.parametrize("up", [[0, -1, 0], [0.2, -0.9, -0.3], [0, 0, -1], [0, 0, 1], [1, 0, 0]])
def test_level_frame_is_a_rotation_with_up_on_y(up: list[float]) -> None:
    unit = np.array(up, float) / np.linalg.norm(up)
    R = level_frame(np.array(up, float))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ unit, [0, 1, 0], atol=1e-12)


def test_level_camera_looks_along_minus_z() -> None:
    R_world_camera = level_frame(np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(R_world_camera @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(R_world_camera @ [1, 0, 0], [1, 0, 0], atol=1e-12)


def test_floor_is_the_lowest_level_that_carries() -> None:
    """Half the time on a step, half on the ground, with noise; one foot is always down."""
    rng = np.random.default_rng(4)
    down = np.concatenate([np.full(60, 0.45), np.full(60, 0.0)]) - 1.3 + rng.normal(0, 0.01, 120)
    lifted = down + 0.2 * np.abs(np.sin(np.arange(120) / 4))
    floor_m, spread_m = floor_height(np.minimum(down, lifted), 30.0)
    assert floor_m == pytest.approx(-1.3, abs=0.02)
    assert spread_m < 0.03


@pytest.mark.parametrize("stair_m", [0.15, 0.18, 0.22])
def test_the_lowest_of_low_stairs_is_the_floor(stair_m: float) -> None:
    """Most of the time on the upper stairs, each nearer to the next than levels that are told apart by their gap."""
    rng = np.random.default_rng(5)
    on = np.repeat([0, 1, 2, 3], [80, 40, 60, 120])
    heights = stair_m * on + rng.normal(0, 0.015, len(on))
    assert floor_height(heights, 30.0)[0] == pytest.approx(0.0, abs=0.03)


def test_two_odd_windows_are_no_stair() -> None:
    """Somebody bends down for a second and their feet seem 20 cm lower."""
    heights = np.random.default_rng(6).normal(0, 0.02, 216)
    heights[90:120] -= 0.22
    assert floor_height(heights, 30.0)[0] == pytest.approx(0.0, abs=0.03)


def test_a_ramp_keeps_its_middle() -> None:
    """Gravity a little off: the floor seems to rise along the way."""
    assert floor_height(np.linspace(-0.3, 0.3, 240), 30.0)[0] == pytest.approx(0.0, abs=0.03)


def test_time_in_the_air_is_no_floor() -> None:
    heights = np.concatenate([np.zeros(60), 0.8 * np.ones(15), np.zeros(45)])
    floor_m, _ = floor_height(heights, 30.0)
    assert floor_m == pytest.approx(0.0, abs=1e-6)


def test_brief_dip_below_is_not_the_floor() -> None:
    """A single wild estimate half a meter down."""
    heights = np.zeros(120)
    heights[70:73] = -0.5
    floor_m, _ = floor_height(heights, 30.0)
    assert floor_m == pytest.approx(0.0, abs=1e-6)


def test_floor_of_a_planted_walk() -> None:
    motion = planted_walk(150)
    body = shaped_body(motion.shape)
    _, R_world_joint = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    lowest_m = body.vertices(R_world_joint, motion.joints_world_m)[..., 1].min(1)
    floor_m, spread_m = floor_height(lowest_m, 30.0)
    assert floor_m == pytest.approx(0.0, abs=0.03)
    assert spread_m < 0.03


def test_very_few_frames() -> None:
    assert floor_height(np.array([0.1]), 30.0) == pytest.approx((0.1, 0.0))
