"""Keyframes joined by learned curves: interpolation, and what a network knows of how people move between poses.

For the frames between two neighboring keyframes the network reads these two and the `NEIGHBORS` - 1 before and after,
relative to the place and heading of the left one, and answers a few harmonics of the correction to the cubic curve. It
costs a thousandth of a sampled window, so it sees many more segments in the same time than a denoiser does, and gives
the expected motion; the denoiser then has to add only what is not expected: detail, noise taken out, the scene.
(Harvey et al. 2020 and Oreshkin et al. 2023 predict in-betweens from the keyframes around; harmonics that vanish at
both ends keep the curve on the keyframes.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT, JOINTS
from scenemi.model.heading import from_heading, headings, to_heading

NEIGHBORS = 2
"""Keyframes read on each side of a segment."""
KEYS = 2 * NEIGHBORS
INPUTS = (2 * KEYS - 1) * FEATURE_COUNT + 3 * KEYS + BODY_LENGTHS + 1
"""Poses, speeds between them, times, their logarithms, which exist, body lengths, noise level."""
LEAST_SPAN = 5
"""Between keyframes nearer than this (in frames) interpolation is as good."""
LONGEST = 120
"""Frames from keyframe to keyframe in a window of 121."""
_FPS = 30.0
_REACH = 5.0
"""Inputs farther from the mean than this many deviations tell no more."""


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Pairs of neighboring keyframes."""

    window: Int[Tensor, "segments"]
    keyframes: Int[Tensor, "segments 4"]
    """Frame numbers; the pair is in the middle. Where there is no further keyframe, the outermost again."""
    known: Bool[Tensor, "segments 4"]
    """False for such repetitions."""

    @property
    def left(self) -> Int[Tensor, "segments"]:
        """First keyframe of the pair."""
        return self.keyframes[:, NEIGHBORS - 1]

    @property
    def span(self) -> Int[Tensor, "segments"]:
        """Frames from the first to the second."""
        return self.keyframes[:, NEIGHBORS] - self.left

    def chosen(self, index: Tensor) -> Segments:
        """Some of them."""
        return Segments(self.window[index], self.keyframes[index], self.known[index])


def find_segments(mask: Float[Tensor, "batch frames"]) -> Segments:
    """All segments of at least `LEAST_SPAN` frames, by window and then by time."""
    window, frame = torch.nonzero(mask > 0, as_tuple=True)
    row = torch.arange(len(window), device=mask.device)
    begin = torch.searchsorted(window, window)
    end = torch.searchsorted(window, window, right=True) - 1
    offsets = torch.arange(1 - NEIGHBORS, NEIGHBORS + 1, device=mask.device)
    wanted = row[:, None] + offsets
    held = wanted.clamp(min=begin[:, None], max=end[:, None])
    following = (row + 1).clamp(max=max(0, len(row) - 1))
    inside = (row < end) & (frame[following] - frame >= LEAST_SPAN)
    return Segments(window[inside], frame[held][inside], (wanted == held)[inside])


