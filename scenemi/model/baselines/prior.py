"""A baseline as an in-betweening prior: the same windows, features and results as those of `DiffusionPrior`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scenemi.features import JOINTS
from scenemi.model.baselines.base import Baseline, Target
from scenemi.model.baselines.build import AnyBaseline
from scenemi.model.baselines.scenediffuser import SceneDiffuser
from scenemi.model.build import AnyDenoiser
from scenemi.model.conditions import Conditions
from scenemi.model.config import BaselineConfig
from scenemi.model.prior import DiffusionPrior, grid_field
from scenemi.model.sampling import SamplerConfig, sample
from scenemi.model.weights import LoadedModel
from scenemi.prior import KeyframeWindow


class BaselinePrior(DiffusionPrior):
    """Keyframes are met as well as the method meets them, and believed as they are where they are noisy."""

    def __init__(
        self, model: LoadedModel, sampler: SamplerConfig, denoiser: AnyBaseline, *, device: str = "cpu", seed: int = 0
    ) -> None:
        super().__init__(model, sampler, device=device, seed=seed)
        assert isinstance(model.config, BaselineConfig)
        self._baseline, self.name = denoiser, model.config.method

    def _conditions(
        self, windows: list[KeyframeWindow], T_world_canonical: Float[np.ndarray, "batch 4 4"]
    ) -> tuple[Tensor, Conditions]:
        x_keys, found = super()._conditions(windows, T_world_canonical)
        if not isinstance(self._baseline, SceneDiffuser):
            return x_keys, found
        around_m = self.model.statistics.denormalize(found.base)[..., JOINTS].unflatten(-1, (22, 3)).cpu().numpy()
        return x_keys, replace(found, field=grid_field(windows, T_world_canonical, around_m))

    def _sampled(
        self,
        windows: list[KeyframeWindow],
        x_keys: Tensor,
        conditions: Conditions,
        generators: list[torch.Generator],
        noisy: bool,
    ) -> Tensor:
        rest_m = self._tensor(np.stack([window.rest_joints_m for window in windows]))
        target = Target(x_keys, conditions.mask, self.model.statistics, rest_m, conditions.field)
        return sample(
            self._baseline, self.schedule, x_keys, conditions.with_keyframes(self._baseline.keyframes), self.sampler,
            generators, steer=lambda estimate, t: self._baseline.steer(estimate, t, target),
        )  # fmt: skip


def sampler_of(denoiser: AnyDenoiser) -> SamplerConfig:
    """How a denoiser is sampled where nothing else is asked for."""
    return denoiser.sampler if isinstance(denoiser, Baseline) else SamplerConfig()


def prior_of(model: LoadedModel, sampler: SamplerConfig, *, device: str = "cpu", seed: int = 0) -> DiffusionPrior:
    """The prior around any denoiser."""
    if isinstance(model.denoiser, AnyBaseline):
        return BaselinePrior(model, sampler, model.denoiser, device=device, seed=seed)
    return DiffusionPrior(model, sampler, device=device, seed=seed)
