"""The training loop: one process or several (torchrun), resumable to the step."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed
from torch.nn.parallel import DistributedDataParallel

from scenemi.data.windows import MotionSet
from scenemi.features import Statistics
from scenemi.model.denoiser import Denoiser
from scenemi.training.batches import StepBatches, load_in_order, statistics_of
from scenemi.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.joiner import JoinerPool, holds_joiner, load_joiner, save_joiner, train_joiner
from scenemi.training.keyframe_noise import measured_noise
from scenemi.training.losses import Losses, TrainingLoss, measure_scales
from scenemi.training.validate import Validation, Validator
from video2anim.errors import InputError

CHECKPOINT = "checkpoint.safetensors"
LOG = "log.csv"
VALIDATION = "validation.csv"
_COLUMNS = (
    "step",
    "total",
    "simple",
    "joints_m2",
    "velocity_m2",
    "learning_rate",
    "gradient_norm",
    "windows_per_s",
    "seconds",
)


@dataclass(frozen=True, slots=True)
class Progress:
    """Told to the caller while training."""

    step: int
    steps: int
    total: float
    windows_per_s: float
    validation: tuple[Validation, ...] = ()
    stage: str = ""
    """What is trained; empty = the denoiser."""


def train(
    config: TrainConfig,
    motions: MotionSet,
    out: Path,
    *,
    validation: MotionSet | None = None,
    device: str = "cpu",
    resume: bool = True,
    stop_at: int | None = None,
    time_limit_s: float | None = None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> Checkpoint:
    """Train, or go on training, in the folder `out`.

    Args:
        config: the run; a resumed run must have the same, save for what does not change weights.
        motions: training windows.
        out: folder for the checkpoint, `log.csv` and `validation.csv`.
        validation: windows that sampled numbers are made of.
        device: of torch.
        resume: go on from the checkpoint in `out`; False = begin anew.
        stop_at: end after this step, as if interrupted; None = `config.steps`.
        time_limit_s: end after this time.
        on_progress: called every `config.log_every` steps.

    Raises:
        InputError: the checkpoint in `out` is of another configuration.
    """
    rank, world = _processes()
    torch.manual_seed(config.seed)
    held = load_checkpoint(out / CHECKPOINT) if resume and (out / CHECKPOINT).is_file() else None
    if held is not None and (differing := _differing(held.config, config)):
        raise InputError(
            f"training: {out / CHECKPOINT} was trained with other {', '.join(differing)}; use another --out"
        )
    if rank == 0:
        out.mkdir(parents=True, exist_ok=True)
    run = _Run(config, held.statistics if held else statistics_of(motions, config.seed), device, held, world)
    data = StepBatches(motions, run.statistics, config, rank=rank, world=world)
    if held is None:
        run.join(motions, out, fresh=not resume, on_progress=on_progress if rank == 0 else None)
        run.measure(data)
    check = Validator(validation, run.statistics) if validation is not None and rank == 0 else None
    log, curve = _Table(out / LOG, _COLUMNS, run.step), _Table(out / VALIDATION, _validation_columns(), run.step)

    last = min(config.steps, stop_at or config.steps)
    begun, since = time.perf_counter(), time.perf_counter()
    recent: list[Tensor] = []  # losses of the steps since the last line of the log
    for batch in load_in_order(data, range(run.step, last), config.workers):
        losses, norm = run.advance(batch.to(torch.device(device)))
        elapsed = time.perf_counter() - begun
        out_of_time = time_limit_s is not None and elapsed > time_limit_s
        if rank == 0:
            recent.append(torch.stack([losses.total, losses.simple, losses.joints, losses.velocity]))
            if run.step % config.log_every == 0:
                speed = len(recent) * config.batch / (time.perf_counter() - since)
                values = torch.stack(recent).mean(0).tolist()
                log.add(
                    run.step, *values, run.rate(run.step - 1), norm, round(speed, 2), round(run.seconds + elapsed, 1)
                )
                on_progress(Progress(run.step, config.steps, values[0], speed))
                since = time.perf_counter()
                recent.clear()
            if check is not None and (run.step % config.validate_every == 0 or run.step == config.steps):
                rows = check(run.averaged())
                curve.add(run.step, *(getattr(row, name) for row in rows for name in _VALIDATED))
                on_progress(Progress(run.step, config.steps, float(losses.total), 0.0, rows))
                since = time.perf_counter()
            if run.step % config.save_every == 0 or run.step == last or out_of_time:
                save_checkpoint(out / CHECKPOINT, run.state(elapsed))
        if out_of_time:
            break
    return run.state(time.perf_counter() - begun)


_SCALE_STEPS, _SCALE_WINDOWS = 1_000_000_000, 512
"""Scales are measured on batches of steps that training never reaches."""


class _Run:
    """Model, average, optimizer and schedule of one process."""

    def __init__(
        self, config: TrainConfig, statistics: Statistics, device: str, held: Checkpoint | None, world: int
    ) -> None:
        self.config, self.statistics, self.device = config, statistics, torch.device(device)
        self.model = Denoiser(config.model).to(self.device)
        self.average = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.step, self.seconds = 0, 0.0
        learned = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.optimizer = torch.optim.AdamW(
            learned, config.learning_rate, betas=(0.9, 0.99), weight_decay=config.weight_decay
        )
        if held is not None:
            self.model.load_state_dict(held.model)
            self.average = {name: value.to(self.device) for name, value in held.ema.items()}
            self.optimizer.load_state_dict(held.optimizer)
            self.step, self.seconds = held.step, held.seconds
            torch.set_rng_state(held.rng)
        self.plain = TrainingLoss(self.model, statistics, config).to(self.device)
        self.loss: torch.nn.Module = self.plain
        if world > 1:
            self.loss = DistributedDataParallel(self.plain, find_unused_parameters=True)
        self.world = world

    def join(
        self, motions: MotionSet, out: Path, *, fresh: bool, on_progress: Callable[[Progress], None] | None
    ) -> None:
        """Train the learned interpolation, or take from `out` what is trained already; alike in every process."""
        count = self.config.model.members
        pool: JoinerPool | None = None
        for k in range(count):
            path = out / f"joiner_{k}.safetensors"
            if on_progress is not None and (fresh or not holds_joiner(path, self.config)):
                say = _every(self.config, k, count, on_progress)
                pool = pool or JoinerPool.draw(motions, self.statistics, self.config)
                joiner = train_joiner(pool, self.config, k, device=self.device.type, on_step=say)
                save_joiner(path, joiner, self.config)
        if self.world > 1:
            distributed.barrier()
        for k in range(count):
            self.model.joiners[k].load_state_dict(load_joiner(out / f"joiner_{k}.safetensors"))

    def measure(self, data: StepBatches) -> None:
        """Set the scales of a new model; alike in every process."""
        if not self.config.model.residual:
            return
        whole = StepBatches(data.motions, self.statistics, self.config)
        if self.config.model.smooths:
            noise = measured_noise(data.motions, self.config.seed).to(self.device)
            self.model.noise_std.copy_(noise / self.plain.std)
        count = max(1, _SCALE_WINDOWS // self.config.batch)
        drawn = [whole[_SCALE_STEPS + i].to(self.device) for i in range(count)]
        self.model.set_scales(measure_scales(self.plain, drawn))
        self.average = {name: value.detach().clone() for name, value in self.model.state_dict().items()}

    def rate(self, step: int) -> float:
        """Learning rate of a step: linear rise, level, linear fall."""
        config = self.config
        rise = (step + 1) / max(1, config.warmup)
        fall = (config.steps - step) / max(1.0, config.cooldown * config.steps)
        return config.learning_rate * max(0.0, min(1.0, rise, fall))

    def advance(self, batch: Any) -> tuple[Losses, float]:
        """One step of the optimizer; losses are those of all processes."""
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate(self.step)
        self.optimizer.zero_grad(set_to_none=True)
        with self._precision():
            losses: Losses = self.loss(batch)
        losses.total.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.clip_norm)
        if torch.isfinite(norm):
            self.optimizer.step()
        self.step += 1
        decay = min(config.ema, self.step / (self.step + 10))
        with torch.no_grad():
            for name, value in self.model.state_dict().items():
                self.average[name].lerp_(value, 1 - decay)
        return self._shared(losses), float(norm)

    def _shared(self, losses: Losses) -> Losses:
        values = torch.stack([losses.total, losses.simple, losses.joints, losses.velocity]).detach()
        if self.world > 1:
            distributed.all_reduce(values)
            values = values / self.world
        return Losses(*values)

    def _precision(self) -> AbstractContextManager[Any]:
        return torch.autocast("cuda", torch.bfloat16) if self.device.type == "cuda" else nullcontext()

    def averaged(self) -> Denoiser:
        """The model with averaged weights."""
        model = Denoiser(self.config.model).to(self.device)
        model.load_state_dict(self.average)
        return model.eval()

    def state(self, elapsed_s: float) -> Checkpoint:
        """For a checkpoint."""
        return Checkpoint(
            self.step, self.config, self.statistics, self.model.state_dict(), self.average,
            self.optimizer.state_dict(), torch.get_rng_state(), self.seconds + elapsed_s,
        )  # fmt: skip


def _every(
    config: TrainConfig, member: int, members: int, on_progress: Callable[[Progress], None]
) -> Callable[[int, float], None]:
    """Tells of every so many steps of the learned interpolation."""
    total, begun = 0.0, time.perf_counter()

    def say(step: int, loss: float) -> None:
        nonlocal total, begun
        total += loss
        if step % config.log_every == 0:
            speed = config.joiner_batch * config.log_every / (time.perf_counter() - begun)
            stage = f"learned interpolation {member + 1}/{members}"
            on_progress(Progress(step, config.joiner_steps, total / config.log_every, speed, stage=stage))
            total, begun = 0.0, time.perf_counter()

    return say


def _processes() -> tuple[int, int]:
    """Rank and number of processes; joins the group that torchrun describes."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        return 0, 1
    if not distributed.is_initialized():
        backend = "nccl" if torch.cuda.is_available() else "gloo"
        distributed.init_process_group(backend, timeout=_PATIENCE)
    return distributed.get_rank(), world


