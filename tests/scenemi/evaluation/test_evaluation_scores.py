"""Scores of windows, means and intervals, and the whole evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from scenemi.evaluation.protocol import BATCH, NUMBERS, evaluate
from scenemi.evaluation.scores import WindowEvaluator, WindowScores, bootstrap, mean_of, over_seeds
from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol
from scenemi.prior import InterpolationPrior, KeyframeWindow, WindowMotion
from video2anim.errors import StageError

Windows = tuple[EvaluationWindow, ...]
EVERY = np.ones(121, bool)


class Wall:
    """Everything with x above a plane is solid."""

    def __init__(self, x_m: float) -> None:
        self.x_m = x_m

    def signed_distance(self, points_m: np.ndarray) -> np.ndarray:
        return self.x_m - points_m[..., 0]


def moved(window: EvaluationWindow, shift_m: Sequence[float]) -> WindowMotion:
    return WindowMotion(window.R_parent_joint, window.translation_m + shift_m)


def reach_of(window: EvaluationWindow) -> np.ndarray:
    """Largest x of the sampled skin in each frame."""
    judge = WindowEvaluator(window)
    return judge.skin_m(window.R_parent_joint, window.translation_m)[..., 0].max(axis=1)


def test_a_shift_is_the_error_and_nothing_else(windows: Windows) -> None:
    judge = WindowEvaluator(windows[0])
    truth, off = judge.truth(), judge.scores(moved(windows[0], (0.03, 0.0, 0.0)), EVERY)
    assert truth.mjpe_all_m == pytest.approx(0.0, abs=1e-9)
    assert off.mjpe_all_m == pytest.approx(0.03, abs=1e-9)
    assert off.jerk_m_s3 == pytest.approx(truth.jerk_m_s3, rel=1e-6)
    assert np.isnan(off.collision_frame_ratio), "without a scene there is no collision number"


def test_key_error_is_over_keyframes_only(windows: Windows) -> None:
    window = windows[0]
    keys = np.zeros(121, bool)
    keys[[0, 60, 120]] = True
    shift_m = np.where(keys[:, None], 0.0, [0.1, 0.0, 0.0])
    found = WindowEvaluator(window).scores(WindowMotion(window.R_parent_joint, window.translation_m + shift_m), keys)
    assert found.mjpe_key_m == pytest.approx(0.0, abs=1e-9)
    assert found.mjpe_all_m == pytest.approx(0.1 * 118 / 121, abs=1e-9)


def test_depth_under_the_floor_is_measured_on_the_skin(windows: Windows) -> None:
    judge = WindowEvaluator(windows[0])
    deeper = judge.scores(moved(windows[0], (0.0, -0.05, 0.0)), EVERY).floor_depth_m
    assert deeper == pytest.approx(judge.truth().floor_depth_m + 0.05, abs=0.02)


def test_collisions_against_a_wall_are_those_counted_by_hand(windows: Windows) -> None:
    reach_m = reach_of(windows[0])
    x_m = float(np.median(reach_m)) + 0.045
    window = replace(windows[0], obstacles=Wall(x_m))
    judge = WindowEvaluator(window)
    found = judge.scores(moved(window, (0.06, 0.0, 0.0)), EVERY)
    near = x_m - reach_m < 0.08
    hit, hit_1cm = reach_m + 0.06 > x_m, reach_m + 0.05 > x_m
    assert 0 < hit.sum() < 121
    assert found.collision_frame_ratio == pytest.approx(hit.mean())
    assert found.collision_frame_ratio_1cm == pytest.approx(hit_1cm.mean())
    assert found.penetration_max_m == pytest.approx(reach_m.max() + 0.06 - x_m, abs=1e-6)
    assert found.close_frames == near.sum()
    assert found.close_collision_frames == (hit & near).sum()
    assert found.close_collision_frames_1cm == (hit_1cm & near).sum()


def test_without_close_frames_their_numbers_are_absent(windows: Windows) -> None:
    window = replace(windows[0], obstacles=Wall(100.0))
    found = WindowEvaluator(window).truth()
    assert found.close_frames == 0
    assert np.isnan(found.close_penetration_max_m)
    assert np.isnan(mean_of([found], "close_collision_frame_ratio"))
    assert found.collision_frame_ratio == 0


def rows(values: Sequence[float]) -> list[WindowScores]:
    return [WindowScores(value, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for value in values]


def test_means_leave_out_what_is_not_known() -> None:
    assert mean_of(rows([1.0, float("nan"), 3.0]), "mjpe_all_m") == 2.0
    few, many = rows([0.0, 0.0])
    close = [replace(few, close_frames=10, close_collision_frames=10), replace(many, close_frames=90)]
    assert mean_of(close, "close_collision_frame_ratio") == pytest.approx(0.1)


def test_bootstrap_interval_holds_the_mean_and_narrows_with_windows() -> None:
    rng = np.random.default_rng(3)
    few, many = (bootstrap(rows(rng.normal(1.0, 0.1, n).tolist()), "mjpe_all_m") for n in (20, 500))
    assert few.low < few.mean < few.high
    # 1.96 sigma / sqrt(n) on either side.
    assert many.high - many.low == pytest.approx(2 * 1.96 * 0.1 / np.sqrt(500), rel=0.15)
    assert few.high - few.low > 2 * (many.high - many.low)


def test_interval_over_seeds_is_that_of_the_mean() -> None:
    found = over_seeds([1.0, 2.0, 3.0])
    assert found.mean == 2.0
    assert found.high - found.mean == pytest.approx(1.96 / np.sqrt(3))
    assert np.isnan(over_seeds([1.0, float("nan")]).mean)


class Shifted:
    """Interpolation, moved by a length that depends on the seed; takes batches."""

    name = "shifted"

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        raise AssertionError("a prior that takes batches gets batches")

    def fill_many(self, windows: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
        assert len(windows) == len(seeds) <= BATCH
        self.seeds += seeds
        filled = [InterpolationPrior().fill(window) for window in windows]
        up_m = np.array([0.0, 0.02, 0.0])
        return [replace(one, translation_world_m=one.translation_world_m + up_m) for one in filled]


def test_baseline_is_interpolation_and_every_window_has_its_own_seed(windows: Windows) -> None:
    prior = Shifted()
    found = evaluate(windows, prior, KeyframeProtocol(30), seed=5)
    plain = evaluate(windows, InterpolationPrior(), KeyframeProtocol(30))
    assert found.summary()["baseline_mjpe_all_m"] == plain.summary()["mjpe_all_m"]
    assert found.summary()["mjpe_key_m"] == pytest.approx(0.02, abs=1e-9)
    assert len(set(prior.seeds)) == len(windows)
    other = Shifted()
    evaluate(windows, other, KeyframeProtocol(30), seed=6)
    assert not set(prior.seeds) & set(other.seeds)


def test_summary_has_exactly_the_published_keys(windows: Windows) -> None:
    found = evaluate(windows[:2], InterpolationPrior(), KeyframeProtocol(30))
    assert list(found.summary()) == [
        "windows", "mjpe_all_m", "mjpe_key_m", "jerk_m_s3", "jerk_truth_m_s3", "skating_gmd", "skating_gmd_truth",
        "collision_frame_ratio", "penetration_max_m", "seconds_per_window", "baseline_mjpe_all_m",
        "baseline_jerk_m_s3",
    ]  # fmt: skip
    assert found.summary()["windows"] == 2
    details = found.details()
    assert set(NUMBERS) == set(details["prior"]) == set(details["truth"]) == set(details["prior_95"])


def test_noisy_input_is_measured_beside_the_prior(windows: Windows) -> None:
    found = evaluate(windows, InterpolationPrior(), KeyframeProtocol(3, noise=1.0))
    clean = evaluate(windows, InterpolationPrior(), KeyframeProtocol(3))
    assert mean_of(found.noisy_input, "mjpe_all_m") > 0.01
    assert mean_of(found.noisy_input, "jerk_m_s3") > 5 * mean_of(found.truth, "jerk_m_s3")
    assert clean.noisy_input == clean.truth


def test_motion_that_is_not_finite_is_an_error(windows: Windows) -> None:
    class Broken:
        name = "broken"

        def fill(self, window: KeyframeWindow) -> WindowMotion:
            return WindowMotion(window.R_parent_joint, np.full_like(window.translation_world_m, np.nan))

    with pytest.raises(StageError, match=r"prior broken: motion of window walk_260@0 is not finite"):
        evaluate(windows, Broken(), KeyframeProtocol(30))
