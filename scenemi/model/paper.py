"""The paper's denoiser as published (3.1, 3.2, Table 5): a U-Net over frames, an occupancy grid around the first
frame, offsets to the scene at keyframes, body shape; it predicts the clean window itself."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT
from scenemi.model.conditions import Conditions, Descriptors, KeyframeInput
from scenemi.model.config import PaperConfig
from scenemi.model.denoiser import step_embedding
from scenemi.model.scene_encoder import SceneEncoder
from scenemi.model.unet import UNet1D

_TOKENS = 2
"""Body shape and global scene are two more frames in time ("concatenated along the temporal dimension")."""


class SceneDenoiser(nn.Module):
    """What denoisers share that see the scene as one vector and predict the window itself, with white noise."""

    keyframes: ClassVar[KeyframeInput] = "imputed"

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        self.half_precision = False
        """Whether matrix products are in bfloat16 (in training, where that is quicker)."""
        self.scene = SceneEncoder(
            config.grid, config.patch, config.scene_width, config.scene_layers, config.scene_heads, config.embedding
        )
        self.no_scene = nn.Parameter(torch.zeros(config.embedding))

    def center(self, given: Conditions) -> Tensor:
        """The paper's forward process is about zero."""
        return torch.zeros_like(given.base)

    def noise(self, white: Float[Tensor, "batch frames 201"], prepared: object) -> Tensor:
        """White noise."""
        return white

    def prepare(self, given: Conditions) -> Tensor:
        """The global scene vector c_g (B, embedding), encoded once for a window; the learned one of no scene where none
        is known."""
        none = self.no_scene.expand(len(given.mask), -1)
        seen: Descriptors | None = given.descriptors
        if seen is None or not self.config.use_global:
            return none
        known = seen.global_known[:, None]
        return known * self.scene(seen.occupancy) + (1 - known) * none


class PaperDenoiser(SceneDenoiser):
    """Predicts x_0 (paper eq. 1)."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__(config)
        embedding, channels = config.embedding, FEATURE_COUNT + 1 + config.local_channels
        self.local = nn.Sequential(
            nn.Linear(3 * config.bps_anchors, config.local_channels), nn.SiLU(),
            nn.Linear(config.local_channels, config.local_channels),
        )  # fmt: skip
        self.step = nn.Sequential(nn.Linear(embedding, embedding), nn.SiLU(), nn.Linear(embedding, embedding))
        self.body = nn.Linear(BODY_LENGTHS, embedding)
        self.tokens = nn.Linear(2 * embedding, _TOKENS * channels)
        self.unet = UNet1D(
            channels, FEATURE_COUNT, width=config.width, multipliers=config.multipliers, embedding=embedding,
            kernel=config.kernel, groups=config.groups,
        )  # fmt: skip

    def forward(
        self,
        x: Float[Tensor, "batch frames 201"],
        t: Int[Tensor, "batch"],
        given: Conditions,
        estimate: Float[Tensor, "batch frames 201"] | None = None,
        prepared: Float[Tensor, "batch embedding"] | None = None,
    ) -> Float[Tensor, "batch frames 201"]:
        """Estimate of the clean window; `estimate` is not used, `prepared` is the encoded scene (`prepare`)."""
        config, frames = self.config, x.shape[1]
        mask = given.mask[..., None]
        near = x.new_zeros(*x.shape[:2], config.local_channels)
        if given.descriptors is not None and config.use_local:
            known = mask * given.descriptors.local_known[:, None, None]
            near = self.local(given.descriptors.local_m.flatten(2)) * known
        scene = self.prepare(given) if prepared is None else prepared
        body = self.body(given.body) if config.use_body else torch.zeros_like(scene)
        tokens = self.tokens(torch.cat([body, scene], -1)).unflatten(1, (_TOKENS, -1))
        wide = torch.cat([tokens, torch.cat([x, mask, near], -1)], 1).transpose(1, 2)
        missing = -wide.shape[2] % 2 ** (len(config.multipliers) - 1)
        embedding = functional.silu(self.step(step_embedding(t, config.embedding).to(x)))
        with torch.autocast(wide.device.type, torch.bfloat16, enabled=self.half_precision):
            out = self.unet(functional.pad(wide, (0, missing)), embedding).float()
        return out[..., _TOKENS : _TOKENS + frames].transpose(1, 2)
