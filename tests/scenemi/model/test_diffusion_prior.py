"""The prior around a denoiser of either form: frames of reference, keyframes, padding, batches; with random weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT, Statistics
from scenemi.longmotion import KeyframeMotion, inbetween
from scenemi.model.build import build_denoiser
from scenemi.model.choice import load_prior_by_name
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.model.heading import VIEW
from scenemi.model.prior import DiffusionPrior, grid_field, load_diffusion_prior, noise_of
from scenemi.model.sampling import SamplerConfig
from scenemi.model.weights import save_weights
from scenemi.prior import KeyframeWindow, WindowMotion
from scenemi.scene.boxes import Boxes
from scenemi.scene.geometry import SceneGeometry
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError, ModelMissingError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import forward_kinematics

FEW = SamplerConfig(steps=4)


STEPS = {"tiny": FEW, "paper-narrow": replace(FEW, steps=2, guidance_weight=2.5)}


def weights(path: Path, size: str) -> None:
    """Weights of a model that was never trained."""
    torch.manual_seed(0)
    denoiser = build_denoiser(SIZES[size])
    mean = np.zeros(FEATURE_COUNT, np.float32)
    mean[3:135:6] = mean[7:135:6] = 1.0
    mean[1] = 0.9
    statistics = Statistics(
        mean, np.full(FEATURE_COUNT, 0.3, np.float32), np.full(BODY_LENGTHS, 0.4, np.float32),
        np.full(BODY_LENGTHS, 0.1, np.float32),
    )  # fmt: skip
    with torch.no_grad():
        for parameter in denoiser.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    if isinstance(denoiser, Denoiser):
        denoiser.set_scales({
            "residual_std": torch.linspace(0, 0.3, 61)[:, None].expand(-1, 201), "noise_std": torch.full((2, 201), 0.1),
            "view_mean": torch.zeros(VIEW), "view_std": torch.ones(VIEW), "feature_mean": torch.from_numpy(mean),
            "feature_std": torch.full((201,), 0.3), "correlate": torch.eye(121),
        })  # fmt: skip
    save_weights(path, denoiser, statistics, {}, half=False)


@pytest.fixture(scope="module", params=["tiny", "paper-narrow"])
def form(request: pytest.FixtureRequest) -> str:
    """The shipped form of the denoiser, and the paper's."""
    return request.param


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, form: str) -> Path:
    path = tmp_path_factory.mktemp("weights")
    weights(path / "small.safetensors", form)
    return path


@pytest.fixture(scope="module")
def prior(folder: Path, form: str) -> DiffusionPrior:
    return load_diffusion_prior(folder, sampler=STEPS[form])


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
    solids = SceneGeometry.from_points(rng.uniform([-2, 0, -2], [2, 1.5, 3], (300, 3)))
    return SceneGeometry((*solids.parts, *SceneGeometry.floor().parts))


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
    assert off(here, WindowMotion(back, (there.translation_world_m - shift_m) @ R)) < 1e-4


def test_the_scene_matters_and_none_means_none(prior: DiffusionPrior) -> None:
    window = walk()
    inside = prior.fill(replace(window, scene=room()))
    empty = prior.fill(replace(window, scene=SceneGeometry.floor()))
    # An untrained encoder says little; rounding is a hundred times less.
    assert off(prior.fill(window), inside) > 1e-5
    assert off(inside, empty) > 1e-5


def test_batches_give_what_single_windows_give_and_seeds_differ(prior: DiffusionPrior) -> None:
    windows = [walk(), walk(70, 15), replace(walk(), noise_level=1.0), replace(walk(), scene=room()), walk()]
    together = prior.fill_many(windows, [0, 1, 2, 3, 4])
    for i, window in enumerate(windows):
        (alone,) = prior.fill_many([window], [i])
        assert off(together[i], alone) < 1e-4
    assert off(together[0], together[4]) > 1e-4


def test_one_step_is_the_expected_motion_for_every_seed(folder: Path, form: str) -> None:
    """But in the paper's form, which reads its noise at T."""
    expected = load_diffusion_prior(folder)
    assert (off(*expected.fill_many([walk(), walk()], [0, 1])) < 1e-4) == (form == "tiny")
    path = str(folder / "small.safetensors")
    several = load_prior_by_name(path, temperature=0.5)
    assert isinstance(several, DiffusionPrior)
    assert several.sampler.steps == 20
    assert off(*several.fill_many([walk(), walk()], [0, 1])) > 1e-3


def test_a_window_of_exact_keyframes_only_comes_back_unchanged(prior: DiffusionPrior) -> None:
    window = walk(61, 1)
    assert off(prior.fill(window), WindowMotion(window.R_parent_joint, window.translation_world_m)) == 0
    one = walk(1)
    assert off(prior.fill(one), WindowMotion(one.R_parent_joint, one.translation_world_m)) == 0


def test_without_a_body_one_of_that_stature_is_taken(prior: DiffusionPrior) -> None:
    window = replace(walk(), scene=room())
    assert off(prior.fill(window), prior.fill(replace(window, body=None))) < 0.05


def test_what_does_not_fit_the_model_is_refused(prior: DiffusionPrior, folder: Path) -> None:
    with pytest.raises(InputError, match="up to 121 frames, got 122"):
        prior.fill(walk(122))
    with pytest.raises(InputError, match="want 30 frames"):
        prior.fill(replace(walk(), fps=60.0))
    with pytest.raises(ModelMissingError):
        load_diffusion_prior(folder, weights="huge")


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


def test_the_field_is_the_scene_around_the_keyframes_in_their_own_frame() -> None:
    """A wall at x > 4 of the world, asked by somebody half a meter before it who faces it; the other has no scene."""
    wall = SceneGeometry.of(Boxes(np.array([[6.0, 1.0, 0.0]]), np.array([[2.0, 1.0, 5.0]]), np.zeros(1)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_axis_angle(np.array([0.0, 0.5 * np.pi, 0.0])), (3.5, 0.0, 2.0)
    around_m = np.zeros((2, 3, 22, 3)) + np.array([0.0, 1.0, 0.0])
    windows = [replace(walk(3, 1), scene=wall), walk(3, 1)]
    field = grid_field(windows, np.stack([T, np.eye(4)]), around_m)
    assert field is not None
    distance_m, out = field.query(torch.tensor([[[0.0, 1.0, 0.0], [0.3, 1.0, 0.2]]]).expand(2, -1, -1))
    torch.testing.assert_close(distance_m[0], torch.tensor([0.5, 0.3]), atol=0.03, rtol=0)
    torch.testing.assert_close(out[0], torch.tensor([[0.0, 0.0, -1.0]]).expand(2, -1), atol=0.05, rtol=0)
    assert (distance_m[1] == 0.6).all()
    assert grid_field(windows[1:], np.eye(4)[None], around_m[1:]) is None


def test_noise_is_told_in_degrees_and_centimeters_but_not_of_the_seed() -> None:
    told = noise_of(replace(walk(), noise_level=0.5, seed_frames=10))
    assert told.shape == (121, 2)
    assert not told[:10].any()
    assert (told[10:] == 0.5).all()
    assert not noise_of(walk()).any()
    louder = noise_of(replace(walk(), noise_level=40.0))
    assert 1.0 <= louder.max() < 40.0, "noisier than in training is taken for as noisy as there"
