"""Losses and the training loop of the room network: resumable, and the same for every machine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from video2anim.artifacts.checkpoint import read_checkpoint, write_checkpoint
from video2anim.lab.scene_network.network import RoomAnswer, RoomNetwork
from video2anim.lab.scene_network.restart import read_exported, settle
from video2anim.lab.scene_network.samples import PictureBatch, PictureShards

SMALL_SIZES = ((128, 192), (128, 160), (160, 160), (192, 128), (96, 192))
LARGE_SIZES = ((192, 256), (160, 288), (192, 192), (256, 192), (224, 288))
"""Heights and widths that batches are drawn from, at first and at last."""
LOG_SIGMA_RANGE = (-5.0, 0.5)
"""Expected errors of the camera head are held in this range (log radians)."""
NEAREST_INVERSE = 1 / 50
"""Inverse depths are held above this: 50 m."""


@dataclass(frozen=True, slots=True)
class PerceptionConfig:
    """One training."""

    steps: int = 8000
    batch: int = 8
    learning_rate: float = 1.5e-3
    encoder_rate: float = 0.25
    """Learning rate of the encoder beside that of the rest."""
    frozen_stages: int = 3
    """Stages of the encoder (with its stem) that stay as they were published."""
    weight_decay: float = 0.02
    warmup: int = 200
    ema: float = 0.998
    large_share: float = 0.15
    """Last share of the steps, at `LARGE_SIZES`."""
    seed: int = 0
    save_every: int = 400
    minutes: float | None = None
    """Stop (with a checkpoint) after so long, for machines with a time limit."""


def losses(answer: RoomAnswer, batch: PictureBatch) -> dict[str, Tensor]:
    """Weighted terms, each about one for an untrained network."""
    seen = (batch.normal.abs().sum(1) > 0).float()
    disparity = disparity_loss(answer.disparity[:, 0], batch.disparity)
    normal = functional.normalize(answer.normal, dim=1)
    flat = ((1 - (normal * batch.normal).sum(1)) * seen).sum() / seen.sum().clamp_min(1)
    heat, offset, boundary = answer.cues[:, 0], answer.cues[:, 1:3], answer.cues[:, 3]
    known = batch.has_offset
    off = ((offset - batch.offset).abs().sum(1) * known).sum() / known.sum().clamp_min(1)
    center = functional.binary_cross_entropy_with_logits(heat, batch.heat, weight=1 + 8 * batch.heat)
    edge = functional.binary_cross_entropy_with_logits(boundary, batch.boundary, pos_weight=torch.tensor(3.0))
    up = functional.normalize(answer.camera[:, :2], dim=1)
    turned = torch.atan2(
        up[:, 0] * batch.up[:, 1] - up[:, 1] * batch.up[:, 0], (up * batch.up).sum(1).clamp(-1 + 1e-6, 1)
    ).abs()
    off_latitude = (answer.camera[:, 2] - batch.latitude).abs()
    sigma = answer.camera[:, 3:5].clamp(*LOG_SIGMA_RANGE)
    return {
        "disparity": 2.0 * disparity + relative_loss(answer.disparity[:, 0], batch.disparity),
        "normal": 1.0 * flat,
        "classes": 0.6 * functional.cross_entropy(answer.classes, batch.classes)
        + 0.5 * overlap_loss(answer.classes, batch.classes),
        "middle": 3.0 * center,
        "offset": 2.0 * off,
        "boundary": 0.3 * edge,
        # Laplace likelihood: the network tells how far off it expects to be.
        "up": 0.15 * (turned * torch.exp(-sigma[:, 0]) + sigma[:, 0]).mean() + 4.0 * turned.mean(),
        "latitude": 0.15 * (off_latitude * torch.exp(-sigma[:, 1]) + sigma[:, 1]).mean() + 6.0 * off_latitude.mean(),
    }


def aligned(disparity: Tensor, truth: Tensor) -> Tensor:
    """Disparity with the scale and offset, per picture, that bring it nearest to the truth (least squares)."""
    x, y = disparity.flatten(1), truth.flatten(1)
    mean_x, mean_y = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
    scale = ((x - mean_x) * (y - mean_y)).mean(1, keepdim=True) / ((x - mean_x) ** 2).mean(1, keepdim=True).clamp_min(
        1e-6
    )
    return (mean_y + scale * (x - mean_x)).reshape(disparity.shape)


def disparity_loss(disparity: Tensor, truth: Tensor) -> Tensor:
    """Error against the truth brought to median 0 and mean deviation 1, with matched gradients at four scales.

    Scale- and shift-invariant as of Ranftl et al. (2022), but the target is normalized, not the answer: aligning an
    answer that says nothing yet has no useful gradient. A second term forgives scale and offset that are a little off.
    """
    median = truth.flatten(1).median(1).values[:, None, None]
    goal = (truth - median) / (truth - median).abs().mean((1, 2), keepdim=True).clamp_min(1e-3)
    off = disparity - goal
    total = 0.5 * off.abs().mean()
    with torch.no_grad():
        factor = (aligned(disparity, goal) - goal.mean((1, 2), keepdim=True)).std((1, 2), keepdim=True)
        factor = (factor / disparity.std((1, 2), keepdim=True).clamp_min(1e-2)).clamp(0.5, 2.0)
        offset = (goal - factor * disparity).mean((1, 2), keepdim=True)
    total = total + 0.5 * (factor * disparity + offset - goal).abs().mean()
    for level in range(4):
        part = off[:, :: 2**level, :: 2**level]
        total = total + 0.25 * (part.diff(dim=1).abs().mean() + part.diff(dim=2).abs().mean())
    return total


def relative_loss(disparity: Tensor, truth: Tensor) -> Tensor:
    """Mean absolute error of log depth after alignment: far objects count by their share, as AbsRel has it."""
    seen = (truth > 0).float()
    near = aligned(disparity, truth).clamp_min(NEAREST_INVERSE)
    off = (near.log() - truth.clamp_min(NEAREST_INVERSE).log()).abs().clamp_max(1.0)
    return (off * seen).sum() / seen.sum().clamp_min(1)


def overlap_loss(logits: Tensor, classes: Tensor) -> Tensor:
    """1 - Dice of each class that a picture shows (Milletari et al. 2016): small areas count as large ones do."""
    share = logits.softmax(1).flatten(2)
    true = functional.one_hot(classes, logits.shape[1]).permute(0, 3, 1, 2).flatten(2).float()
    dice = 2 * (share * true).sum(2) / (share.sum(2) + true.sum(2)).clamp_min(1)
    shown = (true.sum(2) > 0).float()
    return ((1 - dice) * shown).sum() / shown.sum()


@torch.no_grad()
def measures(answer: RoomAnswer, batch: PictureBatch) -> dict[str, float]:
    """What a user would ask: AbsRel and delta of depth, degrees of normals and of the camera's fields, IoU of floor."""
    truth = batch.disparity
    near = aligned(answer.disparity[:, 0], truth)
    seen = truth > 0
    depth, true_depth = 1 / near.clamp_min(NEAREST_INVERSE), 1 / truth.clamp_min(NEAREST_INVERSE)
    ratio = torch.maximum(depth / true_depth, true_depth / depth)[seen]
    normal = functional.normalize(answer.normal, dim=1)
    turned = torch.arccos((normal * batch.normal).sum(1).clamp(-1, 1))[seen].rad2deg()
    up = functional.normalize(answer.camera[:, :2], dim=1)
    up_off = torch.arccos((up * batch.up).sum(1).clamp(-1, 1)).rad2deg()
    classes = answer.classes.argmax(1)
    scores = {}
    for name, number in (("floor", 1), ("furniture", 4), ("person", 5)):
        mine, theirs = classes == number, batch.classes == number
        either = int((mine | theirs).sum())
        scores[f"iou_{name}"] = float((mine & theirs).sum()) / either if either else 1.0
    return {
        "absrel": float(((depth - true_depth).abs() / true_depth)[seen].mean()),
        "delta1": float((ratio < 1.25).float().mean()),
        "normal_deg": float(turned.mean()),
        "up_deg": float(up_off.mean()),
        "latitude_deg": float((answer.camera[:, 2] - batch.latitude).abs().mean().rad2deg()),
        **scores,
    }