class KeyframeJoiner(nn.Module):
    """Corrections to interpolation. Features are denormalized here, in the canonical frame of each window."""

    input_mean: Tensor
    input_std: Tensor
    scale: Tensor

    def __init__(self, width: int, blocks: int = 3, harmonics: int = 6, dropout: float = 0.2) -> None:
        super().__init__()
        self.harmonics = harmonics
        self.first = nn.Linear(INPUTS, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Dropout(dropout), nn.Linear(width, width)
            )
            for _ in range(blocks)
        )
        self.norm = nn.LayerNorm(width)
        self.last = nn.Linear(width, harmonics * FEATURE_COUNT)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.register_buffer("input_mean", torch.zeros(INPUTS))
        self.register_buffer("input_std", torch.ones(INPUTS))
        self.register_buffer("scale", torch.ones(LONGEST // 2 + 1, FEATURE_COUNT))
        """How far interpolation is off at a distance from the keyframes, in the heading of the body."""

    def read(
        self,
        keys: Float[Tensor, "batch frames 201"],
        segments: Segments,
        body: Float[Tensor, "batch 7"],
        noise_level: Float[Tensor, "batch"],
    ) -> tuple[Float[Tensor, "segments inputs"], Float[Tensor, "segments 1 2"]]:
        """What the network reads of each segment, and the heading of its left keyframe."""
        poses = keys[segments.window[:, None], segments.keyframes]
        left = poses[:, NEIGHBORS - 1 : NEIGHBORS]
        heading = headings(left)
        place = torch.zeros_like(left)
        place[..., 0], place[..., 2] = left[..., 0], left[..., 2]
        place[..., JOINTS.start :: 3], place[..., JOINTS.start + 2 :: 3] = left[..., :1], left[..., 2:3]
        poses = to_heading(poses - place, heading.expand(-1, KEYS, -1))
        known = segments.known.to(keys.dtype)[..., None]
        apart = segments.keyframes.diff(dim=1).clamp(min=1).to(keys.dtype)[..., None]
        speeds = poses.diff(dim=1) * (_FPS / apart) * known[:, 1:] * known[:, :-1]
        seconds = (segments.keyframes - segments.left[:, None]).to(keys.dtype) / _FPS * known[..., 0]
        scale = (seconds.abs() + 1 / _FPS).log() * known[..., 0]
        parts = [
            (poses * known).flatten(1), speeds.flatten(1), seconds, scale, known[..., 0], body[segments.window],
            noise_level[segments.window, None],
        ]  # fmt: skip
        return torch.cat(parts, 1), heading

    def curves(self, inputs: Float[Tensor, "segments inputs"], span: Int[Tensor, "segments"]) -> Tensor:
        """Harmonics (S, K, 201) of the correction, in the heading of the left keyframe."""
        h = self.first(((inputs - self.input_mean) / self.input_std).clamp(-_REACH, _REACH))
        for block in self.blocks:
            h = h + block(h)
        made = self.last(functional.silu(self.norm(h))).unflatten(1, (self.harmonics, FEATURE_COUNT))
        return made * self.scale[(span // 2).clamp(max=len(self.scale) - 1)][:, None]

    def basis(self, phase: Float[Tensor, "frames"]) -> Float[Tensor, "frames harmonics"]:
        """Sines that vanish at both keyframes (phase 0 and 1)."""
        return torch.sin(math.pi * phase[:, None] * torch.arange(1, self.harmonics + 1, device=phase.device))

    def forward(
        self,
        keys: Float[Tensor, "batch frames 201"],
        mask: Float[Tensor, "batch frames"],
        body: Float[Tensor, "batch 7"],
        noise_level: Float[Tensor, "batch"],
    ) -> Float[Tensor, "batch frames 201"]:
        """Correction of every frame; zero at keyframes, and without a kink there.

        Args:
            keys: features; rows that are no keyframes are not read.
            mask: 1 at keyframes, the first and last frame among them.
            body: normalized body lengths.
            noise_level: l of the keyframes.
        """
        segments = find_segments(mask)
        correction = torch.zeros_like(keys)
        if not len(segments.window):
            return correction
        inputs, heading = self.read(keys, segments, body, noise_level)
        curves = from_heading(self.curves(inputs, segments.span), heading.expand(-1, self.harmonics, -1))
        inside = segments.span - 1
        segment = torch.repeat_interleave(torch.arange(len(inside), device=keys.device), inside)
        nth = torch.arange(len(segment), device=keys.device) - (inside.cumsum(0) - inside)[segment] + 1
        phase = nth / segments.span[segment]
        left, right = self._slope_changes(curves, segments)
        values = self.at(curves, segment, phase)
        values += (phase * (1 - phase) ** 2)[:, None] * left[segment]
        values -= (phase**2 * (1 - phase))[:, None] * right[segment]
        correction[segments.window[segment], segments.left[segment] + nth] = values
        return correction

    def _slope_changes(
        self, curves: Float[Tensor, "segments harmonics 201"], segments: Segments
    ) -> tuple[Float[Tensor, "segments 201"], Float[Tensor, "segments 201"]]:
        """What to add to the slopes (per segment) of the corrections at left and right ends, so that neighbors agree.

        Two segments meet in the mean of their slopes; beside one that is too short for a correction the slope is 0.
        """
        order = torch.arange(1, self.harmonics + 1, device=curves.device)
        rise = math.pi * order.to(curves.dtype)[:, None] * curves
        span = segments.span[:, None].to(curves.dtype)
        left, right = rise.sum(1) / span, (rise * (1 - 2 * (order % 2))[:, None]).sum(1) / span
        meets = (segments.window[1:] == segments.window[:-1]) & (
            segments.keyframes[1:, NEIGHBORS - 1] == segments.keyframes[:-1, NEIGHBORS]
        )
        middle = (left[1:] + right[:-1]) / 2
        ends = (~segments.known[:, NEIGHBORS - 2, None], ~segments.known[:, NEIGHBORS + 1, None])
        wanted = [torch.where(end, slope, 0.0) for end, slope in zip(ends, (left, right), strict=True)]
        wanted[0][1:] = torch.where(meets[:, None], middle, wanted[0][1:])
        wanted[1][:-1] = torch.where(meets[:, None], middle, wanted[1][:-1])
        return (wanted[0] - left) * span, (wanted[1] - right) * span

    def at(self, curves: Tensor, segment: Int[Tensor, "frames"], phase: Float[Tensor, "frames"]) -> Tensor:
        """Values (F, 201) of segments' curves at phases."""
        return (self.basis(phase)[:, :, None] * curves[segment]).sum(1)
