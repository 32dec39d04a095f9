"""Degraded images for training: random color, light, texture, blur, noise and compression, a batch at once."""

from __future__ import annotations

import functools

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

RANDOM_FILTERS = 0.3
"""Share of images that are mixed with a random convolution of themselves (Xu et al. 2021), which changes local texture
and keeps shapes, as photographs differ from renderings. Not measured."""
BLUR_RADIUS = 4
"""In pixels: three standard deviations of the widest blur."""
_LUMINANCE = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51,
    87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121, 120, 101,
    72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
"""Quantization table of luminance in JPEG (ITU-T T.81, annex K)."""


def degraded(picture: Float[Tensor, "batch 3 height width"], random: torch.Generator) -> Tensor:
    """The images, RGB in 0 to 255, each with its own draws of everything."""
    draw = _Draws(len(picture), picture.device, random)
    value = picture / 255
    gray = value.mean(1, keepdim=True)
    value = gray + (value - gray) * torch.where(draw.chance(0.05), 0.0, draw.uniform(0.4, 1.6))
    value = value * torch.exp(0.08 * draw.normal(3))
    value = ((value - 0.5) * draw.uniform(0.65, 1.35) + 0.5 + 0.08 * draw.normal()).clamp(0, 1)
    value = value ** torch.exp(0.25 * draw.normal())
    value = torch.where(draw.chance(0.25), turned_hue(value, draw.uniform(0, 2 * torch.pi)), value).clamp(0, 1)
    value = torch.where(draw.chance(RANDOM_FILTERS), _filtered(value, draw), value)
    value = torch.where(draw.chance(0.4), _blurred(value, draw.uniform(0.3, 1.3)), value)
    value = value + torch.where(draw.chance(0.5), draw.uniform(0, 0.05), 0.0) * draw.like(value)
    value = 255 * value.clamp(0, 1)
    value = torch.where(draw.chance(0.35), compressed(value, draw.uniform(25, 95)), value)
    return value.clamp(0, 255).round()


class _Draws:
    """Random numbers for each image, as (batch, 1 or channels, 1, 1)."""

    def __init__(self, batch: int, device: torch.device, random: torch.Generator) -> None:
        self._shape, self._device, self._random = (batch, 1, 1, 1), device, random

    def uniform(self, low: float, high: float) -> Tensor:
        return torch.empty(self._shape, device=self._device).uniform_(low, high, generator=self._random)

    def chance(self, share: float) -> Tensor:
        return self.uniform(0, 1) < share

    def normal(self, *channels: int) -> Tensor:
        shape = (self._shape[0], *(channels or (1,)), 1, 1)
        return torch.randn(shape, device=self._device, generator=self._random)

    def kernels(self, channels: int, size: int) -> Tensor:
        shape = (self._shape[0] * channels, channels, size, size)
        return torch.randn(shape, device=self._device, generator=self._random)

    def like(self, value: Tensor) -> Tensor:
        return torch.randn(value.shape, device=self._device, generator=self._random)


def turned_hue(value: Float[Tensor, "batch 3 height width"], angle_rad: Float[Tensor, "batch 1 1 1"]) -> Tensor:
    """Colors rotated about the gray axis."""
    angle = angle_rad.reshape(-1)
    cos, sin = torch.cos(angle)[:, None, None], torch.sin(angle)[:, None, None] / 3**0.5
    eye, third = torch.eye(3, device=value.device), torch.full((3, 3), 1 / 3, device=value.device)
    cross = torch.tensor([[0.0, -1, 1], [1, 0, -1], [-1, 1, 0]], device=value.device)
    return torch.einsum("bij,bjhw->bihw", cos * eye + (1 - cos) * third + sin * cross, value)


def _filtered(value: Tensor, draw: _Draws) -> Tensor:
    """A random mix of the image and a random 3x3 convolution of it with the same mean and contrast."""
    batch, channels, height, width = value.shape
    padded = functional.pad(value, (1, 1, 1, 1), mode="replicate").reshape(1, batch * channels, height + 2, width + 2)
    made = functional.conv2d(padded, draw.kernels(channels, 3), groups=batch).reshape(value.shape)
    mean, spread = value.mean((2, 3), keepdim=True), value.std((2, 3), keepdim=True)
    made = (made - made.mean((2, 3), keepdim=True)) / made.std((2, 3), keepdim=True).clamp_min(1e-4) * spread + mean
    return torch.lerp(value, made, draw.uniform(0, 0.7)).clamp(0, 1)


def _blurred(value: Tensor, sigma_px: Tensor) -> Tensor:
    batch, channels, height, _ = value.shape
    at = torch.arange(-BLUR_RADIUS, BLUR_RADIUS + 1, device=value.device)
    kernel = torch.exp(-0.5 * (at / sigma_px.reshape(-1, 1)) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)
    flat = functional.pad(value, (BLUR_RADIUS,) * 4, mode="replicate").reshape(
        1, batch * channels, height + 2 * BLUR_RADIUS, -1
    )
    flat = functional.conv2d(flat, kernel[:, None, None, :], groups=batch * channels)
    return functional.conv2d(flat, kernel[:, None, :, None], groups=batch * channels).reshape(value.shape)


@functools.cache
def _cosines(device: torch.device) -> tuple[Tensor, Tensor]:
    """Basis of the 8-point cosine transform (row per frequency), and the quantization table."""
    k, n = torch.arange(8.0)[:, None], torch.arange(8.0)[None, :]
    basis = torch.cos(torch.pi * (n + 0.5) * k / 8) * torch.where(k == 0, 0.125**0.5, 0.5)
    return basis.to(device), torch.tensor(_LUMINANCE, dtype=torch.float).reshape(8, 8).to(device)


def compressed(
    picture: Float[Tensor, "batch 3 height width"], quality: Float[Tensor, "batch 1 1 1"]
) -> Float[Tensor, "batch 3 height width"]:
    """JPEG's loss: cosine coefficients of 8x8 blocks of each color, rounded to the steps of a quality from 1 to 100."""
    basis, table = _cosines(picture.device)
    scale = torch.where(quality < 50, 50 / quality, 2 - quality / 50)
    step = (table * scale[..., None, None]).clamp_min(1.0)
    batch, channels, height, width = picture.shape
    blocks = (picture - 128).reshape(batch, channels, height // 8, 8, width // 8, 8).transpose(3, 4)
    coefficients = torch.round((basis @ blocks @ basis.T) / step) * step
    return (basis.T @ coefficients @ basis).transpose(3, 4).reshape(picture.shape) + 128