def train(
    shards: PictureShards,
    held_out: PictureShards,
    config: PerceptionConfig,
    checkpoint: Path,
    *,
    encoder: Mapping[str, Tensor] | None = None,
    start: Path | None = None,
    device: str = "cpu",
    on_line: Callable[[str], None] = lambda text: None,
) -> RoomNetwork:
    """Train, or go on from the checkpoint; answers the averaged network.

    Args:
        shards: Pictures to learn from.
        held_out: Pictures of other rooms; the first 64 are measured.
        config: How.
        checkpoint: File to go on from and to write.
        encoder: Published weights that the encoder starts from.
        start: File of an earlier training, by `export_onnx`, that the whole network starts from instead.
        device: `cpu` or `cuda`.
        on_line: Called with a line of numbers at every checkpoint.
    """
    started = time.monotonic()
    torch.manual_seed(config.seed)
    network, average = RoomNetwork() if start is None else read_exported(start), RoomNetwork().to(device)
    if start is not None:
        settle(network, shards.batch(0, 4 * config.batch, LARGE_SIZES[0]).picture)
    elif encoder is not None:
        network.encoder.read_published(encoder)
    network = network.to(device)
    if device == "cpu":
        network = network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimizer = _optimizer(network, config)
    networks = {"network": network, "average": average}
    step = read_checkpoint(checkpoint, networks, optimizer) if checkpoint.is_file() else 0
    if step == 0:
        average.load_state_dict(network.state_dict())
    network.train()
    average.eval()
    asked = range(min(len(held_out), 64))
    tests = [held_out.plain(asked[start : start + 32], (192, 256)) for start in range(0, len(asked), 32)]

    def coming(number: int) -> PictureBatch:
        large = number >= (1 - config.large_share) * config.steps
        sizes = LARGE_SIZES if large else SMALL_SIZES
        return shards.batch(number, config.batch, sizes[number % len(sizes)])

    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(coming, step)
        while step < config.steps:
            batch = _on(future.result(), device)
            if step % 50 == 0:
                shards.refresh()
            future = pool.submit(coming, step + 1)
            for group in optimizer.param_groups:
                group["lr"] = group["share"] * config.learning_rate * _rate(step, config)
            terms = losses(network(batch.picture.contiguous(memory_format=torch.channels_last)), batch)
            optimizer.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            step += 1
            _follow(average, network, min(config.ema, (step + 1) / (step + 10)))
            late = config.minutes is not None and time.monotonic() - started > 60 * config.minutes
            if step % config.save_every == 0 or step == config.steps or late:
                write_checkpoint(checkpoint, networks, optimizer, step)
                rows = [_measured(average, test, device) for test in tests]
                text = " ".join(f"{name} {sum(row[name] for row in rows) / len(rows):.3f}" for name in rows[0])
                parts = " ".join(f"{name} {float(value.detach()):.2f}" for name, value in terms.items())
                on_line(f"step {step} of {len(shards)} | {text} | {parts} | {time.monotonic() - started:.0f} s")
            if late:
                break
    return average


