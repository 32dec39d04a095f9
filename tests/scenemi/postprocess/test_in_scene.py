"""The solve of motions without a video: as free as the prior is uncertain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import FPS, planted_walk

from scenemi.evaluation.windows import with_noise
from scenemi.metrics import foot_skating_gmd, mpjpe
from scenemi.model.prior import load_diffusion_prior
from scenemi.postprocess.in_scene import PRIOR_ERROR, prior_error, put_in_scene
from scenemi.prior import WEIGHTS_FOLDER, KeyframeWindow, WindowMotion
from video2anim.body.anny_body import shaped_body
from video2anim.types.skeleton import forward_kinematics

FRAMES = 61


def window(every: int, level: float = 0.0) -> KeyframeWindow:
    """A walk of which every so many frames are given, with noise."""
    motion = planted_walk(FRAMES)
    R, t_m = with_noise(motion.R_parent_joint, motion.T_world_root[:, :3, 3], level, np.random.default_rng(0))
    is_keyframe = np.arange(FRAMES) % every == 0
    body = shaped_body(motion.shape)
    return KeyframeWindow(R, t_m, is_keyframe, motion.rest_joints_m, FPS, body=body, noise_level=level)


def test_the_error_of_the_prior_grows_with_the_distance_from_keyframes() -> None:
    error = prior_error(window(30))
    np.testing.assert_array_equal(error[[0, 30, 60]], 1e-3)
    assert (np.diff(error[:16], axis=0) > 0).all()
    np.testing.assert_allclose(error[15], [a * 15 / (15 + b) for a, b in PRIOR_ERROR])
    np.testing.assert_allclose(error, error[::-1])


def test_noise_of_keyframes_is_in_the_error_of_the_prior() -> None:
    of_level = prior_error(window(5, level=2.0))
    np.testing.assert_allclose(of_level[5], [0.02, np.radians(2), np.radians(2)])
    known = np.zeros((FRAMES, 2))
    known[10] = (6.0, 3.0)
    by_frame = prior_error(replace(window(5), noise=known))
    np.testing.assert_allclose(by_frame[10], [0.03, np.radians(6), np.radians(6)])
    np.testing.assert_array_equal(by_frame[15], 1e-3)


def test_a_frame_that_is_sure_gives_way_less_than_one_that_is_not() -> None:
    motion = planted_walk(FRAMES)
    slid_m = motion.T_world_root[:, :3, 3] + [[0.0, 0.0, 0.15]] * np.linspace(0, 1, FRAMES)[:, None]
    made = WindowMotion(motion.R_parent_joint, slid_m)
    moved = {}
    for every in (10, 60):
        given = replace(window(every), translation_world_m=slid_m)
        found = put_in_scene(made, given)
        turned = found.R_parent_joint[1:9] - made.R_parent_joint[1:9]
        moved[every] = float(np.abs(turned).max())
    assert moved[10] < moved[60]


@pytest.mark.slow
def test_noisy_keyframes_end_nearer_the_truth_and_stand_stiller() -> None:
    truth = planted_walk(FRAMES)
    given = window(3, level=1.0)
    made = load_diffusion_prior(WEIGHTS_FOLDER).fill(given)
    solved = put_in_scene(made, given)

    def joints_m(motion: WindowMotion) -> np.ndarray:
        return forward_kinematics(motion.R_parent_joint, motion.translation_world_m, given.rest_joints_m)[0]

    assert mpjpe(joints_m(solved), truth.joints_world_m) < mpjpe(joints_m(made), truth.joints_world_m)
    assert foot_skating_gmd(joints_m(solved), FPS) <= foot_skating_gmd(joints_m(made), FPS)