_PATIENCE = timedelta(hours=4)
"""How long processes wait for the one that trains the learned interpolation."""
_FREE = ("steps", "workers", "log_every", "save_every", "validate_every")
"""Settings in which a resumed run may differ."""


def _differing(held: TrainConfig, wanted: TrainConfig) -> list[str]:
    a, b = held.to_json(), wanted.to_json()
    return [key for key in a if key not in _FREE and _plain(a[key]) != _plain(b[key])]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return list(value) if isinstance(value, tuple) else value


_VALIDATED = ("mjpe_m", "base_mjpe_m", "interpolated_mjpe_m", "jerk_ratio")


def _validation_columns() -> tuple[str, ...]:
    from scenemi.training.validate import INTERVALS

    return ("step", *(f"{name}_{r}" for r in INTERVALS for name in _VALIDATED))


class _Table:
    """A CSV file that is cut back to the step a run resumes from."""

    def __init__(self, path: Path, columns: tuple[str, ...], step: int) -> None:
        self.path = path
        rows: list[list[str]] = []
        if step and path.is_file():
            with path.open(newline="") as file:
                rows = [row for row in list(csv.reader(file))[1:] if row and int(row[0]) <= step]
        if path.parent.is_dir():
            with path.open("w", newline="") as file:
                csv.writer(file).writerows([columns, *rows])

    def add(self, *values: float) -> None:
        with self.path.open("a", newline="") as file:
            csv.writer(file).writerow(values)
