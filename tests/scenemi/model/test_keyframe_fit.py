"""Keyframes are met exactly, and nothing jumps at them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenemi.model.keyframe_fit import fit_keyframes, spread_over_time
from scenemi.prior import WindowMotion
from video2anim.types.skeleton import PARENTS, forward_kinematics

FRAMES = 121


def moving(seed: int, jitter: float) -> WindowMotion:
    """Limbs that swing at a few frequencies, and a root that walks; `jitter` (rad, m) on top."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(FRAMES) / 30
    phase, rate = rng.uniform(0, 6, (22, 3)), rng.uniform(2, 8, (22, 3))
    angles = 0.4 * np.sin(time_s[:, None, None] * rate + phase) + jitter * rng.normal(size=(FRAMES, 22, 3))
    R = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(FRAMES, 22, 3, 3)
    walked = np.stack([np.sin(time_s), 0.9 + 0.03 * np.sin(10 * time_s), 1.2 * time_s], -1)
    return WindowMotion(R, walked + jitter * rng.normal(size=(FRAMES, 3)))


def off(motion: WindowMotion, seed: int, size: float) -> WindowMotion:
    """Another pose near each frame's: `size` radians and meters."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(size * rng.normal(size=(FRAMES * 22, 3))).as_matrix().reshape(FRAMES, 22, 3, 3)
    return WindowMotion(motion.R_parent_joint @ turn, motion.translation_world_m + size * rng.normal(size=(FRAMES, 3)))


def mask(*keys: int) -> np.ndarray:
    exact = np.zeros(FRAMES, bool)
    exact[list(keys)] = True
    return exact


def jerk_of_frames(motion: WindowMotion) -> np.ndarray:
    """Mean norm of each frame's third difference over the joints; entry i spans frames i to i + 3."""
    rest = np.cumsum(np.full((22, 3), 0.1), 0) * (PARENTS >= 0)[:, None]
    joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_world_m, rest)
    return np.linalg.norm(np.diff(joints_m, n=3, axis=0), axis=-1).mean(1)


@pytest.mark.parametrize("size", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("keys", [(0, 120), tuple(range(0, 121, 15)), (*range(61), 75, 90, 120), tuple(range(121))])
def test_keyframes_are_met_to_1e_6_and_rotations_stay_rotations(keys: tuple[int, ...], size: float) -> None:
    made = moving(1, 0.0)
    wanted = off(made, 2, size)
    fitted = fit_keyframes(made, wanted, mask(*keys))
    at = list(keys)
    assert np.abs(fitted.R_parent_joint[at] - wanted.R_parent_joint[at]).max() < 1e-6
    assert np.abs(fitted.translation_world_m[at] - wanted.translation_world_m[at]).max() < 1e-6
    identity = fitted.R_parent_joint @ np.swapaxes(fitted.R_parent_joint, -1, -2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-9)


@pytest.mark.parametrize("interval", [15, 30, 60, 120])
def test_the_curve_itself_leaves_a_thousandth_at_lone_keyframes(interval: int) -> None:
    """`fit_keyframes` writes keyframes over; that must not hide a step."""
    keys = np.arange(0, FRAMES, interval)
    values = np.random.default_rng(4).normal(size=(len(keys), 5))
    curve = spread_over_time(values, keys, FRAMES)
    assert np.abs(curve[keys] - values).max() < 1.5e-3 * np.abs(values).max()


def test_jerk_where_a_seed_ends_is_not_above_1_2_times_the_median() -> None:
    """61 exact frames of another motion with its own jitter, then the made one, 2 cm and 1 degree aside."""
    ratios = []
    for seed in range(8):
        made, aside = moving(1, 0.002), moving(1, 0.0)
        rng = np.random.default_rng(seed)
        shift_m, turn = 0.02 * rng.normal(size=3), Rotation.from_rotvec(0.02 * rng.normal(size=(22, 3))).as_matrix()
        rough = Rotation.from_rotvec(0.002 * rng.normal(size=(FRAMES * 22, 3))).as_matrix()
        wanted = WindowMotion(
            aside.R_parent_joint @ turn @ rough.reshape(FRAMES, 22, 3, 3),
            aside.translation_world_m + shift_m + 0.002 * rng.normal(size=(FRAMES, 3)),
        )
        jerk = jerk_of_frames(fit_keyframes(made, wanted, np.arange(FRAMES) <= 60))
        ratios.append(np.median(jerk[57:61]) / np.median(jerk))
    assert np.median(ratios) <= 1.2


@pytest.mark.parametrize("interval", [15, 30, 60])
def test_jerk_at_keyframes_is_not_above_1_2_times_the_median(interval: int) -> None:
    """Motion with a natural jerk, keyframes 2 cm and about 1 degree off what was made."""
    made = moving(1, 0.002)
    keys = tuple(range(0, FRAMES, interval))
    fitted = fit_keyframes(made, off(made, 7, 0.02), mask(*keys))
    jerk = jerk_of_frames(fitted)
    near = np.array([i for i in range(len(jerk)) if any(i <= key <= i + 3 for key in keys[1:-1])])
    assert np.median(jerk[near]) <= 1.2 * np.median(jerk)
    plain = WindowMotion(made.R_parent_joint.copy(), made.translation_world_m.copy())
    wanted = off(made, 7, 0.02)
    plain.R_parent_joint[list(keys)], plain.translation_world_m[list(keys)] = (
        wanted.R_parent_joint[list(keys)], wanted.translation_world_m[list(keys)],
    )  # fmt: skip
    assert np.median(jerk_of_frames(plain)[near]) > 2 * np.median(jerk)


def test_the_correction_has_no_step_in_velocity_acceleration_or_jerk() -> None:
    """On a grid 20 times finer the third derivative changes little from point to point, keyframes included."""
    fine = 20
    keys = np.array([0, 15, 30, 60]) * fine
    curve = spread_over_time(np.array([[1.0], [-1.0], [0.5], [1.0]]), keys, 61 * fine, 10.0 * fine)[:, 0]
    jerk = np.diff(curve, n=3) * fine**3
    assert np.abs(np.diff(jerk)).max() < 0.02 * np.abs(jerk).max()


def test_the_correction_dies_away_in_long_gaps_and_does_not_overshoot() -> None:
    curve = spread_over_time(np.array([[1.0], [1.0]]), np.array([0, 120]), FRAMES)[:, 0]
    assert np.abs(curve[45:76]).max() < 0.01
    assert curve.max() <= 1.0 + 1e-9
    assert curve.min() > -0.01


def test_motion_that_meets_its_keyframes_is_not_changed() -> None:
    made = moving(3, 0.001)
    fitted = fit_keyframes(made, made, mask(0, 30, 120))
    np.testing.assert_allclose(fitted.R_parent_joint, made.R_parent_joint, atol=1e-9)
    none = fit_keyframes(made, off(made, 1, 1.0), np.zeros(FRAMES, bool))
    assert none is made
