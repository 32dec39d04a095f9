"""The room network: one convolutional encoder with global attention, one decoder, several heads.

EfficientNet-Lite0 down to 1/32 of the image size, attention over the coarsest cells (Vaswani et al. 2017), because
perspective depends on the whole image, and a feature pyramid back up (Lin et al. 2017).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from video2anim.lab.scene_network.encoder import MEAN_RGB, STD_RGB, WIDTHS, Encoder
from video2anim.networks.room_net import OUTPUTS

DECODED = (48, 80, 128)
"""Channels of the decoder at scales 1/4, 1/8 and 1/16."""
TOP = 256
"""Channels of the coarsest cells, on which attention works."""
PIXEL_CHANNELS = sum(OUTPUTS.values()) - OUTPUTS["camera"]
ATTENTION_LAYERS, HEADS = 3, 8


class RoomAnswer(NamedTuple):
    """Raw outputs; pixel heads at half the image size, the camera head at 1/8."""

    disparity: Float[Tensor, "batch 1 rows columns"]
    """Inverse depth up to one scale and offset per picture; larger is nearer."""
    normal: Float[Tensor, "batch 3 rows columns"]
    """Surface normal in the camera frame, not normalized."""
    classes: Float[Tensor, "batch 6 rows columns"]
    """Logits of `CLASSES`."""
    instance: Float[Tensor, "batch 4 rows columns"]
    """Logit of an object's center, offset to it (x, y in image heights), logit of a boundary."""
    camera: Float[Tensor, "batch 5 coarse_rows coarse_columns"]
    """Up direction (x, y), latitude in radians, log of the expected errors of both in radians."""


class _Attention(nn.Module):
    """Pre-norm transformer layer over cells; a depthwise convolution encodes positions (Chu et al. 2021)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.place = nn.Conv2d(channels, channels, 3, padding=1, groups=channels)
        self.norms = nn.ModuleList([nn.LayerNorm(channels) for _ in range(2)])
        self.mix = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)
        self.wide = nn.Linear(channels, 3 * channels)
        self.narrow = nn.Linear(3 * channels, channels)
        self.heads = heads

    def forward(self, x: Tensor) -> Tensor:
        batch, channels, rows, columns = x.shape
        x = x + self.place(x)
        cells = x.flatten(2).transpose(1, 2)
        parts = self.mix(self.norms[0](cells)).reshape(batch, rows * columns, 3, self.heads, channels // self.heads)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        weight = torch.softmax(query @ key.transpose(-1, -2) * (channels // self.heads) ** -0.5, -1)
        cells = cells + self.out((weight @ value).transpose(1, 2).reshape(batch, rows * columns, channels))
        cells = cells + self.narrow(functional.gelu(self.wide(self.norms[1](cells))))
        return cells.transpose(1, 2).reshape(batch, channels, rows, columns)


class RoomNetwork(nn.Module):
    """Image to `RoomAnswer`; height and width must be multiples of 32."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.enter = _conv(WIDTHS[-1], TOP, size=1, active=False)
        self.attention = nn.Sequential(*(_Attention(TOP, HEADS) for _ in range(ATTENTION_LAYERS)))
        above = (*DECODED[1:], TOP)
        widths = WIDTHS[1:-1]
        self.lateral = nn.ModuleList([_conv(w, d, size=1, active=False) for w, d in zip(widths, DECODED, strict=True)])
        self.lower = nn.ModuleList([_conv(a, d, size=1, active=False) for a, d in zip(above, DECODED, strict=True)])
        self.merge = nn.ModuleList([nn.Sequential(_conv(d, d), _conv(d, d)) for d in DECODED])
        self.pixels = nn.Conv2d(DECODED[0], 4 * PIXEL_CHANNELS, 1)
        self.edges = nn.Conv2d(WIDTHS[0], PIXEL_CHANNELS, 3, padding=1)
        self.shuffle = nn.PixelShuffle(2)
        self.camera = nn.Sequential(_conv(DECODED[1], 64), nn.Conv2d(64, 5, 1))

    def forward(self, picture: Float[Tensor, "batch 3 height width"]) -> RoomAnswer:
        """`picture` is RGB in 0 to 255."""
        half, *kept, coarse = self.encoder((picture - MEAN_RGB) / STD_RGB)
        x = self.attention(self.enter(coarse))
        camera = None
        for level in (2, 1, 0):
            lower = functional.interpolate(self.lower[level](x), scale_factor=2.0, mode="nearest")
            x = self.merge[level](functional.relu(lower + self.lateral[level](kept[level])))
            if level == 1:
                camera = self.camera(x)
        assert camera is not None
        pixels = self.shuffle(self.pixels(x)) + self.edges(half)
        return RoomAnswer(pixels[:, :1], pixels[:, 1:4], pixels[:, 4:10], pixels[:, 10:14], camera)


def _conv(inputs: int, outputs: int, *, stride: int = 1, size: int = 3, active: bool = True) -> nn.Sequential:
    layers: list[nn.Module] = [
        nn.Conv2d(inputs, outputs, size, stride, padding=size // 2, bias=False),
        nn.BatchNorm2d(outputs),
    ]
    return nn.Sequential(*layers, nn.ReLU()) if active else nn.Sequential(*layers)


def normalized_convolutions(network: nn.Module) -> list[tuple[str, nn.Sequential, int]]:
    """Every convolution followed by batch normalization: its name, the `Sequential` of both, its index there."""
    return [
        (f"{name}.{number}", module, number)
        for name, module in network.named_modules()
        if isinstance(module, nn.Sequential)
        for number in range(len(module) - 1)
        if isinstance(module[number], nn.Conv2d) and isinstance(module[number + 1], nn.BatchNorm2d)
    ]
