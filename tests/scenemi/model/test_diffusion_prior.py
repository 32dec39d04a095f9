"""The prior around the denoiser: frames of reference, keyframes, padding, batches. Random weights will do for that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT, Statistics
from scenemi.longmotion import KeyframeMotion, inbetween
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.model.prior import DiffusionPrior, load_diffusion_prior
from scenemi.model.sampling import SamplerConfig
from scenemi.model.weights import save_weights
from scenemi.prior import KeyframeWindow, WindowMotion
from scenemi.scene.geometry import SceneGeometry
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.skeleton import forward_kinematics
from video2anim.errors import InputError, ModelMissingError, UsageError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.motion import BodyShape

FEW = SamplerConfig(steps=4)
BARE = replace(FEW, foot_rounds=0, clear_rounds=0)
"""Without repairs after sampling: their descent makes differences of rounding a hundred times larger."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a model that was never trained."""
    path = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    denoiser = Denoiser(SIZES["tiny"])
    for parameter in denoiser.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    mean = np.zeros(FEATURE_COUNT, np.float32)
    mean[3:135:6] = mean[7:135:6] = 1.0
    mean[1] = 0.9
    statistics = Statistics(
        mean, np.full(FEATURE_COUNT, 0.3, np.float32), np.full(BODY_LENGTHS, 0.4, np.float32),
        np.full(BODY_LENGTHS, 0.1, np.float32),
    )  # fmt: skip
    save_weights(path / "small.safetensors", denoiser, statistics, {}, half=False)
    return path


@pytest.fixture(scope="module")
def prior(folder: Path) -> DiffusionPrior:
    return load_diffusion_prior(folder, sampler=FEW)


@pytest.fixture(scope="module")
def bare(folder: Path) -> DiffusionPrior:
    return load_diffusion_prior(folder, sampler=BARE)


def walk(frames: int = 121, interval: int = 30) -> KeyframeWindow:
    """Somebody who swings all joints and walks; only keyframes are filled in."""
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    rng = np.random.default_rng(2)
    time_s = np.arange(frames) / 30
    angles = 0.3 * np.sin(3 * time_s[:, None, None] + rng.uniform(0, 6, (22, 3)))
    R = matrix_from_axis_angle(angles)
    translation_m = np.stack([0.2 * np.sin(time_s), 0.9 + 0.02 * np.sin(9 * time_s), 1.1 * time_s], -1)
    is_keyframe = np.zeros(frames, bool)
    is_keyframe[::interval] = is_keyframe[-1] = True
    R[~is_keyframe], translation_m[~is_keyframe] = np.nan, np.nan
    return KeyframeWindow(R, translation_m, is_keyframe, body.rest_joints_m, 30.0, body=body)


def room() -> SceneGeometry:
    rng = np.random.default_rng(5)
    return SceneGeometry.from_points(rng.uniform([-2, 0, -2], [2, 1.5, 3], (300, 3))).with_floor()


def off(a: WindowMotion, b: WindowMotion) -> float:
    return max(
        float(np.abs(a.R_parent_joint - b.R_parent_joint).max()),
        float(np.abs(a.translation_world_m - b.translation_world_m).max()),
    )


@pytest.mark.parametrize("frames", [2, 50, 121])
def test_exact_keyframes_are_met_and_everything_is_a_motion(prior: DiffusionPrior, frames: int) -> None:
    window = walk(frames)
    made = prior.fill(window)
    keys = window.is_keyframe
    assert np.abs(made.R_parent_joint[keys] - window.R_parent_joint[keys]).max() < 1e-6
    assert np.abs(made.translation_world_m[keys] - window.translation_world_m[keys]).max() < 1e-6
    assert made.R_parent_joint.shape == (frames, 22, 3, 3)
    determinant = np.linalg.det(made.R_parent_joint)
    np.testing.assert_allclose(determinant, 1.0, atol=1e-6)
    identity = made.R_parent_joint @ np.swapaxes(made.R_parent_joint, -1, -2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-6)


def test_noisy_keyframes_are_cleaned_but_the_seed_is_kept(prior: DiffusionPrior) -> None:
    window = walk()
    seeded = window.is_keyframe.copy()
    noisy = replace(window, noise_level=1.0, seed_frames=1)
    made = prior.fill(noisy)
    error_m = np.linalg.norm(made.translation_world_m - window.translation_world_m, axis=-1)
    assert error_m[0] < 1e-6
    assert error_m[seeded][1:].min() > 1e-4


