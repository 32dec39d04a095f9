"""Synthesizing Long-Term 3D Human Motion and Interaction in 3D Scenes (Wang et al., CVPR 2021): route, then pose.

No diffusion: a first recurrent network predicts place and orientation of the root between two given poses, a second one
the pose along this route; both read the scene. Simplified: the given poses are the keyframes (theirs come from a
conditional variational autoencoder, which has no part in in-betweening); the scene is the paper's grid of voxels, not a
point cloud; both stages are trained together, the second one on the route of the first; their optimization of the whole
motion is left out, as the solve after sampling of this package is where the two are compared.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from scenemi.features import BODY_LENGTHS, BODY_ROTATIONS, FEATURE_COUNT
from scenemi.model.baselines.base import PLAIN, Baseline, BaselineDenoiser
from scenemi.model.conditions import Conditions, since_and_until
from scenemi.model.config import BaselineConfig
from scenemi.model.denoiser import MAX_FRAMES

_ROUTE = BODY_ROTATIONS.start
"""The first features are the route: translation and orientation of the root."""


class Recurrent(nn.Module):
    """Two layers of LSTM over frames, both ways, as in their networks."""

    def __init__(self, channels_in: int, channels: int, channels_out: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(channels_in, channels // 2, num_layers=2, batch_first=True, bidirectional=True)
        self.leave = nn.Linear(2 * (channels // 2), channels_out)

    def forward(self, x: Float[Tensor, "batch frames channels"]) -> Float[Tensor, "batch frames out"]:
        """One answer for each frame."""
        return self.leave(self.lstm(x)[0])


class Wang2021(Baseline, BaselineDenoiser):
    """Predicts the window from its keyframes alone, whatever the noise; one evaluation is all there is to sample."""

    keyframes = "given"
    sampler = replace(PLAIN, steps=1)

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        around = 2 * FEATURE_COUNT + 2 + 2 * config.embedding
        self.body = nn.Linear(BODY_LENGTHS, config.embedding)
        self.route = Recurrent(around, config.channels, _ROUTE)
        self.pose = Recurrent(around + _ROUTE, config.channels, FEATURE_COUNT - _ROUTE)

    def window(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions, scene: Tensor
    ) -> Float[Tensor, "batch frames 201"]:
        context = torch.cat([self.body(given.body), scene], -1)[:, None].expand(-1, x.shape[1], -1)
        known = torch.cat([ends(given), context], -1)
        route = self.route(known)
        pose = self.pose(torch.cat([known, route.detach()], -1))
        return torch.cat([route, pose], -1)


def ends(given: Conditions) -> Float[Tensor, "batch frames 404"]:
    """Of every frame the keyframes before and after it, and how far they are, in units of the longest distance."""
    apart = since_and_until(given.mask)
    index = torch.arange(apart.shape[1], device=apart.device)
    last = (index - apart[..., 0]).clamp(min=0)[..., None].expand(-1, -1, FEATURE_COUNT)
    following = (index + apart[..., 1]).clamp(max=len(index) - 1)[..., None].expand(-1, -1, FEATURE_COUNT)
    return torch.cat([given.base.gather(1, last), given.base.gather(1, following), apart / MAX_FRAMES], -1)
