"""The training loop of the lifter: its end is not known, so the rate stays and an average is what leaves."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from video2anim.artifacts.checkpoint import read_checkpoint, write_checkpoint
from video2anim.humans.lifter_input import ERROR_OUTPUTS
from video2anim.lab.lifter.network import LifterNetwork
from video2anim.lab.lifter.objective import losses, measures
from video2anim.lab.lifter.samples import LiftingBatch, LiftingSampler

CHECKPOINT, PROGRESS = "lifter.safetensors", "progress.json"
_TYPICAL_ERROR_M = 0.05
_JUDGED = "pa_mpjpe_mm"
"""The measure by which the validation is said to have improved."""


@dataclass(frozen=True, slots=True)
class LiftingConfig:
    """One training."""

    batch: int = 32
    learning_rate: float = 1e-3
    warmup: int = 300
    """Steps in which the rate rises, and after which the average reaches its full length."""
    ema: float = 0.9995
    seed: int = 0
    save_minutes: float = 4.0
    """Time between checkpoints, each with a validation."""
    bfloat16: bool | None = None
    """Convolutions in bfloat16 (three times as fast where the processor knows it); by default what is quicker here."""


@dataclass(slots=True)
class Progress:
    """What `progress.json` says of a run."""

    steps: int = 0
    windows: int = 0
    hours: float = 0.0
    windows_per_s: float = 0.0
    """Of the time since the last start, validation included."""
    validation: dict[str, float] = field(default_factory=dict)
    best: float = math.inf
    """Least validation `pa_mpjpe_mm`."""
    improved_at_hours: float = 0.0
    """When the validation was best."""


def train(
    sampler: LiftingSampler,
    held_out: LiftingSampler,
    config: LiftingConfig,
    folder: Path,
    *,
    minutes: float | None = None,
    start: LifterNetwork | None = None,
    on_line: Callable[[str], None] = lambda text: None,
) -> LifterNetwork:
    """Train, or go on from the folder's checkpoint, for some minutes or until interrupted; answers the average.

    Args:
        start: weights to begin with where there is no checkpoint.
    """
    torch.manual_seed(config.seed)
    network, average, optimizer, progress = _state(folder, sampler, config, start)
    tests = [held_out.batch(number, 32) for number in range(6)]
    half = config.bfloat16 if config.bfloat16 is not None else _bfloat16_is_quicker(network, tests[0])
    started = saved = time.monotonic()
    before_hours, first = progress.hours, progress.steps
    while True:
        now = time.monotonic()
        done = minutes is not None and now - started > 60 * minutes
        if done or now - saved > 60 * config.save_minutes:
            _judge(progress, average, tests)
            seconds = time.monotonic() - started
            progress.hours = before_hours + seconds / 3600
            progress.windows_per_s = (progress.steps - first) * config.batch / max(seconds, 1e-6)
            if progress.validation[_JUDGED] <= progress.best:
                progress.best, progress.improved_at_hours = progress.validation[_JUDGED], progress.hours
            write_checkpoint(folder / CHECKPOINT, {"network": network, "average": average}, optimizer, progress.steps)
            _write_progress(folder, progress)
            on_line(describe(progress))
            saved = time.monotonic()
        if done:
            return average
        _step(network, optimizer, sampler.batch(progress.steps, config.batch), half, _rate(progress.steps, config))
        progress.steps += 1
        progress.windows += config.batch
        _average(average, network, min(config.ema, (progress.steps + 1) / (progress.steps + 10)))


def cooled(sampler: LiftingSampler, config: LiftingConfig, folder: Path, *, steps: int) -> LifterNetwork:
    """The network after so many more steps in which the rate falls to nothing; the run itself is left as it is."""
    network, _, optimizer, progress = _state(folder, sampler, config, None)
    half = config.bfloat16 if config.bfloat16 is not None else _bfloat16_is_quicker(network, sampler.batch(0, 32))
    average = copy.deepcopy(network)
    for number in range(steps):
        rate = config.learning_rate * (1 - number / steps)
        _step(network, optimizer, sampler.batch(progress.steps + number, config.batch), half, rate)
        _average(average, network, min(config.ema, (number + 1) / (number + 10)))
    return average


def describe(progress: Progress) -> str:
    """One line about a run."""
    numbers = " ".join(f"{name} {value:.3g}" for name, value in progress.validation.items())
    return (
        f"{progress.steps} steps, {progress.windows} windows, {progress.hours:.2f} h, "
        f"{progress.windows_per_s:.0f} windows/s | {numbers} | best at {progress.improved_at_hours:.2f} h"
    )


def read_progress(folder: Path) -> Progress:
    """What the run in a folder has done so far."""
    path = folder / PROGRESS
    return Progress(**json.loads(path.read_text())) if path.is_file() else Progress()


def read_average(folder: Path) -> LifterNetwork:
    """The averaged network of a run."""
    average = LifterNetwork()
    read_checkpoint(folder / CHECKPOINT, {"average": average})
    return average


def _state(
    folder: Path, sampler: LiftingSampler, config: LiftingConfig, start: LifterNetwork | None
) -> tuple[LifterNetwork, LifterNetwork, torch.optim.Optimizer, Progress]:
    """Network, average, optimizer and progress, as the checkpoint has them or fresh."""
    network, average = LifterNetwork(), LifterNetwork()
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=0.01)
    if (folder / CHECKPOINT).is_file():
        progress = read_progress(folder)
        networks = {"network": network, "average": average}
        progress.steps = read_checkpoint(folder / CHECKPOINT, networks, optimizer)
        return network, average, optimizer, progress
    if start is not None:
        network.load_state_dict(start.state_dict())
    else:
        _normalize(network, sampler)
    average.load_state_dict(network.state_dict())
    return network, average, optimizer, Progress()


def _step(
    network: LifterNetwork, optimizer: torch.optim.Optimizer, batch: LiftingBatch, half: bool, rate: float
) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        output = network(batch.features)
    loss = torch.stack(list(losses(output.float(), batch).values())).sum()
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimizer.step()


@torch.no_grad()
def _average(average: nn.Module, network: nn.Module, keep: float) -> None:
    for mean, now in zip(average.parameters(), network.parameters(), strict=True):
        mean.lerp_(now, 1 - keep)


def _rate(step: int, config: LiftingConfig) -> float:
    return config.learning_rate * min(1.0, (step + 1) / config.warmup)


@torch.no_grad()
def _judge(progress: Progress, average: LifterNetwork, tests: list[LiftingBatch]) -> None:
    rows = [measures(average(test.features), test) for test in tests]
    progress.validation = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _bfloat16_is_quicker(network: LifterNetwork, batch: LiftingBatch) -> bool:
    """Times a step's network both ways, the second time of each."""
    times = {}
    for half in (False, True, False, True):
        begun = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            output: Tensor = network(batch.features)
        output.float().sum().backward()
        times[half] = time.perf_counter() - begun
    network.zero_grad()
    return times[True] < times[False]


def _write_progress(folder: Path, progress: Progress) -> None:
    aside = folder / f".{PROGRESS}"
    aside.write_text(json.dumps(asdict(progress), indent=1) + "\n")
    aside.replace(folder / PROGRESS)


def _normalize(network: LifterNetwork, sampler: LiftingSampler) -> None:
    """Statistics of inputs and middle answers from a first batch."""
    batch = sampler.batch(10**9, 128)
    flat = batch.features.flatten(0, 1)
    flat = flat[flat[:, -1] > 0]
    network.mean.copy_(flat.mean(0))
    network.deviation.copy_(flat.std(0).clamp_min(0.02))
    network.mean[-1], network.deviation[-1] = 0.0, 1.0
    network.base[:132] = batch.rot6d.reshape(-1, 132).mean(0)
    network.base[132] = batch.log_size.mean()
    network.base[133:135] = batch.pelvis_m[..., :2].reshape(-1, 2).mean(0)
    network.base[ERROR_OUTPUTS] = math.log(_TYPICAL_ERROR_M)
    network.base[-3:] = batch.up.reshape(-1, 3).mean(0)
