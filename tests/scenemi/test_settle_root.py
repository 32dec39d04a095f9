"""Settling the root: sliding feet, shallow and deep penetrations, and what must stay as it is."""

from __future__ import annotations

import numpy as np
import pytest

from scenemi.settle_root import SettleConfig, Sight, SkinNearSolids, settling_shift
from video2anim.body.skeleton import FEET
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid

FPS, FRAMES = 30.0, 90


def sliding(amplitude_m: float) -> np.ndarray:
    """Joints that all sway to and fro in x."""
    joints_m = np.zeros((FRAMES, 22, 3))
    joints_m[..., 0] = amplitude_m * np.sin(0.2 * np.arange(FRAMES))[:, None]
    return joints_m


def standing() -> np.ndarray:
    contact = np.zeros((FRAMES, 22))
    contact[:, FEET] = 1.0
    return contact


def floor_and_box() -> SdfGrid:
    """A floor, and a box from x = 1 to 2."""
    T_world_box = np.eye(4)
    T_world_box[0, 3] = 1.5
    box = world_mesh(box_mesh(1.0, 1.0, 1.0), T_world_box, 1.0)
    return build_sdf_grid([box], np.array([[-1.0, -0.5, -1.5], [3.0, 2.0, 1.5]]), 0.05)


def skin_at(x_m: np.ndarray, y_m: float = 0.4) -> np.ndarray:
    """A ball of skin at a height, (frames, 20, 3)."""
    ball_m = np.random.default_rng(0).normal(size=(20, 3))
    ball_m *= 0.05 / np.linalg.norm(ball_m, axis=1, keepdims=True)
    middle_m = np.stack([x_m, np.full(len(x_m), y_m), np.zeros(len(x_m))], 1)
    return middle_m[:, None] + ball_m


def test_feet_that_stand_stop_sliding() -> None:
    joints_m = sliding(0.03)
    moved_m = joints_m + settling_shift(joints_m, standing(), FPS)[:, None]
    assert np.abs(np.diff(moved_m, axis=0)).max() < 0.2 * np.abs(np.diff(joints_m, axis=0)).max()


def test_feet_that_do_not_stand_are_let_go() -> None:
    assert (settling_shift(sliding(0.03), 0.4 * standing(), FPS) == 0).all()


def test_a_foot_far_too_fast_to_stand_is_hardly_believed() -> None:
    """A walk of 2 m/s whose feet are all labelled as standing is not stopped."""
    joints_m = np.zeros((FRAMES, 22, 3))
    joints_m[..., 2] = (2.0 / FPS * np.arange(FRAMES))[:, None]
    shift_m = settling_shift(joints_m, standing(), FPS)
    assert np.abs(shift_m).max() < 0.1
    assert (joints_m[-1] - joints_m[0] + shift_m[-1] - shift_m[0])[0, 2] > 5.7


@pytest.mark.parametrize("depth_m", [0.01, 0.03])
def test_skin_a_little_inside_comes_out_smoothly(depth_m: float) -> None:
    """A body passes a box's face, by `depth_m` too near for half a second."""
    touch = np.exp(-0.5 * ((np.arange(FRAMES) - 45) / 8) ** 2)
    skin_m, grid = skin_at(0.95 - 0.1 + (0.1 + depth_m) * touch), floor_and_box()
    before_m = grid.sample(skin_m).min()
    shift_m = settling_shift(np.zeros((FRAMES, 22, 3)), np.zeros((FRAMES, 22)), FPS, skin=SkinNearSolids(skin_m, grid))
    assert before_m < -0.3 * depth_m
    assert grid.sample(skin_m + shift_m[:, None]).min() > -0.005
    assert np.abs(shift_m[:5]).max() < 0.002, "where nothing is inside nothing moves"
    assert np.linalg.norm(np.diff(shift_m, n=2, axis=0), axis=1).max() * FPS**2 < 4.0


def test_skin_under_the_floor_is_lifted() -> None:
    skin_m, grid = skin_at(np.zeros(FRAMES), 0.03), floor_and_box()
    shift_m = settling_shift(np.zeros((FRAMES, 22, 3)), np.zeros((FRAMES, 22)), FPS, skin=SkinNearSolids(skin_m, grid))
    assert grid.sample(skin_m).min() < -0.01
    assert grid.sample(skin_m + shift_m[:, None]).min() > -0.004
    np.testing.assert_allclose(shift_m[:, [0, 2]], 0, atol=2e-3)


