"""Methods of other papers as priors: what each knows of keyframes and scene, and how its samples meet keyframes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT, Statistics, encode
from scenemi.model.baselines.base import Target
from scenemi.model.baselines.build import BASELINES, AnyBaseline, build_any
from scenemi.model.baselines.prior import BaselinePrior
from scenemi.model.baselines.scenediffuser import way_out
from scenemi.model.build import build_denoiser
from scenemi.model.choice import load_prior_by_name
from scenemi.model.conditions import Conditions, Descriptors
from scenemi.model.config import SIZES, BaselineConfig, Method, ModelConfig, config_from_json
from scenemi.model.weights import load_weights, save_weights
from scenemi.prior import KeyframeWindow, WindowMotion
from scenemi.scene.field import BoxField
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import forward_kinematics

TINY = ModelConfig(width=64, layers=2, heads=2, embedding=64)
METHODS: tuple[Method, ...] = tuple(BASELINES)
IMPUTED = tuple(name for name in METHODS if BASELINES[name].keyframes == "hidden")
FRAMES = 121
BODY = shaped_body(BodyShape("anny", dict(ADULT)))
STATISTICS = Statistics(
    np.zeros(FEATURE_COUNT, np.float32), np.full(FEATURE_COUNT, 0.5, np.float32),
    np.full(BODY_LENGTHS, 0.4, np.float32), np.full(BODY_LENGTHS, 0.1, np.float32),
)  # fmt: skip


def awake(method: Method) -> AnyBaseline:
    """Not trained, without layers of zeros."""
    torch.manual_seed(0)
    denoiser = BASELINES[method](BaselineConfig.like(method, TINY))
    with torch.no_grad():
        for parameter in denoiser.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return denoiser.eval()


def conditions(seed: int = 0) -> Conditions:
    g = torch.Generator().manual_seed(seed)
    mask = torch.zeros(2, FRAMES)
    mask[:, ::30] = 1
    config = BaselineConfig.like("mdm", TINY)
    scene = Descriptors(
        occupancy=(torch.rand(2, *config.grid, generator=g) < 0.2).float(),
        local_m=torch.zeros(2, FRAMES, config.bps_anchors, 3), global_known=torch.ones(2), local_known=torch.ones(2),
    )  # fmt: skip
    return Conditions(
        mask=mask, imputed=mask, base=torch.randn(2, FRAMES, FEATURE_COUNT, generator=g),
        noise=torch.zeros(2, FRAMES, 2), body=torch.randn(2, BODY_LENGTHS, generator=g), descriptors=scene,
    )  # fmt: skip


def swing(frames: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translation of somebody who swings all joints and walks."""
    time_s = np.arange(frames) / 30
    R = matrix_from_axis_angle(0.3 * np.sin(3 * time_s[:, None, None] + np.arange(66).reshape(22, 3)))
    return R, np.stack([0.2 * np.sin(time_s), 0.9 + 0.02 * np.sin(9 * time_s), 1.1 * time_s], -1)


def window(noise_level: float = 0.0, frames: int = FRAMES) -> KeyframeWindow:
    R, translation_m = swing(frames)
    keys = np.zeros(frames, bool)
    keys[::30] = keys[-1] = True
    R[~keys], translation_m[~keys] = np.nan, np.nan
    return KeyframeWindow(R, translation_m, keys, BODY.rest_joints_m, 30.0, body=BODY, noise_level=noise_level)


@pytest.fixture
def prior(tmp_path: Path) -> Callable[[Method], BaselinePrior]:
    """Priors that were never trained, from files."""

    def made(method: Method) -> BaselinePrior:
        path = tmp_path / f"{method}.safetensors"
        save_weights(path, awake(method), STATISTICS, {}, half=False)
        found = load_prior_by_name(str(path), steps=1 if method == "wang2021" else 3)
        assert isinstance(found, BaselinePrior)
        return found

    return made


def target(keys: torch.Tensor, mask: torch.Tensor, field: BoxField | None = None) -> Target:
    rest_m = torch.from_numpy(BODY.rest_joints_m).float().expand(len(keys), -1, -1)
    return Target(keys, mask, STATISTICS, rest_m, field)


def joints(made: WindowMotion) -> np.ndarray:
    return forward_kinematics(made.R_parent_joint, made.translation_world_m, BODY.rest_joints_m)[0]


@pytest.mark.parametrize("method", METHODS)
def test_a_file_of_weights_says_which_method_it_is(method: Method, tmp_path: Path) -> None:
    config = BaselineConfig.like(method, TINY)
    assert config_from_json(config.to_json()) == config
    path = tmp_path / "w.safetensors"
    save_weights(path, build_any(config), STATISTICS, {})
    found = load_prior_by_name(str(path))
    assert found.name == method
    with pytest.raises(InputError, match=f"{method} is a baseline"):
        load_weights(path)
    with pytest.raises(ValueError, match="unknown"):
        config_from_json({**config.to_json(), "colors": 3})
    with pytest.raises(ValueError, match="method"):
        config_from_json({**config.to_json(), "method": "gan"})


def test_baselines_are_about_as_large_as_the_shipped_denoiser() -> None:
    small = SIZES["small"]
    assert isinstance(small, ModelConfig)
    ours = sum(p.numel() for p in build_denoiser(small).parameters())
    for method in METHODS:
        count = sum(p.numel() for p in build_any(BaselineConfig.like(method, small)).parameters())
        assert 0.5 < count / ours < 2, f"{method} {count} {ours}"


