"""The denoiser D(x_t, t, tau): noisy window and conditions to the clean window (paper 3.2, Figure 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from scenemi.model.config import ModelConfig
from scenemi.model.scene_encoder import SceneEncoder
from scenemi.model.unet import UNet1D


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """What a batch of windows is made from. Features are normalized, in the canonical frame of each window."""

    mask: Float[Tensor, "batch frames"]
    """1 at keyframes."""
    base: Float[Tensor, "batch frames 201"]
    """The keyframes joined by interpolation (`scenemi.model.base`)."""
    local: Float[Tensor, "batch frames anchors 3"]
    """Offsets from the body's anchors to the nearest solid point, m; read at keyframes only."""
    body: Float[Tensor, "batch 7"]
    """Body lengths in standard deviations."""
    noise_level: Float[Tensor, "batch"]
    """l of the keyframes: 0 = exact, 1 = one degree and one centimeter."""
    scene: Float[Tensor, "batch 512"]
    """What `Denoiser.encode_scene` makes of the occupancy."""
    scene_known: Float[Tensor, "batch"]
    """1, or 0 for no global scene (the empty set of classifier-free guidance)."""
    local_known: Float[Tensor, "batch"]
    """1, or 0 where no local scene is given."""

    def chosen(self, index: Tensor | slice) -> Conditions:
        """Some windows of the batch."""
        return Conditions(*(getattr(self, field.name)[index] for field in fields(self)))

    def joined(self, other: Conditions) -> Conditions:
        """These windows, then others."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return Conditions(*(torch.cat(pair) for pair in pairs))

    def without_global_scene(self) -> Conditions:
        """The same windows with the global scene dropped."""
        return replace(self, scene_known=torch.zeros_like(self.scene_known))


class Denoiser(nn.Module):
    """U-Net over time, conditioned on keyframes, local and global scene, and body shape."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        features, embedding = config.feature_count, config.embedding
        channels = features + 1
        if config.use_local:
            self.local = nn.Sequential(
                nn.Linear(3 * config.bps_anchors + 1, 2 * config.local_channels),
                nn.SiLU(),
                nn.Linear(2 * config.local_channels, config.local_channels),
            )
            channels += config.local_channels
        if config.residual:
            channels += features
        if config.noise_channel:
            channels += 1
        if config.use_global:
            self.scene = SceneEncoder(
                config.grid, config.patch, config.scene_width, config.scene_layers, config.scene_heads, embedding
            )
            self.no_scene = nn.Parameter(torch.zeros(embedding))
        self.step = nn.Sequential(nn.Linear(embedding, embedding), nn.SiLU(), nn.Linear(embedding, embedding))
        self.body = nn.Linear(config.body_lengths, embedding)
        if config.condition != "adagn":
            self.tokens = nn.Linear(2 * embedding, 2 * channels)
        self.unet = UNet1D(
            channels,
            features,
            width=config.width,
            multipliers=config.multipliers,
            embedding=embedding,
            kernel=config.kernel,
            groups=config.groups,
            dropout=config.dropout,
        )

    def encode_scene(self, occupancy: Float[Tensor, "batch x y z"]) -> Float[Tensor, "batch embedding"]:
        """The global scene vector c_g; zeros for a model without one."""
        if not self.config.use_global:
            return occupancy.new_zeros(occupancy.shape[0], self.config.embedding)
        return self.scene(occupancy)

    def forward(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions
    ) -> Float[Tensor, "batch frames 201"]:
        """Estimate of the clean window.

        Args:
            x: noisy window with keyframes imputed, normalized.
            t: diffusion step, 1 to T.
            given: conditions.
        """
        config, frames = self.config, x.shape[1]
        mask = given.mask[..., None]
        parts = [x, mask]
        if config.use_local:
            near = torch.cat([given.local.flatten(2), torch.ones_like(mask)], -1)
            parts.append(self.local(near) * mask * given.local_known[:, None, None])
        if config.residual:
            parts.append(given.base)
        if config.noise_channel:
            parts.append(mask * given.noise_level[:, None, None])
        wide = torch.cat(parts, -1).transpose(1, 2)

        body = self.body(given.body) if config.use_body else torch.zeros_like(given.scene)
        embedding = self.step(step_embedding(t, config.embedding).to(x.dtype))
        scene = torch.zeros_like(embedding)
        if config.use_global:
            known = given.scene_known[:, None]
            scene = known * given.scene + (1 - known) * self.no_scene
        lead = 0
        if config.condition != "adagn":
            tokens = self.tokens(torch.cat([body, scene], -1)).reshape(-1, wide.shape[1], 2)
            wide, lead = torch.cat([tokens, wide], -1), 2
        if config.condition != "token":
            embedding = embedding + body + scene
        multiple = 2 ** (len(config.multipliers) - 1)
        missing = -(lead + frames) % multiple
        wide = functional.pad(wide, (0, missing))
        out = self.unet(wide, functional.silu(embedding))[..., lead : lead + frames].transpose(1, 2)
        return given.base + out if config.residual else out


def step_embedding(t: Int[Tensor, "batch"], channels: int) -> Float[Tensor, "batch channels"]:
    """Sines and cosines of the diffusion step (Vaswani et al. 2017)."""
    half = channels // 2
    rates = torch.exp(-math.log(10_000.0) * torch.arange(half, device=t.device) / half)
    angles = t[:, None].float() * rates
    return torch.cat([angles.cos(), angles.sin()], -1)


def impute(
    x: Float[Tensor, "batch frames 201"], keys: Float[Tensor, "batch frames 201"], mask: Float[Tensor, "batch frames"]
) -> Float[Tensor, "batch frames 201"]:
    """Keyframe values in place of the noisy ones (paper 3.2: x' = m * s + (1 - m) * x)."""
    return torch.where(mask[..., None] > 0, keys, x)
