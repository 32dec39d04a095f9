"""Training of the learned interpolation (`scenemi.model.joiner`), before the denoiser's.

Members are trained on different parts of the clips: member k sees none of part k. The denoiser is trained over member
k's curves for clips of part k, so it learns to correct curves of motion that the curves' network has not seen, as it
must in use; there all members are averaged.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from scenemi.data.windows import MotionSet
from scenemi.features import FEATURE_COUNT, JOINTS, TRANSLATION, Statistics, body_lengths
from scenemi.model.base import join_keyframes
from scenemi.model.heading import to_heading
from scenemi.model.joiner import KeyframeJoiner, Segments, find_segments
from scenemi.model.keyframe_smoothing import smooth_keyframes
from scenemi.training.batches import parts_of
from scenemi.training.config import TrainConfig
from scenemi.training.keyframe_masks import draw_sparse_mask
from scenemi.training.keyframe_noise import measured_noise, with_noise
from scenemi.training.losses import residual_size, robust
from video2anim.errors import InputError

_SEGMENTS, _FRAMES = 400, 6
"""Segments of a step, and frames compared in each."""
_LONG_ENOUGH = 12.0
"""Segments of so many frames and more are all used; of shorter ones, a share: there interpolation is good already."""
_LEAST_METRES, _LEAST_6D = 0.01, 0.01
"""Errors below these need not become smaller."""
_LEAST_INPUT_STD = 0.05
_MEASURED_BATCHES = 8
_DRAWN = 96
"""Windows of the pool that are made at once."""
_WARMUP, _COOLDOWN = 50, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class JoinerBatch:
    """Windows in the canonical frame, denormalized."""

    x0: Float[Tensor, "batch frames 201"]
    keys: Float[Tensor, "batch frames 201"]
    """With noise where the window has noisy keyframes, smoothed as `Denoiser.join` does."""
    mask: Float[Tensor, "batch frames"]
    body: Float[Tensor, "batch 7"]
    noise_level: Float[Tensor, "batch"]


@dataclass(frozen=True, slots=True, eq=False)
class JoinerPool:
    """Windows drawn once, in the canonical frame: making them takes longer than a step of so small a network. Keyframes
    and the size of the noise are drawn anew whenever a window is used."""

    x0: Float[Tensor, "windows frames 201"]
    noise: Float[Tensor, "windows frames 201"]
    """What noise of l = 1 adds, float16; in proportion for smaller l, as angles are small."""
    valid: Bool[np.ndarray, "windows frames"]
    body: Float[Tensor, "windows 7"]
    """Normalized."""
    part: Int[np.ndarray, "windows"]
    """Of the clip."""
    noise_std: Float[Tensor, "201"]
    """Size of the noise of l = 1."""

    @classmethod
    def draw(cls, motions: MotionSet, statistics: Statistics, config: TrainConfig) -> JoinerPool:
        """`config.joiner_windows` windows; they depend on the seed alone."""
        lengths = [statistics.normalize_body(body_lengths(motions.body(i))) for i in range(len(motions.shapes))]
        clip_part = parts_of(motions.store.clip_name, max(1, config.model.members))
        total, frames = config.joiner_windows, motions.config.frames
        x0 = torch.empty(total, frames, FEATURE_COUNT)
        noise = torch.empty(total, frames, FEATURE_COUNT, dtype=torch.float16)
        valid, part = np.empty((total, frames), bool), np.empty(total, np.int64)
        body = torch.empty(total, len(lengths[0]))
        for start in range(0, total, _DRAWN):
            some = slice(start, min(start + _DRAWN, total))
            rng = np.random.default_rng([config.seed, 0x701E, start])
            windows = motions.sample_batch(rng, some.stop - start)
            x0[some], added = with_noise(windows, motions, rng)
            noise[some] = added.half()
            valid[some], part[some] = windows.valid, clip_part[windows.clip]
            body[some] = torch.from_numpy(np.stack(lengths)[windows.body_index].astype(np.float32))
        return cls(x0, noise, valid, body, part, measured_noise(motions, config.seed))

    def seen_by(self, member: int) -> Int[np.ndarray, "seen"]:
        """Windows that a member is trained on: all but those of its part, or all where that leaves none."""
        others = np.flatnonzero(self.part != member)
        return others if len(others) else np.arange(len(self.part))


class JoinerBatches:
    """The batch of each step of one member."""

    def __init__(self, pool: JoinerPool, config: TrainConfig, member: int) -> None:
        self.pool, self.config, self.member = pool, config, member
        self.seen = pool.seen_by(member)

    def __getitem__(self, step: int) -> JoinerBatch:
        """Everything random comes from (seed, member, step)."""
        config, pool = self.config, self.pool
        rng = np.random.default_rng([config.seed, 0x701E, self.member, step])
        count = min(config.joiner_batch, len(self.seen))
        rows = self.seen[rng.choice(len(self.seen), count, replace=False)]
        frames = pool.x0.shape[1]
        masks = [draw_sparse_mask(rng, frames) | ~pool.valid[row] for row in rows]
        mask = torch.from_numpy(np.stack(masks).astype(np.float32))
        level = np.where(rng.random(count) < config.noisy_share, rng.random(count), 0.0).astype(np.float32)
        index = torch.from_numpy(rows)
        x0 = pool.x0[index]
        keys, noisy = x0.clone(), torch.from_numpy(np.flatnonzero(level))
        sizes = torch.from_numpy(level)[noisy, None]
        keys[noisy] += sizes[..., None] * pool.noise[index[noisy]].float()
        if config.model.smooths and len(noisy):
            keys[noisy] = smooth_keyframes(keys[noisy], mask[noisy], sizes * pool.noise_std)
        return JoinerBatch(x0=x0, keys=keys, mask=mask, body=pool.body[index], noise_level=torch.from_numpy(level))


def train_joiner(
    pool: JoinerPool,
    config: TrainConfig,
    member: int,
    *,
    device: str = "cpu",
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> KeyframeJoiner:
    """One member, averaged over the last steps.

    Args:
        pool: training windows.
        config: `joiner_*`, seed, keyframes and noise.
        member: which part of the clips it does not see.
        device: of torch.
        on_step: called with the step and its loss.
    """
    torch.manual_seed(config.seed * 1000 + member)
    model = KeyframeJoiner(config.model.joiner_width)
    data = JoinerBatches(pool, config, member)
    _measure(model, [data[config.joiner_steps + i] for i in range(_MEASURED_BATCHES)])
    model = model.to(device)
    average = {name: value.clone() for name, value in model.state_dict().items()}
    optimizer = torch.optim.AdamW(
        model.parameters(), config.joiner_rate, betas=(0.9, 0.99), weight_decay=config.joiner_decay
    )
    generator = torch.Generator().manual_seed(config.seed * 1000 + member)
    steps = config.joiner_steps
    for step in range(steps):
        batch = data[step]
        rate = min(1.0, (step + 1) / _WARMUP, (steps - step) / (_COOLDOWN * steps))
        for group in optimizer.param_groups:
            group["lr"] = config.joiner_rate * rate
        moved = JoinerBatch(*(getattr(batch, name).to(device) for name in batch.__slots__))
        loss = joiner_loss(model, moved, generator)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip_norm)
        optimizer.step()
        decay = min(0.995, (step + 1) / (step + 10))
        with torch.no_grad():
            for name, value in model.state_dict().items():
                average[name].lerp_(value, 1 - decay)
        on_step(step + 1, float(loss.detach()))
    model.load_state_dict(average)
    return model.cpu().eval()


_RULING = ("joiner_steps", "joiner_windows", "joiner_batch", "joiner_rate", "joiner_decay", "seed", "bodies",
           "noisy_share", "synthetic_share", "reverse", "mix", "noncommercial")  # fmt: skip


def _ruling(config: TrainConfig) -> str:
    """What decides a member, as text."""
    values = {name: getattr(config, name) for name in _RULING}
    model = config.model
    return json.dumps(values | {"joiners": model.joiners, "width": model.joiner_width, "smooths": model.smooths})


def save_joiner(path: Path, joiner: KeyframeJoiner, config: TrainConfig) -> None:
    """Write one trained member."""
    tensors = {name: value.cpu().contiguous() for name, value in joiner.state_dict().items()}
    aside = path.with_suffix(".partial")
    save_file(tensors, str(aside), {"config": _ruling(config)})
    os.replace(aside, path)


def holds_joiner(path: Path, config: TrainConfig) -> bool:
    """Whether a file is a member of this configuration."""
    try:
        with safe_open(str(path), "pt") as file:
            return bool((file.metadata() or {}).get("config") == _ruling(config))
    except (OSError, SafetensorError):
        return False


def load_joiner(path: Path) -> dict[str, Tensor]:
    """State of a member.

    Raises:
        InputError: the file is missing or broken.
    """
    try:
        return load_file(str(path))
    except (OSError, SafetensorError) as error:
        raise InputError(f"training: cannot read {path}: {error}") from error


def joiner_loss(model: KeyframeJoiner, batch: JoinerBatch, generator: torch.Generator) -> Tensor:
    """Error of some frames of some segments, relative to interpolation's at the same distance from the keyframes."""
    segments = _some(find_segments(batch.mask), generator)
    inputs, heading = model.read(batch.keys, segments, batch.body, batch.noise_level)
    curves = model.curves(inputs, segments.span)
    inside = (segments.span - 1)[:, None]
    nth = 1 + (torch.rand(len(inside), _FRAMES, generator=generator).to(inside.device) * inside).long()
    frame = (segments.left[:, None] + nth).flatten()
    segment = torch.arange(len(inside), device=nth.device).repeat_interleave(_FRAMES)
    window = segments.window[segment]
    made = model.at(curves, segment, nth.flatten() / segments.span[segment])
    with torch.no_grad():
        off = (batch.x0 - join_keyframes(batch.keys, batch.mask))[window, frame]
        off = to_heading(off, heading[segment, 0])
        apart = torch.minimum(nth, inside + 1 - nth).flatten()
        size = model.scale[apart.clamp(max=len(model.scale) - 1)].square() + _least(off) ** 2
        joint_size = size[:, JOINTS].unflatten(1, (22, 3)).sum(-1).mean(-1, keepdim=True)
    error = (made - off).square()
    joints = error[:, JOINTS].unflatten(1, (22, 3)).sum(-1)
    return robust(error / size).mean() + robust(joints / joint_size).mean()