@torch.no_grad()
@pytest.mark.parametrize("method", METHODS)
def test_every_baseline_sees_scene_and_body_and_some_see_keyframes(method: Method) -> None:
    denoiser, given, other = awake(method), conditions(), conditions(1)
    x, t = torch.randn(2, FRAMES, FEATURE_COUNT, generator=torch.Generator().manual_seed(5)), torch.tensor([100, 600])
    before = denoiser(x, t, given)
    assert before.shape == x.shape
    assert not torch.allclose(denoiser(x, t, replace(given, descriptors=other.descriptors)), before)
    assert not torch.allclose(denoiser(x, t, given.without_scene()), before)
    assert not torch.allclose(denoiser(x, t, replace(given, body=other.body)), before)
    fewer = given.mask.clone()
    fewer[:, 30] = 0
    assert torch.equal(denoiser(x, t, replace(given, mask=fewer)), before) == (method in IMPUTED)
    assert torch.equal(denoiser(x, t - 50, given), before) == (method == "wang2021"), "no diffusion"
    prepared = denoiser.prepare(given)
    torch.testing.assert_close(denoiser(x, t, given, None, prepared), before, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("noise_level", [0.0, 1.0])
@pytest.mark.parametrize("method", IMPUTED)
def test_imputed_keyframes_are_met_noisy_or_not(
    method: Method, noise_level: float, prior: Callable[[Method], BaselinePrior]
) -> None:
    given = window(noise_level)
    made, keys = prior(method).fill(given), given.is_keyframe
    np.testing.assert_allclose(made.R_parent_joint[keys], given.R_parent_joint[keys], atol=1e-5)
    np.testing.assert_allclose(made.translation_world_m[keys], given.translation_world_m[keys], atol=1e-5)
    assert np.isfinite(made.R_parent_joint).all()
    assert np.linalg.norm(joints(made)[1] - joints(made)[0], axis=-1).mean() > 0.05, "nothing is repaired beside them"


@pytest.mark.parametrize("method", METHODS)
def test_short_windows_and_batches_are_filled_as_one_by_one(
    method: Method, prior: Callable[[Method], BaselinePrior]
) -> None:
    found = prior(method)
    several = found.fill_many([window(), window(frames=61)], [3, 4])
    assert [len(made.translation_world_m) for made in several] == [121, 61]
    found.seed = 4
    alone = found.fill(window(frames=61))
    np.testing.assert_allclose(alone.translation_world_m, several[1].translation_world_m, atol=1e-4)
    found.seed = 5
    differs = not np.allclose(found.fill(window(frames=61)).translation_world_m, alone.translation_world_m)
    assert differs == (method != "wang2021"), "seeds make other motions where anything is drawn"


def test_the_guidance_of_omnicontrol_brings_joints_to_their_keyframes() -> None:
    """From poses 10 degrees and 10 cm off; other frames stay as they are."""
    R, translation_m = swing()
    mask = torch.zeros(1, FRAMES)
    mask[:, ::30] = 1
    wanted = STATISTICS.normalize(torch.from_numpy(encode(R, translation_m, BODY.rest_joints_m)).float())[None]
    turned = R @ matrix_from_axis_angle(np.full((1, 22, 3), 0.1))
    off = STATISTICS.normalize(torch.from_numpy(encode(turned, translation_m + 0.1, BODY.rest_joints_m)).float())[None]
    goal = target(wanted, mask)
    made = awake("omnicontrol").steer(off, 500, goal)
    keys = mask > 0

    def error_m(x: torch.Tensor) -> float:
        apart = goal.joints_m(STATISTICS.denormalize(x)) - goal.joints_m(STATISTICS.denormalize(wanted))
        return float(apart[keys].norm(dim=-1).mean())

    assert error_m(made) < 0.3 * error_m(off)
    torch.testing.assert_close(made[~keys], off[~keys], atol=1e-5, rtol=0)


def test_the_guidance_of_scenediffuser_leads_out_of_solids() -> None:
    """A person who stands with a leg in a low box comes out of it, and one who stands beside it stays."""
    upright = np.broadcast_to(np.eye(3), (2, 22, 3, 3))
    still_m = np.array([[0.0, 1.0, 0.0]] * 2)
    poses = torch.from_numpy(encode(upright, still_m, BODY.rest_joints_m)).float()
    away = poses.clone()
    away[..., [0, *range(135, 201, 3)]] += 3.0
    estimate = STATISTICS.normalize(torch.stack([poses, away]))
    joints_m = forward_kinematics(upright, still_m, BODY.rest_joints_m)[0]
    center_m = joints_m[0, 4] + np.array([0.05, 0.0, 0.0])
    box = torch.tensor([[[*center_m, 0.08, 0.15, 0.15, 0.0]]]).float().expand(2, -1, -1)
    field = BoxField.of(box, torch.ones(2))
    goal = target(estimate, torch.zeros(2, 2), field)

    def depth_m(x: torch.Tensor) -> torch.Tensor:
        points = goal.joints_m(STATISTICS.denormalize(x)).flatten(1, 2)
        return (-field.query(points)[0]).clamp(min=0).amax(1)

    made = way_out(estimate, goal)
    before, after = depth_m(estimate), depth_m(made)
    assert before[0] == pytest.approx(0.03, abs=1e-4)
    assert before[1] == 0
    assert after[0] < 0.2 * before[0]
    torch.testing.assert_close(made[1], estimate[1], atol=1e-5, rtol=0)
    assert torch.equal(way_out(estimate, target(estimate, torch.zeros(2, 2))), estimate), "no scene, no change"
    steered = awake("scenediffuser").steer(estimate, 1000, replace(goal, mask=torch.ones(2, 2)))
    assert torch.equal(steered, estimate), "keyframes stay"
