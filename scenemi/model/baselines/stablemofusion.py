"""StableMoFusion (Huang et al., ACM MM 2024): a 1D U-Net as the denoiser, with keyframes imputed when it is sampled.

Residual convolutions over frames with adaptive group normalization, a moving average of the weights and DPM-Solver++.
Simplified: step, body shape and scene reach all blocks through the normalization and there is no cross-attention,
which the paper has for the words of a text; its removal of foot skating after sampling is left out.
"""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from scenemi.features import FEATURE_COUNT
from scenemi.model.baselines.base import Context, HiddenKeyframes, ImputedSampling
from scenemi.model.conditions import Conditions
from scenemi.model.config import BaselineConfig
from scenemi.model.unet import UNet1D


class StableMoFusion(ImputedSampling, HiddenKeyframes):
    """Predicts x_0 from x_t, the step and the scene."""

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.context = Context(config, config.embedding)
        self.unet = UNet1D(
            FEATURE_COUNT, FEATURE_COUNT, width=config.width, multipliers=config.multipliers,
            embedding=config.embedding, kernel=config.kernel, groups=config.groups,
        )  # fmt: skip
        self.halvings = len(config.multipliers) - 1

    def window(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions, scene: Tensor
    ) -> Float[Tensor, "batch frames 201"]:
        frames = x.shape[1]
        wide = functional.pad(x.transpose(1, 2), (0, -frames % 2**self.halvings))
        out = self.unet(wide, functional.silu(self.context(t, given, scene)))
        return out[..., :frames].transpose(1, 2)
