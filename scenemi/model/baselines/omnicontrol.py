"""OmniControl (Xie et al., ICLR 2024): a control branch beside MDM, and guidance toward the given joints.

The branch is a copy of the transformer that reads the control signal too; each of its layers is added to that of the
transformer through a linear layer that begins at zero ("realism guidance"). When sampled, gradient descent moves the
estimate so that its joints come to the given ones ("spatial guidance"). Simplified: both halves are trained together
from the start, as there is no trained MDM to begin from; the control signal is whole poses; guidance takes as many
iterations at all steps as theirs does at the early ones.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from scenemi.features import FEATURE_COUNT
from scenemi.model.baselines.base import Baseline, BaselineDenoiser, Context, Target, places
from scenemi.model.baselines.mdm import encoder_layers
from scenemi.model.conditions import Conditions
from scenemi.model.config import BaselineConfig

_ITERATIONS = 10
"""Steps of the spatial guidance at each step of sampling (their K_e)."""


class OmniControl(Baseline, BaselineDenoiser):
    """Predicts x_0 from x_t, the step, the scene and the poses at keyframes."""

    keyframes = "given"

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        channels = config.channels
        self.context = Context(config, channels)
        self.enter = nn.Linear(FEATURE_COUNT, channels)
        self.control = nn.Linear(FEATURE_COUNT + 1, channels)
        self.layers, self.branch = encoder_layers(config), encoder_layers(config)
        self.bridges = nn.ModuleList(nn.Linear(channels, channels) for _ in range(config.layers))
        for parameter in self.bridges.parameters():
            nn.init.zeros_(parameter)
        self.leave = nn.Sequential(nn.LayerNorm(channels), nn.Linear(channels, FEATURE_COUNT))

    def window(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions, scene: Tensor
    ) -> Float[Tensor, "batch frames 201"]:
        known = given.mask[..., None]
        signal = torch.cat([known * given.base, known], -1)  # the joined keyframes are the keyframes where they are
        first, frames = self.context(t, given, scene)[:, None], self.enter(x)
        tokens = torch.cat([first, frames], 1)
        side = torch.cat([first, frames + self.control(signal)], 1)
        place = places(tokens.shape[1], tokens.shape[2], tokens)
        tokens, side = tokens + place, side + place
        for layer, beside, bridge in zip(self.layers, self.branch, self.bridges, strict=True):
            side = beside(side)
            tokens = layer(tokens) + bridge(side)
        return self.leave(tokens[:, 1:])

    def steer(self, estimate: Float[Tensor, "batch frames 201"], t: int, target: Target) -> Tensor:
        """Gradient descent on half the mean square distance of the joints at keyframes from the given ones, in meters
        and 6D entries: a body that is in another place as a whole comes there at once."""
        raw = target.statistics.denormalize(estimate)
        wanted_m = target.joints_m(target.statistics.denormalize(target.keys))
        for _ in range(_ITERATIONS):
            with torch.enable_grad():
                moved = raw.detach().requires_grad_()
                off = (target.joints_m(moved) - wanted_m).square().sum(-1).mean(-1)
                (slope,) = torch.autograd.grad(0.5 * (off * target.mask).sum(), moved)
            raw = raw - slope
        return target.statistics.normalize(raw)
