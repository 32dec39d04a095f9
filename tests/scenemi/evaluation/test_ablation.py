"""Conditions taken away at sampling time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scenemi.evaluation.ablation import AblatedPrior
from scenemi.evaluation.scenes import with_synthetic_scenes
from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol, give_keyframes
from scenemi.features import Statistics
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.model.prior import DiffusionPrior
from scenemi.model.sampling import SamplerConfig
from scenemi.model.weights import LoadedModel
from scenemi.prior import KeyframeWindow


@pytest.fixture(scope="module")
def prior() -> DiffusionPrior:
    """An untrained tiny model whose every weight matters."""
    torch.manual_seed(0)
    denoiser = Denoiser(SIZES["tiny"])
    with torch.no_grad():
        for value in denoiser.parameters():
            value.add_(0.02 * torch.randn_like(value))
    ones = np.ones(201, np.float32), np.ones(7, np.float32)
    statistics = Statistics(0 * ones[0], ones[0], 0 * ones[1], ones[1])
    model = LoadedModel(denoiser.eval(), SIZES["tiny"], statistics, {}, Path("tiny"))
    return DiffusionPrior(model, SamplerConfig(steps=2))


@pytest.fixture(scope="module")
def given(windows: tuple[EvaluationWindow, ...]) -> KeyframeWindow:
    return give_keyframes(with_synthetic_scenes(windows[:1])[0], KeyframeProtocol(60)).keyframes


def test_without_its_scene_it_is_a_window_without_a_scene(prior: DiffusionPrior, given: KeyframeWindow) -> None:
    none = AblatedPrior(prior, use_scene=False).fill(given)
    bare = prior.fill(replace(given, scene=None))
    np.testing.assert_allclose(none.translation_world_m, bare.translation_world_m, atol=1e-5)
    np.testing.assert_allclose(none.R_parent_joint, bare.R_parent_joint, atol=1e-4)


def test_every_condition_changes_the_motion_and_none_leaves_it(prior: DiffusionPrior, given: KeyframeWindow) -> None:
    full = prior.fill(given).R_parent_joint
    np.testing.assert_array_equal(AblatedPrior(prior).fill(given).R_parent_joint, full)
    for part in ("use_scene", "use_body"):
        without = AblatedPrior(prior, **{part: False}).fill(given).R_parent_joint
        assert np.abs(without - full).max() > 1e-5, part
