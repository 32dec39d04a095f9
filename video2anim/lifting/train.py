"""The training loop of the lifter: resumable, and the same for every machine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from video2anim.artifacts.checkpoint import read_checkpoint, write_checkpoint
from video2anim.body.skeleton import forward_kinematics
from video2anim.fitting.lifter_input import CONTACT_OUTPUTS, ERROR_OUTPUTS, LOG_ERROR_RANGE
from video2anim.geometry.rotations import matrix_from_rot6d
from video2anim.lifting.network import LifterNetwork
from video2anim.lifting.samples import LiftingBatch, LiftingSampler

_TYPICAL_ERROR_M = 0.05


@dataclass(frozen=True, slots=True)
class LiftingConfig:
    """One training."""

    steps: int = 9500
    batch: int = 32
    learning_rate: float = 1e-3
    warmup: int = 200
    ema: float = 0.999
    seed: int = 0
    validate_every: int = 500
    minutes: float | None = None
    """Stop (with a checkpoint) after so long, for machines with a time limit."""


def losses(output: Tensor, batch: LiftingBatch) -> dict[str, Tensor]:
    """Weighted terms: metres, radians' worth of 6D, nats."""
    shape = output.shape[:2]
    rot6d = output[..., :132].reshape(*shape, 22, 6)
    R = matrix_from_rot6d(rot6d)
    joints = _posed(R, batch.rest_joints_m)
    off = joints - batch.joints_m
    speed = off.diff(dim=1)
    contact = functional.binary_cross_entropy_with_logits(
        output[..., CONTACT_OUTPUTS], batch.contact, weight=batch.contact_known, reduction="sum"
    ) / batch.contact_known.sum().clamp_min(1.0)
    up = functional.normalize(output[..., -3:], dim=-1)
    # What the network says of its errors must not move its answer, hence detached; least where it is their mean.
    missed, told = off.detach()[..., 1:, :].norm(dim=-1), output[..., ERROR_OUTPUTS][..., 1:].clamp(*LOG_ERROR_RANGE)
    return {
        "joints": 10.0 * off.norm(dim=-1).mean(),
        "error": 0.2 * (missed * torch.exp(-told) + told).mean(),
        "speed": 20.0 * speed.norm(dim=-1).mean(),
        "rotations": 1.0 * (rot6d - batch.rot6d).abs().mean(),
        "size": 2.0 * (output[..., 132] - batch.log_size).abs().mean(),
        "offset": 5.0 * (output[..., 133:135] - batch.offset_m).abs().mean(),
        "contact": 1.0 * contact,
        "up": 2.0 * (up - batch.up).norm(dim=-1).mean(),
    }


def _posed(R: Tensor, rest_joints_m: Tensor) -> Tensor:
    """Joints relative to the pelvis, each window on its own skeleton."""
    return forward_kinematics(R, torch.zeros_like(R[..., 0, :, 0]), rest_joints_m[:, None])[0]


def measures(output: Tensor, batch: LiftingBatch) -> dict[str, float]:
    """What a user would ask: millimetres, degrees, F1 of contacts; errors over those told, and their correlation."""
    R = matrix_from_rot6d(output[..., :132].reshape(*output.shape[:2], 22, 6))
    joints = _posed(R, batch.rest_joints_m)
    up = functional.normalize(output[..., -3:], dim=-1)
    angle = torch.arccos((up * batch.up).sum(-1).clamp(-1, 1)).rad2deg()
    touch, known = output[..., CONTACT_OUTPUTS] > 0, batch.contact_known > 0
    truth = batch.contact > 0.5
    scores = {}
    for name, part in (("feet", slice(0, 4)), ("hands", slice(4, 6)), ("seat", slice(6, 7)), ("back", slice(7, 8))):
        both = (touch & truth & known)[..., part].sum()
        either = (touch & known)[..., part].sum() + (truth & known)[..., part].sum()
        scores[f"f1_{name}"] = float(2 * both / either.clamp_min(1))
    missed = (joints - batch.joints_m).norm(dim=-1)
    told = torch.exp(output[..., ERROR_OUTPUTS].clamp(*LOG_ERROR_RANGE))
    return {
        "mpjpe_mm": 1000 * float(missed.mean()),
        "error_told": float((missed / told)[..., 1:].mean()),
        "error_known": float(torch.corrcoef(torch.stack([missed[..., 1:].flatten(), told[..., 1:].flatten()]))[0, 1]),
        "depth_percent": 100 * float((output[..., 132] - batch.log_size).abs().mean()),
        "up_deg": float(angle.mean()),
        **scores,
    }


def train(
    sampler: LiftingSampler,
    held_out: LiftingSampler,
    config: LiftingConfig,
    checkpoint: Path,
    *,
    on_line: Callable[[str], None] = lambda text: None,
) -> LifterNetwork:
    """Train, or go on from the checkpoint; answers the averaged network."""
    started = time.monotonic()
    torch.manual_seed(config.seed)
    network, average = LifterNetwork(), LifterNetwork()
    networks = {"network": network, "average": average}
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=0.01)
    step = 0
    if checkpoint.is_file():
        step = read_checkpoint(checkpoint, networks, optimizer)
    else:
        _normalize(network, sampler)
        average.load_state_dict(network.state_dict())
    tests = [held_out.batch(number, 32) for number in range(4)]
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(sampler.batch, step, config.batch)
        while step < config.steps:
            batch = coming.result()
            coming = pool.submit(sampler.batch, step + 1, config.batch)
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * _rate(step, config)
            terms = losses(network(batch.features), batch)
            optimizer.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            step += 1
            with torch.no_grad():
                keep = min(config.ema, (step + 1) / (step + 10))
                for mean, now in zip(average.parameters(), network.parameters(), strict=True):
                    mean.lerp_(now, 1 - keep)
            late = config.minutes is not None and time.monotonic() - started > 60 * config.minutes
            if step % config.validate_every == 0 or step == config.steps or late:
                write_checkpoint(checkpoint, networks, optimizer, step)
                with torch.no_grad():
                    rows = [measures(average(test.features), test) for test in tests]
                means = {name: np.mean([row[name] for row in rows]) for name in rows[0]}
                text = " ".join(f"{name} {value:.3g}" for name, value in means.items())
                parts = " ".join(f"{name} {float(value.detach()):.3f}" for name, value in terms.items())
                on_line(f"step {step} | {text} | {parts} | {time.monotonic() - started:.0f} s")
            if late:
                break
    return average


def _rate(step: int, config: LiftingConfig) -> float:
    """Warm-up, then a half cosine to a hundredth."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / config.steps))


def _normalize(network: LifterNetwork, sampler: LiftingSampler) -> None:
    """Statistics of inputs and middle answers from a first batch."""
    batch = sampler.batch(10**9, 64)
    flat = batch.features.reshape(-1, batch.features.shape[-1])
    flat = flat[flat[:, -1] > 0]
    network.mean.copy_(flat.mean(0))
    network.deviation.copy_(flat.std(0).clamp_min(0.02))
    network.mean[-1], network.deviation[-1] = 0.0, 1.0
    network.base[:132] = batch.rot6d.reshape(-1, 132).mean(0)
    network.base[132] = batch.log_size.mean()
    network.base[133:135] = batch.offset_m.reshape(-1, 2).mean(0)
    network.base[ERROR_OUTPUTS] = math.log(_TYPICAL_ERROR_M)
    network.base[-3:] = batch.up.reshape(-1, 3).mean(0)


def read_average(path: Path) -> LifterNetwork:
    """The averaged network of a checkpoint."""
    average = LifterNetwork()
    read_checkpoint(path, {"average": average})
    return average
