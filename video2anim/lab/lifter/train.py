"""The training loop of the lifter. It has no fixed end: the rate is constant and the averaged weights are exported."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from scenemi.data.files import write_text
from scenemi.training.loop_parts import (
    Stopwatch,
    bfloat16_is_quicker,
    mean_measures,
    measures_text,
    ramped_decay,
    read_networks,
    set_rate,
    take_step,
    update_average,
    warmup,
    write_networks,
)
from video2anim.humans.lifter_input import ERROR_OUTPUTS
from video2anim.lab.lifter.network import LifterNetwork
from video2anim.lab.lifter.objective import losses, measures
from video2anim.lab.lifter.samples import LiftingBatch, LiftingSampler

CHECKPOINT, PROGRESS = "lifter.safetensors", "progress.json"
_TYPICAL_ERROR_M = 0.05
_CRITERION = "pa_mpjpe_mm"
"""The validation measure that decides which checkpoint is best."""


@dataclass(frozen=True, slots=True)
class LiftingConfig:
    """Settings of a training run."""

    batch: int = 32
    learning_rate: float = 1e-3
    warmup: int = 300
    """Steps in which the learning rate rises; also the start of full averaging."""
    ema: float = 0.9995
    seed: int = 0
    save_minutes: float = 4.0
    """Time between checkpoints, each with a validation."""


@dataclass(slots=True)
class Progress:
    """Content of `progress.json`."""

    steps: int = 0
    windows: int = 0
    hours: float = 0.0
    windows_per_s: float = 0.0
    """Mean since the last start, including validation."""
    validation: dict[str, float] = field(default_factory=dict)
    best: float = math.inf
    """Lowest validation `pa_mpjpe_mm`."""
    improved_at_hours: float = 0.0
    """Training time at the best validation."""


def train(
    sampler: LiftingSampler,
    held_out: LiftingSampler,
    config: LiftingConfig,
    folder: Path,
    *,
    minutes: float | None = None,
    stop_at: int | None = None,
    start: LifterNetwork | None = None,
    on_line: Callable[[str], None] = lambda text: None,
) -> LifterNetwork:
    """Train, or continue from the folder's checkpoint, until a limit or an interrupt. Returns the averaged network.

    Args:
        sampler: Training batches.
        held_out: Validation batches.
        config: Settings.
        folder: Folder of the checkpoint and of `progress.json`.
        minutes: End after this time.
        stop_at: End after this step.
        start: Initial weights if there is no checkpoint.
        on_line: Called with a line of numbers at every checkpoint.
    """
    torch.manual_seed(config.seed)
    network, average, optimizer, progress = _state(folder, sampler, config, start)
    tests = [held_out.batch(number, config.batch) for number in range(6)]
    half = bfloat16_is_quicker(torch.device("cpu"))
    whole, since_saved = Stopwatch(), Stopwatch()
    before_hours, first = progress.hours, progress.steps
    while True:
        done = progress.steps == stop_at or (minutes is not None and whole.is_over(60 * minutes))
        if done or since_saved.is_over(60 * config.save_minutes):
            progress.validation = _validated(average, tests)
            progress.hours = before_hours + whole.seconds / 3600
            progress.windows_per_s = (progress.steps - first) * config.batch / max(whole.seconds, 1e-6)
            if progress.validation[_CRITERION] <= progress.best:
                progress.best, progress.improved_at_hours = progress.validation[_CRITERION], progress.hours
            write_networks(folder / CHECKPOINT, {"network": network, "average": average}, optimizer, progress.steps)
            write_text(folder / PROGRESS, json.dumps(asdict(progress), indent=1) + "\n")
            on_line(describe(progress))
            since_saved = Stopwatch()
        if done:
            return average
        rate = config.learning_rate * warmup(progress.steps, config.warmup)
        _step(network, optimizer, sampler.batch(progress.steps, config.batch), half, rate)
        progress.steps += 1
        progress.windows += config.batch
        update_average(average.state_dict(), network.state_dict(), ramped_decay(progress.steps, config.ema))


def annealed(sampler: LiftingSampler, config: LiftingConfig, folder: Path, *, steps: int) -> LifterNetwork:
    """The network after `steps` more steps with a rate that falls to zero. The run in the folder does not change."""
    network, _, optimizer, progress = _state(folder, sampler, config, None)
    half = bfloat16_is_quicker(torch.device("cpu"))
    average = copy.deepcopy(network)
    for number in range(steps):
        rate = config.learning_rate * (1 - number / steps)
        _step(network, optimizer, sampler.batch(progress.steps + number, config.batch), half, rate)
        update_average(average.state_dict(), network.state_dict(), ramped_decay(number, config.ema))
    return average


def describe(progress: Progress) -> str:
    """Steps, time, speed and validation of a run as one line."""
    return (
        f"{progress.steps} steps, {progress.windows} windows, {progress.hours:.2f} h, "
        f"{progress.windows_per_s:.0f} windows/s | {measures_text(progress.validation)} | "
        f"best at {progress.improved_at_hours:.2f} h"
    )


def read_progress(folder: Path) -> Progress:
    """Progress of the run in a folder."""
    path = folder / PROGRESS
    return Progress(**json.loads(path.read_text())) if path.is_file() else Progress()


def read_average(folder: Path) -> LifterNetwork:
    """The averaged network of a run."""
    average = LifterNetwork()
    read_networks(folder / CHECKPOINT, {"average": average})
    return average


def _state(
    folder: Path, sampler: LiftingSampler, config: LiftingConfig, start: LifterNetwork | None
) -> tuple[LifterNetwork, LifterNetwork, torch.optim.Optimizer, Progress]:
    """Network, average, optimizer and progress from the checkpoint, or new ones."""
    network, average = LifterNetwork(), LifterNetwork()
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=0.01)
    if (folder / CHECKPOINT).is_file():
        progress = read_progress(folder)
        networks = {"network": network, "average": average}
        progress.steps = read_networks(folder / CHECKPOINT, networks, optimizer)
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
    set_rate(optimizer, rate)
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        output = network(batch.features)
    loss = torch.stack(list(losses(output.float(), batch).values())).sum()
    take_step(network, optimizer, loss, max_norm=1.0)


@torch.no_grad()
def _validated(average: LifterNetwork, tests: list[LiftingBatch]) -> dict[str, float]:
    return mean_measures([measures(average(test.features), test) for test in tests])


def _normalize(network: LifterNetwork, sampler: LiftingSampler) -> None:
    """Set mean and standard deviation of the inputs and mean of the outputs from a first batch."""
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
