"""Long motions: exact at keyframes, continuous at seams, whatever the prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import FPS, planted_walk

from scenemi.longmotion import KeyframeMotion, inbetween
from scenemi.prior import InterpolationPrior, KeyframeWindow, WindowMotion
from scenemi.windows import select_keyframes
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.types import BodyMotion


def keyframe_motion(motion: BodyMotion, keys: np.ndarray) -> KeyframeMotion:
    is_keyframe = np.zeros(motion.frame_count, dtype=bool)
    is_keyframe[keys] = True
    return KeyframeMotion(motion.R_parent_joint, motion.T_world_root[:, :3, 3], is_keyframe, motion.rest_joints_m, FPS)


class WindowedInterpolation:
    """Interpolation as a prior that fills windows."""

    name = "windowed"

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        return InterpolationPrior().fill(window)


class ShiftingPrior:
    """Interpolation that moves every window by another 2 cm: a prior that does not keep its seed."""

    name = "shifting"

    def __init__(self) -> None:
        self.windows = 0

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        self.windows += 1
        filled = InterpolationPrior().fill(window)
        return WindowMotion(
            filled.R_parent_joint, filled.translation_world_m + np.array([0.02 * (self.windows % 2), 0, 0])
        )


@pytest.mark.parametrize("frames", [1, 2, 50, 121, 122, 300])
def test_any_length_is_filled_and_exact_at_keyframes(frames: int) -> None:
    motion = planted_walk(frames)
    keys = select_keyframes(frames, 15)
    filled = inbetween(keyframe_motion(motion, keys), InterpolationPrior())
    assert filled.R_parent_joint.shape == (frames, 22, 3, 3)
    np.testing.assert_allclose(filled.translation_world_m[keys], motion.T_world_root[keys, :3, 3], atol=1e-9)
    np.testing.assert_allclose(filled.R_parent_joint[keys], motion.R_parent_joint[keys], atol=1e-9)


def test_windows_agree_with_one_interpolation_over_the_whole_motion() -> None:
    motion = planted_walk(300)
    given = keyframe_motion(motion, select_keyframes(300, 15))
    filled, whole = inbetween(given, WindowedInterpolation()), inbetween(given, InterpolationPrior())
    assert (len(filled.spans), len(whole.spans)) == (4, 1)
    # Rotations are the same; the root's spline knows less of the future at a window's end.
    np.testing.assert_allclose(filled.R_parent_joint, whole.R_parent_joint, atol=1e-9)
    np.testing.assert_allclose(filled.translation_world_m, whole.translation_world_m, atol=1e-3)


def test_interpolation_does_not_swing_out_in_a_long_noisy_motion() -> None:
    """Window by window, splines through dense frames and a far keyframe went 200 m astray within half a minute."""
    motion = planted_walk(1200)
    given = keyframe_motion(motion, select_keyframes(1200, 60))
    shaken = given.translation_world_m + np.random.default_rng(0).normal(0, 0.01, (1200, 3))
    filled = inbetween(replace(given, translation_world_m=shaken), InterpolationPrior())
    off_m = np.linalg.norm(filled.translation_world_m - motion.T_world_root[:, :3, 3], axis=-1)
    assert off_m.max() < 0.12  # 0.06


def test_seams_do_not_pop_even_when_the_prior_moves_its_seed() -> None:
    motion = planted_walk(300)
    filled = inbetween(keyframe_motion(motion, select_keyframes(300, 15)), ShiftingPrior())
    step_m = np.linalg.norm(np.diff(filled.translation_world_m, axis=0), axis=-1)
    true_step_m = np.linalg.norm(np.diff(motion.T_world_root[:, :3, 3], axis=0), axis=-1)
    # 2 cm faded over 61 frames adds at most 1.5 * 0.02 / 61 m to a step (the slope of the ramp).
    assert step_m.max() <= true_step_m.max() + 1.5 * 0.02 / 61 + 1e-3


def test_a_gap_longer_than_a_window_is_bridged_and_told() -> None:
    motion = planted_walk(400)
    filled = inbetween(keyframe_motion(motion, np.array([0, 15, 30, 300, 399])), InterpolationPrior())
    assert len(filled.interpolated_index) == 2
    turn_rad = np.linalg.norm(
        axis_angle_from_matrix(np.swapaxes(filled.R_parent_joint[:-1], -1, -2) @ filled.R_parent_joint[1:]), axis=-1
    )
    assert turn_rad.max() < 0.2


def test_frames_outside_the_keyframes_hold_the_nearest_pose() -> None:
    motion = planted_walk(60)
    filled = inbetween(keyframe_motion(motion, np.array([10, 25, 40])), InterpolationPrior())
    np.testing.assert_array_equal(filled.translation_world_m[:10], np.tile(filled.translation_world_m[10], (10, 1)))
    np.testing.assert_array_equal(filled.R_parent_joint[41:], np.tile(filled.R_parent_joint[40], (19, 1, 1, 1)))


def test_a_motion_without_keyframes_is_refused() -> None:
    with pytest.raises(ValueError, match="no keyframe"):
        inbetween(keyframe_motion(planted_walk(5), np.array([], dtype=int)), InterpolationPrior())
