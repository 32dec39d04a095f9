"""What the baselines share: how they are sampled, what sampling may look at, and how they read their conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from scenemi.features import BODY_LENGTHS, Statistics
from scenemi.model.conditions import Conditions, impute
from scenemi.model.config import BaselineConfig
from scenemi.model.denoiser import step_embedding
from scenemi.model.kinematics import joints_of
from scenemi.model.paper import SceneDenoiser
from scenemi.model.sampling import SamplerConfig
from scenemi.prior import SAMPLE_STEPS
from scenemi.scene.field import SceneField

# Shapes: B windows, N frames, 201 features, E channels of the embedding

PLAIN = SamplerConfig(steps=SAMPLE_STEPS, temperature=1.0, stop_step=0, hard_keyframes=False)
"""Samples as varied as the data, keyframes believed to the last step, nothing repaired after sampling."""
GUIDED = replace(PLAIN, guidance_weight=2.5)
"""The same with classifier-free guidance; its weight is that of MDM and CondMDI, and the paper's."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What a batch is steered to while it is sampled; features are normalized."""

    keys: Float[Tensor, "batch frames 201"]
    mask: Float[Tensor, "batch frames"]
    """1 at keyframes."""
    statistics: Statistics
    rest_joints_m: Float[Tensor, "batch 22 3"]
    field: SceneField | None
    """Solids; None = no window has a scene."""

    def imputed(self, estimate: Float[Tensor, "batch frames 201"]) -> Float[Tensor, "batch frames 201"]:
        """The estimate with the keyframes themselves in their rows."""
        return impute(estimate, self.keys, self.mask)

    def joints_m(self, raw: Float[Tensor, "batch frames 201"]) -> Float[Tensor, "batch frames 22 3"]:
        """Joints of features that are not normalized, by forward kinematics."""
        return joints_of(raw, self.rest_joints_m)


class Baseline:
    """What a method adds to its denoiser, which names this class before its base."""

    sampler: ClassVar[SamplerConfig] = GUIDED

    def steer(self, estimate: Float[Tensor, "batch frames 201"], t: int, target: Target) -> Tensor:
        """The estimate of the clean window at step t as the method corrects it."""
        return estimate


class Context(nn.Module):
    """Diffusion step, body shape and scene as one vector."""

    def __init__(self, config: BaselineConfig, channels: int) -> None:
        super().__init__()
        width = config.embedding
        self.step = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, channels))
        self.body = nn.Linear(BODY_LENGTHS, channels)
        self.scene = nn.Linear(width, channels)
        self.width = width

    def forward(
        self, t: Int[Tensor, "batch"], given: Conditions, scene: Float[Tensor, "batch embedding"]
    ) -> Float[Tensor, "batch channels"]:
        """Sum of the three."""
        return self.step(step_embedding(t, self.width).to(scene)) + self.body(given.body) + self.scene(scene)


def places(tokens: int, channels: int, like: Tensor) -> Float[Tensor, "tokens channels"]:
    """Sines and cosines of the place in time (Vaswani et al. 2017)."""
    return step_embedding(torch.arange(tokens, device=like.device), channels).to(like)


class ImputedSampling(Baseline):
    """A method that knows nothing of keyframes when it is trained; sampling overwrites the estimate with them (Tevet et
    al. 2023, "motion editing")."""

    def steer(self, estimate: Float[Tensor, "batch frames 201"], t: int, target: Target) -> Tensor:
        return target.imputed(estimate)


class BaselineDenoiser(SceneDenoiser):
    """A denoiser whose form is in `window`."""

    def forward(
        self,
        x: Float[Tensor, "batch frames 201"],
        t: Int[Tensor, "batch"],
        given: Conditions,
        estimate: Tensor | None = None,
        prepared: Tensor | None = None,
    ) -> Float[Tensor, "batch frames 201"]:
        """Estimate of the clean window; `estimate` is not used, `prepared` is what `prepare` made of the scene."""
        scene = self.prepare(given) if prepared is None else prepared
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.half_precision):
            return self.window(x, t, given, scene).float()

    def window(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions, scene: Tensor
    ) -> Float[Tensor, "batch frames 201"]:
        """The window by the noisy one, the step, the conditions and the encoded scene."""
        raise NotImplementedError


class HiddenKeyframes(BaselineDenoiser):
    """A denoiser that is not told of keyframes."""

    keyframes = "hidden"