def _optimizer(network: RoomNetwork, config: PerceptionConfig) -> torch.optim.Optimizer:
    """AdamW over what is not frozen."""
    network.encoder.stem.requires_grad_(config.frozen_stages == 0)
    for number, stage in enumerate(network.encoder.stages):
        stage.requires_grad_(number >= config.frozen_stages)
    inner = [p for p in network.encoder.parameters() if p.requires_grad]
    known = {id(p) for p in network.encoder.parameters()}
    outer = [p for p in network.parameters() if id(p) not in known]
    groups = [{"params": outer, "share": 1.0}, {"params": inner, "share": config.encoder_rate}]
    return torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay)


def _measured(average: RoomNetwork, test: PictureBatch, device: str) -> dict[str, float]:
    batch = _on(test, device)
    with torch.no_grad():
        return measures(average(batch.picture), batch)


def _on(batch: PictureBatch, device: str) -> PictureBatch:
    return PictureBatch(*(getattr(batch, name).to(device) for name in PictureBatch.__slots__))


@torch.no_grad()
def _follow(average: RoomNetwork, network: RoomNetwork, keep: float) -> None:
    """Move the average a step towards the network; running statistics with it."""
    for mean, now in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.dtype.is_floating_point:
            mean.lerp_(now, 1 - keep)


def _rate(step: int, config: PerceptionConfig) -> float:
    """Warm-up, then a half cosine to a hundredth."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / config.steps))


def read_average(path: Path) -> RoomNetwork:
    """The averaged network of a checkpoint."""
    average = RoomNetwork()
    read_checkpoint(path, {"average": average})
    return average.eval()
