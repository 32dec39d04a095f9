"""1D U-Net over time with adaptive group normalization (paper 3.2, after Karunratanakul et al. 2023)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


class ResidualBlock(nn.Module):
    """Two convolutions; the embedding scales and shifts the second normalization (AdaGN, Dhariwal & Nichol 2021)."""

    def __init__(self, channels_in: int, channels: int, embedding: int, kernel: int, groups: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, channels_in)
        self.conv1 = nn.Conv1d(channels_in, channels, kernel, padding=kernel // 2)
        self.modulation = nn.Linear(embedding, 2 * channels)
        self.norm2 = nn.GroupNorm(groups, channels)
        self.conv2 = nn.Conv1d(channels, channels, kernel, padding=kernel // 2)
        self.skip = nn.Identity() if channels_in == channels else nn.Conv1d(channels_in, channels, 1)
        _zero(self.conv2)

    def forward(
        self, x: Float[Tensor, "batch channels frames"], embedding: Float[Tensor, "batch embedding"]
    ) -> Float[Tensor, "batch out frames"]:
        """The block's input plus its correction."""
        h = self.conv1(functional.silu(self.norm1(x)))
        scale, shift = self.modulation(embedding)[..., None].chunk(2, dim=1)
        h = functional.silu(self.norm2(h) * (1 + scale) + shift)
        return self.skip(x) + self.conv2(h)


def _zero(layer: nn.Conv1d) -> None:
    """A correction that begins at nothing."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)


class UNet1D(nn.Module):
    """Levels of two residual blocks; each level below the first has half the frames. Frames must divide by
    2 ** (levels - 1)."""

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        *,
        width: int,
        multipliers: tuple[int, ...],
        embedding: int,
        kernel: int,
        groups: int,
    ) -> None:
        super().__init__()

        def block(a: int, b: int) -> ResidualBlock:
            return ResidualBlock(a, b, embedding, kernel, groups)

        channels = [width * m for m in multipliers]
        self.first = nn.Conv1d(channels_in, channels[0], kernel, padding=kernel // 2)
        self.down, self.shrink = nn.ModuleList(), nn.ModuleList()
        before = channels[0]
        for level, count in enumerate(channels):
            self.down.append(nn.ModuleList([block(before, count), block(count, count)]))
            last = level == len(channels) - 1
            self.shrink.append(nn.Identity() if last else nn.Conv1d(count, count, 3, stride=2, padding=1))
            before = count
        self.center = nn.ModuleList([block(before, before), block(before, before)])
        self.up, self.grow = nn.ModuleList(), nn.ModuleList()
        for level, count in reversed(list(enumerate(channels))):
            self.up.append(nn.ModuleList([block(before + count, count), block(count, count)]))
            self.grow.append(nn.Identity() if level == 0 else nn.ConvTranspose1d(count, count, 4, stride=2, padding=1))
            before = count
        self.norm = nn.GroupNorm(groups, before)
        self.last = nn.Conv1d(before, channels_out, kernel, padding=kernel // 2)
        _zero(self.last)

    def forward(
        self, x: Float[Tensor, "batch channels frames"], embedding: Float[Tensor, "batch embedding"]
    ) -> Float[Tensor, "batch out frames"]:
        """Output with as many frames as the input."""
        x = self.first(x)
        kept: list[Tensor] = []
        for blocks, shrink in zip(self.down, self.shrink, strict=True):
            for block in blocks:  # type: ignore[attr-defined]
                x = block(x, embedding)
            kept.append(x)
            x = shrink(x)
        for block in self.center:
            x = block(x, embedding)
        for blocks, grow in zip(self.up, self.grow, strict=True):
            x = torch.cat([x, kept.pop()], 1)
            for block in blocks:  # type: ignore[attr-defined]
                x = block(x, embedding)
            x = grow(x)
        return self.last(functional.silu(self.norm(x)))
