"""The training loop: resumable to the step, with no end of its own."""

from __future__ import annotations

import csv
import functools
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenemi.data.windows import MotionSet
from scenemi.features import Statistics
from scenemi.model.build import AnyDenoiser, build_denoiser
from scenemi.model.denoiser import Denoiser
from scenemi.model.weights import load_weights
from scenemi.training.batches import Batch, PoolBatches, statistics_of
from scenemi.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from scenemi.training.config import FREE, TrainConfig
from scenemi.training.losses import Losses, TrainingLoss
from scenemi.training.noise import PipelineErrors
from scenemi.training.pool import SHARD_WINDOWS, AnyShard, grow_pool, open_pool
from scenemi.training.scales import measure_scales
from scenemi.training.scene_pool import SceneMotions
from scenemi.training.validate import Validation, Validator
from video2anim.body.anny_body import ShapedBody
from video2anim.errors import InputError

CHECKPOINT, LOG, PROGRESS, POOL = "checkpoint.safetensors", "log.csv", "progress.json", "pool"
SCENE_POOL = "pool_captured"
_COLUMNS = (
    "step", "total", "simple", "joints_m2", "velocity_m2", "inside_cm", "gradient_norm", "windows_per_s", "seconds",
)  # fmt: skip
_SCALE_STEPS, _SCALE_WINDOWS = 1_000_000_000, 512
"""Scales are measured on batches of steps that training never reaches."""
_FIRST_SHARDS = 2
"""Of the pool, made before the first step; another one follows each time the state is saved."""
_MOST_BAD_STEPS = 20
"""Steps in a row without a finite gradient after which a run gives up."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Told to the caller while training."""

    step: int
    windows: int
    hours: float
    total: float
    windows_per_s: float
    validation: tuple[Validation, ...] = ()


