"""The denoiser D(x_t, t, tau): noisy window and conditions to the clean window (paper 3.2, Figure 2)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from scenemi.features import FEATURE_COUNT
from scenemi.model.base import join_keyframes
from scenemi.model.config import ModelConfig
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.heading import VIEW, from_heading, headings, to_heading, view
from scenemi.model.joiner import KeyframeJoiner
from scenemi.model.keyframe_smoothing import EXACT, smooth_keyframes
from scenemi.model.linear_guess import correlation, linear_guess
from scenemi.model.scene_encoder import SceneEncoder
from scenemi.model.unet import UNet1D

REACH = 60
"""Longest distance from a keyframe in a window of 121 frames."""
TRAINED_NOISE = 1.0
"""The largest l in training (paper 3.2.1); the networks take noisier keyframes for this noisy."""
_LEAST_SCALE = 1e-6
SCALES = {
    "residual_std": (REACH + 1, FEATURE_COUNT), "residual_frames": (2 * REACH + 1,), "keyframe_std": (FEATURE_COUNT,),
    "view_mean": (VIEW,), "view_std": (VIEW,), "feature_mean": (FEATURE_COUNT,), "feature_std": (FEATURE_COUNT,),
}  # fmt: skip
"""Measured before training (`scenemi.training.losses.measure_scales`), kept with the weights."""


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """What a batch of windows is made from. Features are normalized, in the canonical frame of each window."""

    mask: Float[Tensor, "batch frames"]
    """1 at keyframes."""
    imputed: Float[Tensor, "batch frames"]
    """1 where the noisy window holds the keyframe itself: `mask` while t > T*, nowhere below (paper 3.2.1)."""
    base: Float[Tensor, "batch frames 201"]
    """The keyframes joined, without some of their noise (`Denoiser.join`)."""
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
    """U-Net over time, conditioned on keyframes, local and global scene, and body shape.

    With `config.residual`, let b be the joined keyframes, seen by the network as `scenemi.model.heading` says,
    s the size of x_0 - b at a frame's distance from the keyframes. The network answers in units of s, x_0 = b + s F,
    and of x_t it sees g / s, where g is the best linear guess of x_0 - b (`scenemi.model.linear_guess`); of imputed
    keyframes, the noise that was taken out of them. So its inputs and outputs have size 1 at most for every density of
    keyframes, noise does not come in as such, and exact keyframes are returned as they are. (Adding g to the answer,
    in the way of Karras et al. 2022, was tried: the sampled motion is then as varied as independent channels are until
    the network has learnt how they belong together.)
    """

    alpha_bar: Tensor
    residual_std: Tensor
    residual_frames: Tensor
    noise_std: Tensor
    keyframe_std: Tensor
    view_mean: Tensor
    view_std: Tensor
    feature_mean: Tensor
    feature_std: Tensor

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
            channels += VIEW + 2
            self.register_buffer("alpha_bar", torch.from_numpy(CosineSchedule().alpha_bar).float(), persistent=False)
            for name, shape in SCALES.items():
                self.register_buffer(name, torch.zeros(shape) if name.endswith("_mean") else torch.ones(shape))
            if config.smooths:
                self.register_buffer("noise_std", torch.ones(features))
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
        if config.members:
            self.joiners = nn.ModuleList(KeyframeJoiner(config.joiner_width) for _ in range(config.members))
            self.joiners.requires_grad_(False)
        self.unet = UNet1D(
            channels,
            features,
            width=config.width,
            multipliers=config.multipliers,
            embedding=embedding,
            kernel=config.kernel,
            groups=config.groups,
            dropout=config.dropout,
            fold=config.fold,
        )

    @torch.no_grad()
    def join(
        self,
        keys: Float[Tensor, "batch frames 201"],
        mask: Float[Tensor, "batch frames"],
        body: Float[Tensor, "batch 7"],
        noise_level: Float[Tensor, "batch"],
        part: Int[Tensor, "batch"] | None = None,
        exact: Float[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames 201"]:
        """The keyframes joined: b, for `Conditions.base`. Exact at keyframes without noise.

        Args:
            keys: normalized features; rows that are no keyframes are not read.
            mask: 1 at keyframes.
            body: normalized body lengths.
            noise_level: l of the keyframes.
            part: network to use for each window (in training: the one that did not see its clip); None = their mean.
            exact: 1 at keyframes without noise in windows whose others have some.
        """
        keys = self.smoothed_keys(keys, mask, noise_level, exact)
        base = join_keyframes(keys, mask)
        if not self.config.members:
            return base
        raw = torch.where(mask[..., None] > 0, keys, 0) * self.feature_std + self.feature_mean
        correction = torch.zeros_like(base)
        for k, joiner in enumerate(self.joiners):
            rows = torch.arange(len(keys), device=keys.device) if part is None else torch.nonzero(part == k)[:, 0]
            if len(rows):
                made = joiner(raw[rows], mask[rows], body[rows], noise_level[rows].clamp(max=TRAINED_NOISE))
                correction[rows] += made / (len(self.joiners) if part is None else 1)
        return base + correction / self.feature_std

    def smoothed_keys(
        self,
        keys: Float[Tensor, "batch frames 201"],
        mask: Float[Tensor, "batch frames"],
        noise_level: Float[Tensor, "batch"],
        exact: Float[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames 201"]:
        """Noisy keyframes smoothed, exact ones as they are. Arguments as of `join`."""
        noisy = torch.nonzero(noise_level > 0)[:, 0]
        if not self.config.smooths or not len(noisy):
            return keys
        weight = mask[noisy].clone()
        if exact is not None:
            weight[(weight > 0) & (exact[noisy] > 0)] = EXACT
        smooth = keys.clone()
        smooth[noisy] = smooth_keyframes(keys[noisy], weight, noise_level[noisy, None] * self.noise_std)
        return smooth

    def train(self, mode: bool = True) -> Denoiser:
        """Training mode, save for the learned interpolation, which is trained by itself."""
        super().train(mode)
        if self.config.members:
            self.joiners.eval()
        return self

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
        return self.answer(self.guess(x, t, given) if self.config.residual else x, t, given)

    def answer(
        self, seen: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions
    ) -> Float[Tensor, "batch frames 201"]:
        """`forward` from `guess` (or, without `residual`, the noisy window) on: what the network itself does."""
        config, frames = self.config, seen.shape[1]
        mask = given.mask[..., None]
        scale = heading = None
        if config.residual:
            raw = given.base * self.feature_std + self.feature_mean
            scale, heading = self.scales(given), headings(raw)
            parts = [seen / scale.clamp(min=_LEAST_SCALE), mask]
            parts += [(view(raw, heading) - self.view_mean) / self.view_std, gap(given.mask)]
        else:
            parts = [seen, mask]
        if config.use_local:
            near = torch.cat([given.local.flatten(2), torch.ones_like(mask)], -1)
            parts.append(self.local(near) * mask * given.local_known[:, None, None])
        if config.noise_channel:
            parts.append(mask * given.noise_level[:, None, None])
        wide = torch.cat(parts, -1).transpose(1, 2)

        body = self.body(given.body) if config.use_body else torch.zeros_like(given.scene)
        embedding = self.step(step_embedding(t, config.embedding).to(seen.dtype))
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
        multiple = config.fold * 2 ** (len(config.multipliers) - 1)
        missing = -(lead + frames) % multiple
        wide = functional.pad(wide, (0, missing))
        out = self.unet(wide, functional.silu(embedding))[..., lead : lead + frames].transpose(1, 2)
        if config.smooth_output:
            out = smoothed(out)
        if scale is None or heading is None:
            return out
        return given.base + from_heading(scale * out, heading)

    def set_scales(self, measured: Mapping[str, Tensor]) -> None:
        """What training measured, by the names of `SCALES`.

        `residual_std`: size of x_0 - b by distance from the nearest keyframe, and `keyframe_std` at keyframes with
        noise l = 1, both normalized and in the heading of b; mean and deviation of `view` and of the features.
        """
        for name in SCALES:
            self.get_buffer(name).copy_(measured[name])

    def scales(self, given: Conditions) -> Float[Tensor, "batch frames 201"]:
        """s: how far the truth may be from the interpolation."""
        between = self.residual_std[distance_to_keyframes(given.mask).clamp(max=REACH)]
        return (between**2 + (given.noise_level[:, None, None] * self.keyframe_std) ** 2).sqrt()

    @torch.no_grad()
    def guess(
        self, x: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], given: Conditions
    ) -> Float[Tensor, "batch frames 201"]:
        """g: best linear guess of x_0 - b from x_t, in the heading of b; where x_t is the keyframe, its own x_t - b."""
        a = self.alpha_bar[t]
        free = (1 - given.imputed)[..., None]
        heading = headings(given.base * self.feature_std + self.feature_mean)
        share = torch.where(free > 0, a.sqrt()[:, None, None], 1.0)
        off = to_heading(x - share * given.base, heading)
        C = correlation(since_and_until(given.mask).sum(-1), self.residual_frames)
        g = linear_guess(free * off, free * self.scales(given), a, C, self.residual_std.mean(0).argsort())
        if not self.config.smooths:
            return g
        noisy = (given.noise_level > 0)[:, None, None]  # of exact keyframes nothing was taken out but rounding
        return torch.where((free == 0) & noisy, off, g)


def smoothed(values: Float[Tensor, "batch frames channels"]) -> Float[Tensor, "batch frames channels"]:
    """Binomial filter 1 4 6 4 1 over time: passes 0.8 of 3 Hz at 30 fps, and less than a hundredth
    of the energy that white noise has in jerk. The ends are held."""
    for _ in range(2):
        padded = torch.cat([values[:, :1], values, values[:, -1:]], 1)
        values = 0.25 * padded[:, :-2] + 0.5 * padded[:, 1:-1] + 0.25 * padded[:, 2:]
    return values


def gap(mask: Float[Tensor, "batch frames"]) -> Float[Tensor, "batch frames 2"]:
    """Frames since the last keyframe and until the next, as shares of half a window."""
    return since_and_until(mask).to(mask.dtype) / REACH


def distance_to_keyframes(mask: Float[Tensor, "batch frames"]) -> Int[Tensor, "batch frames"]:
    """Frames to the nearest keyframe."""
    return since_and_until(mask).amin(-1)


def since_and_until(mask: Float[Tensor, "batch frames"]) -> Int[Tensor, "batch frames 2"]:
    """Frames since the last keyframe and until the next; the number of frames where there is none."""
    frames = mask.shape[1]
    index = torch.arange(frames, device=mask.device)
    since = index[:, None] - index
    given = mask[:, None] > 0  # compared pair by pair: cumulative extrema have no ONNX operator
    last = torch.where(given & (since >= 0), since, frames).amin(2)
    following = torch.where(given & (since <= 0), -since, frames).amin(2)
    return torch.stack([last, following], -1)


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
