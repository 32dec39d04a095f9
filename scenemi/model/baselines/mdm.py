"""MDM: Human Motion Diffusion Model (Tevet et al., ICLR 2023), with keyframes imputed when it is sampled.

A transformer encoder with a token for each frame and one for the condition; it predicts the clean motion. Simplified:
the condition is scene and body shape in place of text; layers normalize before attention, which trains at the learning
rate that all methods here share; no dropout; losses on joints and their velocity, none on foot contact.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from scenemi.features import FEATURE_COUNT
from scenemi.model.baselines.base import Context, HiddenKeyframes, ImputedSampling, places
from scenemi.model.conditions import Conditions
from scenemi.model.config import BaselineConfig


def encoder_layers(config: BaselineConfig) -> nn.ModuleList:
    """Of a transformer over frames; the hidden layer is twice as wide, as in MDM."""
    return nn.ModuleList(
        nn.TransformerEncoderLayer(
            config.channels, config.heads, 2 * config.channels, dropout=0.0, activation="gelu", batch_first=True,
            norm_first=True,
        )
        for _ in range(config.layers)
    )  # fmt: skip


class Mdm(ImputedSampling, HiddenKeyframes):
    """Predicts x_0 from x_t, the step and the scene."""

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.context = Context(config, config.channels)
        self.enter = nn.Linear(FEATURE_COUNT, config.channels)
        self.layers = encoder_layers(config)
        self.leave = nn.Sequential(nn.LayerNorm(config.channels), nn.Linear(config.channels, FEATURE_COUNT))

    def window(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions, scene: Tensor
    ) -> Float[Tensor, "batch frames 201"]:
        tokens = torch.cat([self.context(t, given, scene)[:, None], self.enter(x)], 1)
        tokens = tokens + places(tokens.shape[1], tokens.shape[2], tokens)
        for layer in self.layers:
            tokens = layer(tokens)
        return self.leave(tokens[:, 1:])