def train(
    config: TrainConfig,
    motions: MotionSet,
    out: Path,
    *,
    scenes: SceneMotions | None = None,
    validation: MotionSet | None = None,
    device: str = "cpu",
    errors: PipelineErrors | None = None,
    start: Path | None = None,
    stop_at: int | None = None,
    time_limit_s: float | None = None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> Checkpoint:
    """Train, or go on training, in the folder `out`.

    Args:
        config: the run; a resumed run must have the same, save for what does not change weights.
        motions: clips on bodies, from which the pool in `out/pool` is made; in made-up scenes, or captured ones.
        out: folder of the pool, the checkpoint, `log.csv` and `progress.json`.
        scenes: clips in captured scenes on the same bodies, beside others in `motions`; half of the batches are theirs.
        validation: windows that sampled numbers are made of.
        device: of torch.
        errors: of the video pipeline, for noisy keyframes.
        start: weights to begin from where `out` has no checkpoint or one with fewer steps, if they are of the same
            architecture.
        stop_at: end after this step; None = at the time limit, or never.
        time_limit_s: end after this time.
        on_progress: called every `config.log_every` steps, and after each validation.

    Raises:
        InputError: the checkpoint in `out` is of another configuration, or training met no finite gradient any more.
    """
    held = load_checkpoint(out / CHECKPOINT) if (out / CHECKPOINT).is_file() else None
    begun = _from_weights(start, config)
    if begun is not None and (held is None or begun.step > held.step):
        held = begun
    if held is not None and (differing := _differing(held.config, config)):
        raise InputError(
            f"training: {out / CHECKPOINT} was trained with other {', '.join(differing)}; give another folder, or the "
            "configuration it was begun with"
        )
    pools = {POOL: motions} if scenes is None else {POOL: motions, SCENE_POOL: scenes}
    _grow(out, pools, min(config.pool_windows, _FIRST_SHARDS * SHARD_WINDOWS), config.seed)
    shards = _shards(out)
    run = Run(config, motions.bodies(), shards, device, held)
    check = None if validation is None else Validator(validation, run.statistics)
    watch = _Watch(run, out, check, on_progress)
    data = PoolBatches(shards, config, errors)
    try:
        for batches in data.ahead(range(run.step, stop_at if stop_at is not None else 2**62), config.workers):
            watch.took(*run.advance(batches))
            late = time_limit_s is not None and run.elapsed_s > time_limit_s
            if late or run.step == stop_at:
                break
            if run.step % config.save_every == 0:
                watch.save()
            if run.step % config.grow_every == 0:
                _enlarge(data, pools, out, config)
    finally:  # interrupted, too
        watch.save()
    return run.state()


def cool(
    out: Path,
    motions: MotionSet,
    steps: int,
    *,
    errors: PipelineErrors | None = None,
    device: str = "cpu",
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> Checkpoint:
    """The state of a run after so many more steps in which the learning rate falls to zero; the run itself stays as it
    is. The average of weights is taken over these steps too.

    Raises:
        InputError: no checkpoint.
    """
    held = load_checkpoint(out / CHECKPOINT)
    shards = _shards(out)
    run = Run(held.config, motions.bodies(), shards, device, held)
    data = PoolBatches(shards, held.config, errors)
    last = run.step + steps
    for batches in data.ahead(range(run.step, last), held.config.workers):
        losses, _ = run.advance(batches, (last - run.step) / steps)
        if run.step % held.config.log_every == 0:
            on_progress(run.progress(float(losses.total)))
    return run.state()


class Run:
    """Model, average and optimizer."""

    def __init__(
        self,
        config: TrainConfig,
        bodies: Sequence[ShapedBody],
        shards: Sequence[AnyShard],
        device: str,
        held: Checkpoint | None,
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.device = config, torch.device(device)
        self.statistics: Statistics = held.statistics if held else statistics_of(shards, bodies)
        rest = torch.from_numpy(np.stack([body.rest_joints_m for body in bodies]).astype(np.float32))
        self.model: AnyDenoiser = build_denoiser(config.model).to(self.device)
        self.step, self._seconds = held.step if held else 0, held.seconds if held else 0.0
        self._begun = time.perf_counter()
        self.loss = TrainingLoss(self.model, self.statistics, bodies, config).to(self.device)
        if held is not None:
            self.model.load_state_dict(held.model)
        elif isinstance(self.model, Denoiser):
            data = PoolBatches(shards, config)
            drawn = [data[_SCALE_STEPS + i] for i in range(max(2, _SCALE_WINDOWS // config.batch))]
            self.model.set_scales(measure_scales(drawn, self.statistics, rest))
            self.loss.set_input_scales([batch.to(self.device) for batch in drawn])
        state = held.ema if held else self.model.state_dict()
        self.average = {name: value.detach().clone().to(self.device) for name, value in state.items()}
        plain = [p for p in self.model.parameters() if p.ndim < 2]
        others = [p for p in self.model.parameters() if p.ndim >= 2]
        self.optimizer = torch.optim.AdamW(
            [{"params": others, "weight_decay": config.weight_decay}, {"params": plain, "weight_decay": 0.0}],
            config.learning_rate, betas=(0.9, 0.98), fused=True,
        )  # fmt: skip
        if held is not None and held.optimizer:
            self.optimizer.load_state_dict(held.optimizer)
        self.model.half_precision = bfloat16_is_quicker(self.device)
        self._power = _ema_power(config.ema)
        self._threads: ThreadPoolExecutor | None = None
        if self.device.type == "cpu" and config.parts > 1 and torch.get_num_threads() > 1:
            self._threads = ThreadPoolExecutor(min(config.parts, torch.get_num_threads()))
            torch.set_num_threads(1)

    def advance(self, batches: Sequence[Batch], rate: float = 1.0) -> tuple[Losses, float]:
        """One step of the optimizer at a share of the learning rate; means over the batches, and the gradient's norm. A
        step without a finite gradient changes nothing."""
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * rate * min(1.0, (self.step + 1) / max(1, config.warmup))
        learned = [p for p in self.model.parameters() if p.requires_grad]

        def part(batch: Batch) -> tuple[Losses, tuple[Tensor | None, ...]]:
            losses: Losses = self.loss(batch.to(self.device))
            return losses, torch.autograd.grad(losses.total, learned, allow_unused=True)

        found = list(self._threads.map(part, batches) if self._threads else map(part, batches))
        for number, parameter in enumerate(learned):
            grads = [grads[number] for _, grads in found]
            parameter.grad = sum(g / len(found) for g in grads if g is not None) if grads[0] is not None else None
        norm = float(torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.clip_norm))
        self.step += 1
        if np.isfinite(norm):
            self.optimizer.step()
            keep = (1 - 1 / self.step) ** (self._power + 1)
            now = self.model.state_dict()
            torch._foreach_lerp_([self.average[name] for name in now], list(now.values()), 1 - keep)
        means = (
            torch.stack([getattr(losses, name).detach() for losses, _ in found]).mean() for name in Losses.__slots__
        )
        return Losses(*means), norm

    def averaged(self) -> AnyDenoiser:
        """The model with averaged weights."""
        model = build_denoiser(self.config.model).to(self.device)
        model.load_state_dict(self.average)
        return model.eval()

    @property
    def elapsed_s(self) -> float:
        """Since this start of the run."""
        return time.perf_counter() - self._begun

    def state(self) -> Checkpoint:
        """For a checkpoint."""
        return Checkpoint(
            self.step, self.config, self.statistics, self.model.state_dict(), self.average,
            self.optimizer.state_dict(), self._seconds + self.elapsed_s,
        )  # fmt: skip

    def progress(self, total: float, speed: float = 0.0, rows: tuple[Validation, ...] = ()) -> Progress:
        """Where the run is."""
        hours = (self._seconds + self.elapsed_s) / 3600
        return Progress(self.step, self.step * self.config.step_windows, hours, total, speed, rows)


class _Watch:
    """What is written down and said of a run."""

    def __init__(self, run: Run, out: Path, check: Validator | None, on_progress: Callable[[Progress], None]) -> None:
        self._run, self._out, self._check, self._say = run, out, check, on_progress
        self._log = _Log(out / LOG, run.step)
        self._recent: list[Tensor] = []
        self._saved, self._bad, self._since = run.step, 0, time.perf_counter()
        self._rows: tuple[Validation, ...] = ()

    def took(self, losses: Losses, norm: float) -> None:
        """A step was taken.

        Raises:
            InputError: too many in a row had no finite gradient.
        """
        run, config = self._run, self._run.config
        self._bad = 0 if np.isfinite(norm) else self._bad + 1
        if self._bad > _MOST_BAD_STEPS:
            raise InputError(
                f"training: {self._bad} steps without a finite gradient at {run.step}; lower learning_rate"
            )
        self._recent.append(torch.stack([getattr(losses, name) for name in Losses.__slots__]))
        if run.step % config.log_every == 0:
            speed = len(self._recent) * config.step_windows / (time.perf_counter() - self._since)
            values = torch.stack(self._recent).mean(0).tolist()
            now = run.progress(values[0], speed)
            self._log.add(run.step, *(f"{v:.5g}" for v in (*values, norm, speed, 3600 * now.hours)))
            self._say(now)
            self._recent.clear()
            self._since = time.perf_counter()
        if self._check is not None and run.step % config.validate_every == 0:
            self._rows = self._check(run.averaged())
            self._say(run.progress(float(losses.total), 0.0, self._rows))

    def save(self) -> None:
        """Checkpoint and progress, where there was a step since the last."""
        if self._run.step > self._saved:
            save_checkpoint(self._out / CHECKPOINT, self._run.state())
            _write_progress(self._out / PROGRESS, self._run.progress(float("nan")), self._rows)
            self._saved, self._rows = self._run.step, ()


@functools.cache
def bfloat16_is_quicker(device: torch.device) -> bool:
    """Whether matrix products of the size of the network's are: on GPUs, and on processors that have them (AVX-512
    BF16, AMX); on others they take many times as long."""
    if device.type != "cpu":
        return True
    took = []
    for dtype in (torch.float32, torch.bfloat16):
        a, b = torch.ones(512, 512, dtype=dtype), torch.ones(512, 512, dtype=dtype)
        times = []
        for _ in range(5):
            begun = time.perf_counter()
            a @ b
            times.append(time.perf_counter() - begun)
        took.append(min(times))
    return took[1] < 0.8 * took[0]


def _from_weights(path: Path | None, config: TrainConfig) -> Checkpoint | None:
    """Shipped weights as the state of a run whose checkpoint is gone: the optimizer begins anew."""
    if path is None or not path.is_file():
        return None
    try:
        found = load_weights(path)
    except InputError:
        return None  # of an older format
    if found.config != config.model:
        return None
    state = found.denoiser.state_dict()
    hours, step = float(found.card.get("hours", 0.0)), int(found.card.get("steps", 0))
    return Checkpoint(step, config, found.statistics, state, state, {}, 3600 * hours)


def _ema_power(width: float) -> float:
    """Exponent of the power-function average whose width is this share of the steps so far (Karras et al. 2024)."""
    t = width**-2
    return float(np.roots([1, 7, 16 - t, 12 - t]).real.max())


def _grow(out: Path, pools: Mapping[str, MotionSet], windows: int, seed: int) -> None:
    for name, motions in pools.items():
        grow_pool(out / name, motions, windows, seed=seed)


def _shards(out: Path) -> list[AnyShard]:
    """Of the pool, and of that in captured scenes where there is one."""
    captured = open_pool(out / SCENE_POOL) if (out / SCENE_POOL).is_dir() else []
    return [*open_pool(out / POOL), *captured]


def _enlarge(data: PoolBatches, pools: Mapping[str, MotionSet], out: Path, config: TrainConfig) -> None:
    """One more shard, until each pool has all its windows. Batches drawn ahead are of the smaller pool."""
    there = sum(map(len, data.shards)) // len(pools)
    wanted = min(config.pool_windows, there + SHARD_WINDOWS)
    if wanted > there:
        _grow(out, pools, wanted, config.seed)
        data.take(_shards(out))


def _differing(held: TrainConfig, wanted: TrainConfig) -> list[str]:
    a, b = (json.loads(json.dumps(config.to_json())) for config in (held, wanted))
    return [key for key in a if key not in FREE and a[key] != b[key]]


def _write_progress(path: Path, now: Progress, rows: tuple[Validation, ...]) -> None:
    """Steps, windows, hours, last numbers and best ones with the step they were reached at."""
    try:
        told = json.loads(path.read_text())
    except (OSError, ValueError):
        told = {"best": {}}
    told |= {"step": now.step, "windows": now.windows, "hours": round(now.hours, 3)}
    told["date"] = datetime.now(UTC).isoformat(timespec="seconds")
    if rows:
        told["validation"] = [asdict(row) for row in rows]
        told["validated_at"] = now.step
        for row in rows:
            key = f"mjpe_ratio r={row.interval}{' scene' if row.scene else ''}"
            if row.mjpe_ratio < told["best"].get(key, {"value": np.inf})["value"]:
                told["best"][key] = {"value": row.mjpe_ratio, "step": now.step}
    aside = path.with_suffix(".part")
    aside.write_text(json.dumps(told, indent=1))
    os.replace(aside, path)


class _Log:
    """A CSV file that is cut back to the step a run resumes from."""

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        rows: list[list[str]] = []
        if step and path.is_file():
            with path.open(newline="") as file:
                rows = [row for row in list(csv.reader(file))[1:] if row and int(row[0]) <= step]
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([_COLUMNS, *rows])

    def add(self, *values: Any) -> None:
        with self.path.open("a", newline="") as file:
            csv.writer(file).writerow(values)
