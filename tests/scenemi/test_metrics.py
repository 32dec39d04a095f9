"""Metrics against hand-computed values and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import orthogonal_procrustes
from scipy.spatial.transform import Rotation

from scenemi import metrics

FPS = 30.0


def still(frames: int, toe_height_m: float = 0.02) -> np.ndarray:
    """A body that does not move, everything at 1 m but ankles and toes."""
    joints_m = np.ones((frames, 22, 3))
    joints_m[:, metrics.ANKLES, 1] = 0.08
    joints_m[:, metrics.TOES, 1] = toe_height_m
    return joints_m


def sliding(frames: int, joints: tuple[int, ...], speed_m_s: float, toe_height_m: float = 0.02) -> np.ndarray:
    joints_m = still(frames, toe_height_m)
    joints_m[:, joints, 0] += speed_m_s / FPS * np.arange(frames)[:, None]
    return joints_m


def cloud(seed: int, frames: int = 7) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(frames, 22, 3))


def test_jerk_of_a_cubic_is_its_third_derivative() -> None:
    time_s = np.arange(20) / FPS
    joints_m = np.zeros((20, 22, 3))
    joints_m[:, :, 1] = (2.0 * time_s**3)[:, None]
    assert metrics.jerk_m_s3(joints_m, FPS) == pytest.approx(12.0, rel=1e-6)
    joints_m[:, 11:] = 0.0
    assert metrics.jerk_m_s3(joints_m, FPS) == pytest.approx(6.0, rel=1e-6)


def test_jerk_of_three_frames_is_unknown() -> None:
    assert np.isnan(metrics.jerk_m_s3(still(3), FPS))


def test_gmd_skating_counts_steps_with_a_fast_low_toe() -> None:
    toe = (metrics.TOES[0],)
    assert metrics.foot_skating_gmd(still(31), FPS) == 0.0
    assert metrics.foot_skating_gmd(sliding(31, toe, 0.49), FPS) == 0.0
    # At 0.6 m/s the 5-step mean, zero outside the clip, is 0.36 / 0.48 in the two steps at each end.
    assert metrics.foot_skating_gmd(sliding(31, toe, 0.6), FPS) == pytest.approx(26 / 30)
    assert metrics.foot_skating_gmd(sliding(31, toe, 0.6, toe_height_m=0.051), FPS) == 0.0


def test_gmd_skating_needs_the_mean_speed_too() -> None:
    joints_m = still(31)
    joints_m[15:, metrics.TOES[1], 2] += 0.02
    # One step at 0.6 m/s: mean over five is 0.12 m/s.
    assert metrics.foot_skating_gmd(joints_m, FPS) == 0.0


def test_gmd_skating_ignores_vertical_speed_and_kimodo_does_not() -> None:
    joints_m = still(31, toe_height_m=0.0)
    joints_m[1::2, metrics.TOES[0], 1] = 0.02
    assert metrics.foot_skating_gmd(joints_m, FPS) == 0.0
    assert metrics.foot_skating_kimodo(joints_m, FPS) == pytest.approx(0.5)


def test_kimodo_skating_is_a_share_of_contact_steps() -> None:
    joints_m = sliding(31, (metrics.TOES[0],), 0.3)
    assert metrics.foot_skating_kimodo(joints_m, FPS) == pytest.approx(0.5)
    joints_m[:, metrics.TOES[1], 1] = 0.5
    assert metrics.foot_skating_kimodo(joints_m, FPS) == pytest.approx(1.0)
    assert np.isnan(metrics.foot_skating_kimodo(still(31, toe_height_m=0.06), FPS))


def test_rohm_skating_needs_both_feet() -> None:
    feet = (*metrics.ANKLES, *metrics.TOES)
    assert metrics.foot_skating_rohm(sliding(31, feet, 0.11), FPS) == 1.0
    assert metrics.foot_skating_rohm(sliding(31, feet, 0.09), FPS) == 0.0
    assert metrics.foot_skating_rohm(sliding(31, feet[1:], 0.2), FPS) == 0.0
    assert metrics.foot_skating_rohm(sliding(31, feet, 0.2, toe_height_m=0.11), FPS) == 0.0


def test_collision_numbers() -> None:
    signed_m = np.array([[0.1, 0.2], [0.1, -0.005], [-0.03, 0.0], [0.5, 0.004]])
    assert metrics.collision_frame_ratio(signed_m) == pytest.approx(0.5)
    assert metrics.collision_frame_ratio(signed_m, 0.01) == pytest.approx(0.25)
    assert metrics.collision_vertex_ratio(signed_m) == pytest.approx(2 / 8)
    assert metrics.penetration_max_m(signed_m) == pytest.approx(0.03)
    assert metrics.penetration_max_m(signed_m[:1]) == 0.0
    # Gaps beyond 5 mm: 0.095, 0, 0, 0 (0.004 is within the tolerance).
    assert metrics.floating_m(signed_m) == pytest.approx(0.095 / 4)


def test_alignment_agrees_with_scipy_procrustes() -> None:
    source, target = cloud(0)[0], cloud(1)[0]
    found = metrics.align_similarity(source, target, with_scale=False)
    rotation, _ = orthogonal_procrustes(source - source.mean(0), target - target.mean(0))
    if np.linalg.det(rotation) < 0:
        kabsch, _ = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))
        rotation = kabsch.as_matrix().T
    np.testing.assert_allclose(found.R_to_from, rotation.T, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_alignment_never_mirrors_and_agrees_with_kabsch(seed: int) -> None:
    source, target = cloud(seed)[0], cloud(seed + 100)[0]
    kabsch, _ = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))
    found = metrics.align_similarity(source, target)
    np.testing.assert_allclose(found.R_to_from, kabsch.as_matrix(), atol=1e-6)
    assert np.linalg.det(found.R_to_from) == pytest.approx(1.0)


def test_aligned_errors_vanish_under_what_they_align() -> None:
    truth_m = cloud(3, frames=150)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.2]).as_matrix()
    shifted_m = truth_m + np.array([0.3, 0.0, 0.4])
    moved_m = 1.3 * truth_m @ turn.T + [1.0, 2.0, 3.0]
    assert metrics.mpjpe(shifted_m, truth_m) == pytest.approx(0.5)
    assert metrics.root_relative_mpjpe(shifted_m, truth_m) == pytest.approx(0.0, abs=1e-12)
    for metric in (metrics.pa_mpjpe, metrics.w_mpjpe, metrics.wa_mpjpe):
        assert metric(moved_m, truth_m) == pytest.approx(0.0, abs=1e-9)


def test_world_errors_see_drift_within_a_chunk_only() -> None:
    truth_m = cloud(4, frames=200)
    drift_m = truth_m.copy()
    drift_m[100:] += [5.0, 0.0, 0.0]
    assert metrics.w_mpjpe(drift_m, truth_m) == pytest.approx(0.0, abs=1e-9)
    drift_m = truth_m.copy()
    drift_m[50:100] += [1.0, 0.0, 0.0]
    # First two frames align exactly, so 50 of 200 frames are off by 1 m.
    assert metrics.w_mpjpe(drift_m, truth_m) == pytest.approx(0.25)
    assert 0 < metrics.wa_mpjpe(drift_m, truth_m) < metrics.w_mpjpe(drift_m, truth_m)


def test_rte_is_the_mean_error_over_the_path_length() -> None:
    truth_m = np.stack([np.linspace(0, 4, 41), np.zeros(41), np.zeros(41)], -1)
    estimate_m = truth_m + np.array([0.0, 0.0, 7.0])
    assert metrics.rte(estimate_m, truth_m) == pytest.approx(0.0, abs=1e-9)
    stretched_m = truth_m * [1.5, 1, 1]
    expected = np.abs(np.linspace(-1, 1, 41)).mean() / 4
    assert metrics.rte(stretched_m, truth_m) == pytest.approx(expected)
    assert np.isnan(metrics.rte(truth_m * 0, truth_m * 0))


@pytest.mark.parametrize("bad", [np.zeros((4, 21, 3)), np.zeros((22, 3)), np.full((4, 22, 3), np.nan)])
def test_wrong_joints_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="joints_m: want"):
        metrics.jerk_m_s3(bad, FPS)


def test_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="frames"):
        metrics.mpjpe(cloud(0, 3), cloud(0, 4))


def test_acceleration_error_of_a_known_acceleration() -> None:
    """Half of the joints fall 3 m/s^2 faster; place and speed do not matter."""
    time_s = np.arange(20) / FPS
    truth_m = cloud(8, frames=20)
    estimate_m = truth_m + np.array([1.0, 2.0, 3.0])
    estimate_m[:, :11, 1] += (1.5 * time_s**2 + 4.0 * time_s)[:, None]
    assert metrics.acceleration_error_m_s2(estimate_m, truth_m, FPS) == pytest.approx(1.5, rel=1e-6)
    assert metrics.acceleration_error_m_s2(truth_m, truth_m, FPS) == 0
    assert np.isnan(metrics.acceleration_error_m_s2(truth_m[:2], truth_m[:2], FPS))


def test_binary_scores_by_hand() -> None:
    truth = np.array([[True, True, False], [False, True, False]])
    claim = np.array([[True, False, True], [False, False, False]])
    scores = metrics.binary_scores(claim, truth)
    assert (scores.precision, scores.recall, scores.f1) == pytest.approx((1 / 2, 1 / 3, 2 / 5))
    none = np.zeros(3, bool)
    scores = metrics.binary_scores(none, none)
    assert np.isnan([scores.precision, scores.recall, scores.f1]).all()
    scores = metrics.binary_scores(none, ~none)
    assert np.isnan(scores.precision)
    assert (scores.recall, scores.f1) == (0, 0)