def test_the_motion_moves_with_the_world(prior: DiffusionPrior) -> None:
    """Keyframes and scene turned and shifted on the floor give the same motion, turned and shifted."""
    window = replace(walk(), scene=room())
    R = matrix_from_axis_angle(np.array([0.0, 1.9, 0.0]))
    shift_m = np.array([3.0, 0.0, -7.0])
    turned = window.R_parent_joint.copy()
    turned[:, 0] = R @ window.R_parent_joint[:, 0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, shift_m
    moved = replace(
        window, R_parent_joint=turned, translation_world_m=window.translation_world_m @ R.T + shift_m,
        scene=room().transformed(T),
    )  # fmt: skip
    here, there = prior.fill(window), prior.fill(moved)
    back = there.R_parent_joint.copy()
    back[:, 0] = R.T @ there.R_parent_joint[:, 0]
    # Float32 network, float64 frames.
    assert off(here, WindowMotion(back, (there.translation_world_m - shift_m) @ R)) < 1e-3


def test_the_scene_matters_and_none_means_none(bare: DiffusionPrior) -> None:
    window = walk()
    inside = bare.fill(replace(window, scene=room()))
    empty = bare.fill(replace(window, scene=SceneGeometry.floor()))
    # An untrained encoder says little; rounding is a hundred times less.
    assert off(bare.fill(window), inside) > 1e-5
    assert off(inside, empty) > 1e-5


def test_batches_give_what_single_windows_give_and_seeds_differ(bare: DiffusionPrior) -> None:
    windows = [walk(), walk(70, 15), replace(walk(), noise_level=1.0), replace(walk(), scene=room()), walk()]
    together = bare.fill_many(windows, [0, 1, 2, 3, 4])
    for i, window in enumerate(windows):
        (alone,) = bare.fill_many([window], [i])
        assert off(together[i], alone) < 1e-4
    assert off(together[0], together[4]) > 1e-4


def test_a_window_of_exact_keyframes_only_comes_back_unchanged(prior: DiffusionPrior) -> None:
    window = walk(61, 1)
    assert off(prior.fill(window), WindowMotion(window.R_parent_joint, window.translation_world_m)) == 0
    one = walk(1)
    assert off(prior.fill(one), WindowMotion(one.R_parent_joint, one.translation_world_m)) == 0


def test_without_a_body_one_of_that_stature_is_taken(prior: DiffusionPrior) -> None:
    window = replace(walk(), scene=room())
    assert off(prior.fill(window), prior.fill(replace(window, body=None))) < 0.05


def test_extra_costs_change_the_motion(folder: Path) -> None:
    window = walk()
    plain = load_diffusion_prior(folder, sampler=FEW).fill(window)
    guided = load_diffusion_prior(folder, sampler=replace(FEW, keyframe_weight=1.0)).fill(window)
    assert off(plain, guided) > 1e-4


def test_onnxruntime_makes_the_same_motion(folder: Path) -> None:
    pytest.importorskip("onnx", reason="the exporter needs onnx (dev extra)")
    window = replace(walk(), scene=room())
    by_torch = load_diffusion_prior(folder, sampler=BARE).fill(window)
    by_onnx = load_diffusion_prior(folder, sampler=BARE, runtime="onnx").fill(window)
    assert off(by_torch, by_onnx) < 1e-3


def test_what_does_not_fit_the_model_is_refused(prior: DiffusionPrior, folder: Path) -> None:
    with pytest.raises(InputError, match="up to 121 frames, got 122"):
        prior.fill(walk(122))
    with pytest.raises(InputError, match="want 30 frames"):
        prior.fill(replace(walk(), fps=60.0))
    with pytest.raises(ModelMissingError):
        load_diffusion_prior(folder, weights="huge")
    with pytest.raises(UsageError, match="runtime onnx"):
        load_diffusion_prior(folder, device="meta", runtime="onnx")


def test_long_motion_has_no_step_at_seams(prior: DiffusionPrior) -> None:
    """Seed frames are kept exactly by every window, noisy keyframes or not."""
    window = walk(300, 15)
    motion = KeyframeMotion(
        window.R_parent_joint, window.translation_world_m, window.is_keyframe, window.rest_joints_m, body=window.body
    )
    for noise in (0.0, 1.0):
        seen: list[tuple[KeyframeWindow, WindowMotion]] = []

        class Spy:
            name = "spy"

            def fill(self, window: KeyframeWindow) -> WindowMotion:
                seen.append((window, prior.fill(window)))  # noqa: B023 (used within the turn)
                return seen[-1][1]  # noqa: B023

        inbetween(replace(motion, noise_level=noise), Spy())
        assert len(seen) == 4
        for given, made in seen[1:]:
            seed = slice(0, given.seed_frames)
            assert given.seed_frames >= 60
            assert np.abs(made.translation_world_m[seed] - given.translation_world_m[seed]).max() < 1e-6
            joints_m, _ = forward_kinematics(made.R_parent_joint, made.translation_world_m, given.rest_joints_m)
            given_m, _ = forward_kinematics(
                given.R_parent_joint[seed], given.translation_world_m[seed], given.rest_joints_m
            )
            assert np.abs(joints_m[seed] - given_m).max() < 1e-5
