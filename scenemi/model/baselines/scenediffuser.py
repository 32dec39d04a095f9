"""SceneDiffuser (Huang et al., CVPR 2023): generation in a scene, guided by optimization when it is sampled.

Frames attend to each other and to the tokens of the scene; at every step of sampling the gradient of an objective
moves the estimate. Simplified: the scene is the paper's grid of occupied voxels, not a point cloud; of the objectives
there is that against collision, between solids and the joints and middles of the limbs in place of the skin; keyframes
are imputed in place of a planner's goal; diffusion step and body shape are a token.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT
from scenemi.model.baselines.base import PLAIN, HiddenKeyframes, ImputedSampling, Target, places
from scenemi.model.conditions import Conditions
from scenemi.model.config import BaselineConfig
from scenemi.model.denoiser import body_points, step_embedding
from scenemi.model.diffusion import CosineSchedule


class SceneDiffuser(ImputedSampling, HiddenKeyframes):
    """Predicts x_0 from x_t, the step and the tokens of the scene."""

    sampler = PLAIN
    """The scene is always seen: there is no guidance without classifier."""

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        width = config.embedding
        self.step = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, config.channels))
        self.body = nn.Linear(BODY_LENGTHS, config.channels)
        self.around = nn.Linear(width, config.channels)
        self.enter = nn.Linear(FEATURE_COUNT, config.channels)
        self.layers = nn.ModuleList(
            nn.TransformerDecoderLayer(
                config.channels, config.heads, 2 * config.channels, dropout=0.0, activation="gelu", batch_first=True,
                norm_first=True,
            )
            for _ in range(config.layers)
        )  # fmt: skip
        self.leave = nn.Sequential(nn.LayerNorm(config.channels), nn.Linear(config.channels, FEATURE_COUNT))
        self.schedule = CosineSchedule()

    def prepare(self, given: Conditions) -> Float[Tensor, "batch tokens embedding"]:
        """Tokens of the scene; the learned one of no scene where none is known."""
        none = self.no_scene.expand(len(given.mask), 1, -1)
        seen = given.descriptors
        if seen is None:
            return none
        known = seen.global_known[:, None, None]
        return known * self.scene.out(self.scene.tokens(seen.occupancy)) + (1 - known) * none

    def window(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions, scene: Tensor
    ) -> Float[Tensor, "batch frames 201"]:
        first = self.step(step_embedding(t, self.config.embedding).to(x)) + self.body(given.body)
        tokens, around = torch.cat([first[:, None], self.enter(x)], 1), self.around(scene)
        tokens = tokens + places(tokens.shape[1], tokens.shape[2], tokens)
        for layer in self.layers:
            tokens = layer(tokens, around)
        return self.leave(tokens[:, 1:])

    def steer(self, estimate: Float[Tensor, "batch frames 201"], t: int, target: Target) -> Tensor:
        """A step along the gradient that leads out of solids, smaller as the noise is (their algorithm 1, where the
        variance of a step scales it); then the keyframes."""
        share = 1 - float(self.schedule.alpha_bar[t])
        return target.imputed(estimate + share * (way_out(estimate, target) - estimate))


def way_out(estimate: Float[Tensor, "batch frames 201"], target: Target) -> Float[Tensor, "batch frames 201"]:
    """The estimate after one step of gradient descent on the depth of points of the body in solids.

    The step is one of meters and 6D entries. Half the mean square over the points that are inside is descended in each
    frame, so that a body as deep everywhere comes out at once.
    """
    if target.field is None:
        return estimate
    raw = target.statistics.denormalize(estimate)
    with torch.enable_grad():
        moved = raw.detach().requires_grad_()
        points = body_points(target.joints_m(moved))
        distance_m, out = target.field.query(points.detach().flatten(1, 2))
        depth_m = functional.relu(-distance_m).unflatten(1, points.shape[1:3])
        count = (depth_m > 0).sum(-1, keepdim=True).clamp(min=1)
        # Depth falls along the way out; its own gradient is that direction.
        pull = -(depth_m / count)[..., None] * out.unflatten(1, points.shape[1:3])
        (slope,) = torch.autograd.grad((points * pull).sum(), moved)
    return target.statistics.normalize(raw - slope)
