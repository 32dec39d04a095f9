"""The denoiser D(x_t, t, tau): noisy window and conditions to the clean window (paper 3.2).

The diffusion process runs over what the joined keyframes miss: in the heading of each frame of theirs, in units of the
error that they make at that distance from a keyframe, with noise that is correlated over time as that error is. Noise
and signal then have the same covariance, so no step t is trivial. The scene enters in every frame as the distance of
solids from the joints of the current estimate and the direction out of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT, JOINTS
from scenemi.model.conditions import Conditions, since_and_until
from scenemi.model.config import ModelConfig
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.heading import VIEW, from_heading, headings, to_heading, view
from scenemi.model.transformer import Transformer
from scenemi.scene.field import REACH_M
from scenemi.windows import WINDOW_FRAMES
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES

# Shapes: B windows, N frames, F = 201 features, P points of the body asked for in the scene

MAX_FRAMES = (WINDOW_FRAMES - 1) // 2
"""Longest distance from a keyframe in a window of 121 frames."""
SCALES = {
    "residual_std": (MAX_FRAMES + 1, FEATURE_COUNT), "noise_std": (2, FEATURE_COUNT),
    "correlate": (WINDOW_FRAMES, WINDOW_FRAMES),
    "view_mean": (VIEW,), "view_std": (VIEW,), "feature_mean": (FEATURE_COUNT,), "feature_std": (FEATURE_COUNT,),
}  # fmt: skip
"""Measured before training (`scenemi.training.scales`), kept with the weights."""
LIMBS = tuple(
    (JOINT_INDEX[f"{side}_{a}"], JOINT_INDEX[f"{side}_{b}"])
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)
"""A thin post fits between the joints of these: their middles are asked too."""
POINTS = len(JOINT_NAMES) + len(LIMBS)
_MIN_SCALE = 0.01
"""Least scale of a residual, in standard deviations: at exact keyframes there is none."""
_MAX_INPUT = 6.0
"""Inputs are clipped to this many standard deviations."""
_MIN_DEVIATION = 0.03
"""Least standard deviation of an input: high frequencies of what hardly changes are not amplified."""
_STEP_CHANNELS = 128
"""Of the sines and cosines of the step: more than tell a thousand steps apart (not measured)."""


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """What follows from the conditions alone and is the same at every step."""

    heading: Float[Tensor, "batch frames 2"]
    scale: Float[Tensor, "batch frames 201"]
    """How far the truth may be from the joined keyframes."""
    seen: Float[Tensor, "batch frames channels"]
    """The joined keyframes as the moving body sees them, and which frames are given how exactly."""


class Denoiser(nn.Module):
    """Predicts x_0 (paper eq. 1)."""

    residual_std: Tensor
    noise_std: Tensor
    correlate: Tensor
    """Symmetric root of the residual's correlation over time: of white noise it makes noise that is correlated so."""
    view_mean: Tensor
    view_std: Tensor
    feature_mean: Tensor
    feature_std: Tensor
    alpha_bar: Tensor
    cosines: Tensor
    overlap: Tensor
    token_mean: Tensor
    token_std: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.half_precision = False
        """Whether matrix products are in bfloat16 (in training, where that is quicker)."""
        for name, shape in SCALES.items():
            self.register_buffer(name, torch.eye(*shape) if name == "correlate" else torch.ones(shape))
        schedule = torch.as_tensor(CosineSchedule().alpha_bar, dtype=torch.float32)
        schedule[-1] = 0.0  # at t = T nothing is seen of x_t: the first estimate is the same whatever the noise
        self.register_buffer("alpha_bar", schedule, persistent=False)
        self.register_buffer("cosines", cosines(config.fold), persistent=False)
        self.register_buffer("overlap", overlapping(config.tokens, config.fold), persistent=False)
        of_frame = FEATURE_COUNT + VIEW + 66 + 5 + (4 * POINTS if config.scene else 0)
        self.register_buffer("token_mean", torch.zeros(config.fold, of_frame))
        self.register_buffer("token_std", torch.ones(config.fold, of_frame))
        self.step = nn.Sequential(
            nn.Linear(_STEP_CHANNELS, config.embedding), nn.SiLU(), nn.Linear(config.embedding, config.embedding)
        )
        self.body = nn.Linear(BODY_LENGTHS, config.embedding)
        self.network = Transformer(
            of_frame * config.fold, FEATURE_COUNT * config.fold, width=config.width, layers=config.layers,
            heads=config.heads, tokens=config.tokens, embedding=config.embedding,
        )  # fmt: skip

    def forward(
        self,
        x: Float[Tensor, "batch frames 201"],
        t: Int[Tensor, "batch"],
        given: Conditions,
        estimate: Float[Tensor, "batch frames 201"] | None = None,
        prepared: Prepared | None = None,
    ) -> Float[Tensor, "batch frames 201"]:
        """Estimate of the clean window.

        Args:
            x: noisy window with keyframes imputed, normalized.
            t: diffusion step, 1 to T.
            given: conditions.
            estimate: the last estimate of the clean window; None = the joined keyframes.
            prepared: `prepare(given)`, where it is at hand.
        """
        prepared = prepared or self.prepare(given)
        linear = self._linear(x, t, given, prepared)
        embedding = self.step(step_embedding(t, _STEP_CHANNELS).to(x)) + self.body(given.body)
        tokens = (self._tokens(linear, given, estimate, prepared) - self.token_mean) / self.token_std
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.half_precision):
            found = self.network(tokens.clamp(-_MAX_INPUT, _MAX_INPUT).flatten(2), embedding).float()
        out = linear + (1 - self.alpha_bar[t][:, None, None]).sqrt() * self._frames(found, x.shape[1])
        return given.base + from_heading(prepared.scale * out, prepared.heading)

    def inputs(
        self, x: Tensor, t: Int[Tensor, "batch"], given: Conditions, estimate: Tensor | None, prepared: Prepared
    ) -> Float[Tensor, "batch tokens fold channels"]:
        """What the network reads, before it is brought to mean 0 and deviation 1; see `forward`."""
        return self._tokens(self._linear(x, t, given, prepared), given, estimate, prepared)

    def center(self, given: Conditions) -> Float[Tensor, "batch frames 201"]:
        """x_t = center + sqrt(alpha_bar) (x_0 - center) + sqrt(1 - alpha_bar) noise."""
        return given.base

    def noise(self, white: Float[Tensor, "batch frames 201"], prepared: Prepared | None) -> Tensor:
        """Noise of the forward process from independent unit Gaussians."""
        assert prepared is not None
        frames = white.shape[1]
        return from_heading(prepared.scale * (self.correlate[:frames, :frames] @ white), prepared.heading)

    def prepare(self, given: Conditions) -> Prepared:
        """What steps have in common."""
        raw = given.base * self.feature_std + self.feature_mean
        heading = headings(raw)
        known = given.mask[..., None]
        seen = [(view(raw, heading) - self.view_mean) / self.view_std, known, known * torch.log1p(given.noise)]
        seen.append(since_and_until(given.mask) / MAX_FRAMES)
        return Prepared(heading, self.scales(given), torch.cat(seen, -1))

    def scales(self, given: Conditions) -> Float[Tensor, "batch frames 201"]:
        """How far the truth may be from the joined keyframes: normalized, in their heading, at least a hundredth."""
        apart = since_and_until(given.mask)
        between = self.residual_std[apart.amin(-1).clamp(max=MAX_FRAMES)]
        noise = _joined(given.noise.square(), apart) @ self.noise_std.square()
        return (between**2 + noise + _MIN_SCALE**2).sqrt()

    def set_scales(self, measured: Mapping[str, Tensor]) -> None:
        """What `scenemi.training.scales` measured, by the names of `SCALES`."""
        for name in SCALES:
            self.get_buffer(name).copy_(measured[name])

    def set_input_scales(self, drawn: Float[Tensor, "many tokens fold channels"]) -> None:
        """Mean and deviation of what the network reads, from some `inputs`."""
        self.token_mean.copy_(drawn.mean((0, 1)))
        self.token_std.copy_(drawn.std((0, 1)).clamp(min=_MIN_DEVIATION))

    def _surroundings(
        self, estimate: Tensor, given: Conditions, heading: Float[Tensor, "batch frames 2"]
    ) -> Float[Tensor, "batch frames channels"]:
        """Nearness (1 touching, 0 out of reach) and the way out, at the joints and the middles of the limbs."""
        batch, frames = estimate.shape[:2]
        if given.field is None:
            return estimate.new_zeros(batch, frames, 4 * POINTS)
        joints_m = (estimate * self.feature_std + self.feature_mean)[..., JOINTS].unflatten(-1, (22, 3))
        distance_m, out = given.field.query(body_points(joints_m).flatten(1, 2))
        near = 1 - distance_m / REACH_M
        x, y, z = (near[..., None] * out).reshape(batch, frames, POINTS, 3).unbind(-1)
        hx, hz = heading[..., :1], heading[..., 1:]
        return torch.cat([near.reshape(batch, frames, POINTS), x * hz - z * hx, y, z * hz + x * hx], -1)

    def _linear(self, x: Tensor, t: Int[Tensor, "batch"], given: Conditions, prepared: Prepared) -> Tensor:
        """The best linear estimate from x_t alone, as residual and noise have the same covariance; the network corrects
        it (Karras et al. 2022, table 1, for a variance-preserving process). It vanishes where all is noise."""
        off = to_heading(x - given.base, prepared.heading) / prepared.scale
        return torch.where(given.imputed[..., None] > 0, 0.0, self.alpha_bar[t][:, None, None].sqrt() * off)

    def _tokens(
        self, linear: Tensor, given: Conditions, estimate: Tensor | None, prepared: Prepared
    ) -> Float[Tensor, "batch tokens fold channels"]:
        """Cosine transform over the frames of each token. Neighboring frames are alike: in frequencies, each at its own
        size, gradient descent learns nearly twice as fast as in frames."""
        config = self.config
        estimate = given.base if estimate is None else estimate
        moved = to_heading(estimate - given.base, prepared.heading) / prepared.scale
        parts = [linear, moved[..., JOINTS], prepared.seen]
        if config.scene:
            parts.append(self._surroundings(estimate, given, prepared.heading))
        wide = torch.cat(parts, -1)
        rest = config.tokens * config.fold - wide.shape[1]
        wide = torch.cat([wide, wide[:, -1:].expand(-1, rest, -1)], 1)
        return self.cosines @ wide.unflatten(1, (config.tokens, config.fold))

    def _frames(self, found: Float[Tensor, "batch tokens channels"], frames: int) -> Tensor:
        """Residual in units of its scale from the network's answer: frequencies in units of their own sizes."""
        fold = self.config.fold
        root = self.correlate[: 2 * fold]
        low = cosines(2 * fold)[:fold].to(root)
        size = (low @ (root @ root.T) @ low.T).diagonal().sqrt()
        amplitudes = found.unflatten(-1, (fold, FEATURE_COUNT)) * size[:, None]
        return self.overlap[:frames] @ amplitudes.flatten(1, 2)