def _least(like: Tensor) -> Tensor:
    values = like.new_full((like.shape[-1],), _LEAST_METRES)
    values[TRANSLATION.stop : JOINTS.start] = _LEAST_6D
    return values


def _some(segments: Segments, generator: torch.Generator) -> Segments:
    """At most `_SEGMENTS`, long ones first."""
    count = len(segments.window)
    draw = torch.rand(count, generator=generator).to(segments.span.device)
    kept = torch.nonzero(draw < segments.span / _LONG_ENOUGH)[:, 0]
    if not len(kept):
        return segments
    order = torch.randperm(len(kept), generator=generator)[:_SEGMENTS].to(kept.device)
    return segments.chosen(kept[order])


@torch.no_grad()
def _measure(model: KeyframeJoiner, batches: list[JoinerBatch]) -> None:
    """Set the sizes that inputs and answers are counted in."""
    inputs = [model.read(batch.keys, find_segments(batch.mask), batch.body, batch.noise_level)[0] for batch in batches]
    every = torch.cat(inputs)
    model.input_mean.copy_(every.mean(0))
    model.input_std.copy_(every.std(0).clamp(min=_LEAST_INPUT_STD))
    triples = [(batch.x0, join_keyframes(batch.keys, batch.mask), batch.mask) for batch in batches]
    model.scale.copy_(residual_size(triples))