def test_skin_deep_inside_is_left_there() -> None:
    """A body in the middle of a box: pose or box are wrong, and no small shift helps."""
    skin_m, grid = skin_at(np.full(FRAMES, 1.5)), floor_and_box()
    shift_m = settling_shift(np.zeros((FRAMES, 22, 3)), np.zeros((FRAMES, 22)), FPS, skin=SkinNearSolids(skin_m, grid))
    assert np.abs(shift_m).max() < 0.05


def test_what_has_begun_goes_on() -> None:
    """The first frames keep their shift, and the next ones leave it without a jerk."""
    begun_m = np.array([[0.02, 0, 0]] * 3)
    shift_m = settling_shift(np.zeros((FRAMES, 22, 3)), np.zeros((FRAMES, 22)), FPS, begun_m=begun_m)
    np.testing.assert_array_equal(shift_m[:3], begun_m)
    assert 0.01 < shift_m[4, 0] < 0.02
    assert np.abs(shift_m[-1]).max() < 1e-3
    assert np.linalg.norm(np.diff(shift_m, n=2, axis=0), axis=1).max() * FPS**2 < 4.0


def test_a_change_far_away_changes_nothing_to_the_bit() -> None:
    joints_m = sliding(0.03)
    later_m = joints_m.copy()
    later_m[85:, :, 2] += 1e-4
    contact = standing()
    contact[30:80] = 0.0
    one, other = (settling_shift(j, contact, FPS) for j in (joints_m, later_m))
    same = (one == other).all(1)
    assert same[:30].all()
    assert not same[80:].all()


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_too_short_to_be_smooth_is_left(frames: int) -> None:
    assert (settling_shift(np.zeros((frames, 22, 3)), np.ones((frames, 22)), FPS) == 0).all()


def test_all_begun_is_all_kept() -> None:
    begun_m = np.full((5, 3), 0.01)
    np.testing.assert_array_equal(settling_shift(np.zeros((4, 22, 3)), np.ones((4, 22)), FPS, begun_m=begun_m), 0.01)


def test_a_loose_root_moves_farther() -> None:
    joints_m, contact = sliding(0.1), standing()
    configs = [SettleConfig(sigma_m=s, speed_m_s=0.5, foot_speed_m_s=0.1) for s in (0.01, 0.2)]
    firm, loose = (settling_shift(joints_m, contact, FPS, config=config) for config in configs)
    assert np.abs(loose).max() > 1.5 * np.abs(firm).max()


def test_a_slow_shift_is_better_than_a_fast_one() -> None:
    """Who slides for a moment is not thrown about: the way is made up for by and by."""
    joints_m, contact = sliding(0.0), standing()
    joints_m[..., 0] = 0.05 * np.clip((np.arange(FRAMES) - 40) / 10, 0, 1)[:, None]
    slow, fast = (settling_shift(joints_m, contact, FPS, config=SettleConfig(speed_m_s=v)) for v in (0.02, 1.0))
    speed = [np.abs(np.diff(shift_m[:, 0])).max() for shift_m in (slow, fast)]
    assert speed[0] < 0.7 * speed[1]


@pytest.mark.parametrize("depth_m", [0.05, 0.08])
def test_a_shift_across_the_sight_keeps_to_its_limit(depth_m: float) -> None:
    """Skin in a box's face that is seen edge on may come out by the limit only; seen face on, all the way."""
    skin_m, grid = skin_at(np.full(FRAMES, 0.95 + depth_m)), floor_and_box()
    still_m, none = np.zeros((FRAMES, 22, 3)), np.zeros((FRAMES, 22))
    moved_m, left_m = [], []
    for direction in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]):
        sight = Sight(np.tile(direction, (FRAMES, 1)), np.full(FRAMES, 0.02))
        shift_m = settling_shift(still_m, none, FPS, skin=SkinNearSolids(skin_m, grid), sight=sight)
        moved_m.append(np.linalg.norm(shift_m, axis=1))
        left_m.append(-grid.sample(skin_m + shift_m[:, None]).min())
    assert ((moved_m[0] > 0.018) & (moved_m[0] < 0.025)).all()
    assert left_m[0] > depth_m - 0.035
    assert left_m[1] < 0.006
