"""Windows, keyframes and noise of the evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenemi.data.container import MotionArchive
from scenemi.evaluation.scenes import with_synthetic_scenes
from scenemi.evaluation.scores import WindowEvaluator
from scenemi.evaluation.windows import (
    EvaluationWindow,
    KeyframeProtocol,
    cut_windows,
    give_keyframes,
    with_noise,
)
from scenemi.features import to_canonical
from video2anim.errors import InputError, UsageError
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from video2anim.types.skeleton import forward_kinematics

Windows = tuple[EvaluationWindow, ...]


def test_every_whole_window_of_long_enough_clips_is_cut(windows: Windows) -> None:
    assert [window.name for window in windows] == ["walk_260@0", "walk_260@121", "walk_122@0", "walk_121@0"]
    assert all(window.joints_m.shape == (121, 22, 3) for window in windows)


def test_a_part_of_a_split_is_cut_alone(archive_file: Path) -> None:
    chosen = cut_windows([MotionArchive.read(archive_file)], ["walk_122", "of another archive"])
    assert [window.name for window in chosen] == ["walk_122@0"]


def test_clips_shorter_than_a_window_are_refused_in_one_line(short_file: Path) -> None:
    with pytest.raises(InputError, match="at least 121 frames at 30 fps, the longest has 120"):
        cut_windows([MotionArchive.read(short_file)])


def test_windows_start_over_the_origin_and_face_forward(windows: Windows) -> None:
    for window in windows:
        facing = window.R_parent_joint[0, 0] @ [0.0, 0.0, 1.0]
        np.testing.assert_allclose(window.translation_m[0, [0, 2]], 0.0, atol=1e-9)
        assert abs(facing[0]) < 1e-6
        assert facing[2] > 0


def test_centering_undoes_a_turn_and_a_shift(windows: Windows) -> None:
    window = windows[1]
    R_world_old = matrix_from_axis_angle(np.array([0.0, 2.1, 0.0]))
    turned = window.R_parent_joint.copy()
    turned[:, 0] = R_world_old @ turned[:, 0]
    moved_m = window.translation_m @ R_world_old.T + [3.0, 0.0, -7.0]
    R_parent_joint, translation_m = to_canonical(turned, moved_m)
    joints_m, _ = forward_kinematics(R_parent_joint, translation_m, window.body.rest_joints_m)
    np.testing.assert_allclose(joints_m, window.joints_m, atol=1e-9)


def test_uniform_keyframes_are_exact_and_include_both_ends(windows: Windows) -> None:
    given = give_keyframes(windows[0], KeyframeProtocol(50))
    keys = np.flatnonzero(given.keyframes.is_keyframe)
    assert keys.tolist() == [0, 50, 100, 120]
    np.testing.assert_array_equal(given.keyframes.R_parent_joint[keys], windows[0].R_parent_joint[keys])
    assert given.keyframes.noise_level == 0
    assert given.keyframes.body is windows[0].body


def test_random_keyframes_depend_on_window_and_seed_only(windows: Windows) -> None:
    def mask(window: EvaluationWindow, seed: int) -> np.ndarray:
        return give_keyframes(window, KeyframeProtocol(None, 0.3, seed=seed)).keyframes.is_keyframe

    first = mask(windows[0], 0)
    assert first[0]
    assert first[-1]
    assert 15 < first.sum() < 60
    np.testing.assert_array_equal(first, mask(windows[0], 0))
    assert (first != mask(windows[0], 1)).any()
    assert (first != mask(windows[1], 0)).any()


def test_noise_has_the_stated_size_and_spares_both_ends(windows: Windows) -> None:
    window = windows[0]
    level = 2.0
    noisy_R, noisy_m = with_noise(window.R_parent_joint, window.translation_m, level, np.random.default_rng(0))
    turn_deg = np.degrees(axis_angle_from_matrix(np.swapaxes(window.R_parent_joint, -1, -2) @ noisy_R))
    shift_cm = 100 * (noisy_m - window.translation_m)
    # 119 * 66 and 119 * 3 Gaussian numbers: the deviation is known to 0.8 % and 4 %.
    assert turn_deg[1:-1].std() == pytest.approx(level, rel=0.04)
    assert shift_cm[1:-1].std() == pytest.approx(level, rel=0.15)
    for ends in ([0], [-1]):
        np.testing.assert_array_equal(noisy_R[ends], window.R_parent_joint[ends])
        np.testing.assert_array_equal(noisy_m[ends], window.translation_m[ends])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "at least 1 frame"),
        ((None,), "either an interval or a probability"),
        ((3, 0.5), "either an interval or a probability"),
        ((None, 1.5), "probability from 0 to 1"),
        ((3, None, -1.0), "noise from 0 to 100"),
        ((3, None, float("nan")), "noise from 0 to 100"),
    ],
)
def test_impossible_protocols_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        KeyframeProtocol(*arguments)


def test_scenes_are_the_same_each_time_and_leave_the_true_motion_free(windows: Windows) -> None:
    once, again = with_synthetic_scenes(windows), with_synthetic_scenes(windows[::-1])[::-1]
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.obstacles.boxes.center_m, b.obstacles.boxes.center_m)
    assert len({window.obstacles.boxes.center_m.tobytes() for window in once}) == len(once)
    for window in once:
        truth = WindowEvaluator(window).truth()
        # Free space is carved with balls that hold the skin to about a centimeter.
        assert truth.penetration_max_m < 0.02


def test_near_distances_are_those_to_all_boxes(windows: Windows) -> None:
    window = with_synthetic_scenes(windows[:1])[0]
    points_m = window.joints_m + np.random.default_rng(0).normal(0, 0.3, window.joints_m.shape)
    exact_m = window.obstacles.boxes.signed_distance(points_m)
    np.testing.assert_allclose(window.obstacles.signed_distance(points_m), np.minimum(exact_m, 0.08), atol=1e-9)
    assert (exact_m < 0.08).any()