def _joined(values: Float[Tensor, "batch frames 2"], apart: Int[Tensor, "batch frames 2"]) -> Tensor:
    """Values at keyframes on straight lines to the next one: the joined keyframes are as noisy between as at them."""
    index = torch.arange(values.shape[1], device=values.device)
    before, after = index - apart[..., 0], index + apart[..., 1]
    there = (before >= 0) & (after < len(index))
    share = torch.where(there, apart[..., 0] / apart.sum(-1).clamp(min=1), (before < 0).float())[..., None]
    last, following = (i.clamp(0, len(index) - 1)[..., None].expand(-1, -1, 2) for i in (before, after))
    return (1 - share) * values.gather(1, last) + share * values.gather(1, following)


def cosines(count: int) -> Float[Tensor, "count count"]:
    """The orthonormal cosine transform (DCT-II), a frequency a row."""
    k, n = torch.arange(count)[:, None], torch.arange(count)
    matrix = math.sqrt(2 / count) * torch.cos(math.pi * (n + 0.5) * k / count)
    return torch.where(k == 0, math.sqrt(0.5), 1.0) * matrix


def overlapping(tokens: int, fold: int) -> Float[Tensor, "frames amplitudes"]:
    """Frames from what tokens answer: each the lower half of the frequencies of twice its own frames (up to 6.6 Hz for
    eight frames at 30 fps), weighed by a raised cosine, so that motion has no seams."""
    span = 2 * fold
    weight = torch.sin(math.pi * (torch.arange(span) + 0.5) / span).square()
    made = torch.zeros(tokens * fold + fold, tokens, fold)
    total = torch.zeros(tokens * fold + fold)
    for token in range(tokens):
        frames = slice(token * fold, token * fold + span)
        made[frames, token] = weight[:, None] * cosines(span)[:fold].T
        total[frames] += weight
    return (made / total[:, None, None])[fold // 2 :][: tokens * fold].flatten(1)


def body_points(joints_m: Float[Tensor, "... 22 3"]) -> Float[Tensor, "... points 3"]:
    """Joints and the middles of the limbs."""
    middles = [(joints_m[..., a, :] + joints_m[..., b, :]) / 2 for a, b in LIMBS]
    return torch.cat([joints_m, torch.stack(middles, -2)], -2)


def step_embedding(t: Int[Tensor, "batch"], channels: int) -> Float[Tensor, "batch channels"]:
    """Sines and cosines of the diffusion step (Vaswani et al. 2017)."""
    half = channels // 2
    rates = torch.exp(-math.log(10_000.0) * torch.arange(half, device=t.device) / half)
    angles = t[:, None].float() * rates
    return torch.cat([angles.cos(), angles.sin()], -1)
