"""Model, average and optimizer of a training run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from scenemi.features import Statistics
from scenemi.model.baselines.build import build_any
from scenemi.model.build import AnyDenoiser
from scenemi.model.denoiser import Denoiser
from scenemi.training.batches import Batch, PoolBatches, statistics_of
from scenemi.training.checkpoint import Checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.helpers import Helpers, gradients, learned
from scenemi.training.loop_parts import Stopwatch, bfloat16_is_quicker, set_rate, update_average, warmup
from scenemi.training.losses import Losses, TrainingLoss
from scenemi.training.pool import AnyShard
from scenemi.training.scales import measure_scales
from scenemi.training.validate import Validation
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import StageError

_SCALE_STEPS, _SCALE_WINDOWS = 1_000_000_000, 512
"""Scales are measured on batches of steps that training never reaches."""
MAX_SKIPPED_STEPS = 20
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
    skipped: int = 0
    """Steps without a finite gradient since the start of this run; they changed nothing."""


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
        self.model: AnyDenoiser = build_any(config.model).to(self.device)
        self.step, self._seconds = held.step if held else 0, held.seconds if held else 0.0
        self.stopwatch = Stopwatch()
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
        self._helpers: Helpers | None = None
        self.skipped, self._skipped_in_row = 0, 0

    def advance(self, batches: Sequence[Batch], rate: float = 1.0) -> tuple[Losses, float]:
        """One step of the optimizer at a share of the learning rate; means over the batches, and the gradient's norm. A
        step without a finite gradient changes nothing and is counted.

        Raises:
            StageError: too many such steps in a row.
        """
        config = self.config
        set_rate(self.optimizer, config.learning_rate * rate * warmup(self.step, config.warmup))
        found = self._gradients(batches)
        for number, parameter in enumerate(learned(self.loss)):
            told = [grad for _, grads in found if (grad := grads[number]) is not None]
            parameter.grad = torch.stack(told).mean(0) if told else None
        norm = float(torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.clip_norm))
        self.step += 1
        self._expect_some_finite(norm)
        if np.isfinite(norm):
            self.optimizer.step()
            update_average(self.average, self.model.state_dict(), (1 - 1 / self.step) ** (self._power + 1))
        means = (torch.stack([getattr(losses, name) for losses, _ in found]).mean() for name in Losses.__slots__)
        return Losses(*means), norm

    def _expect_some_finite(self, norm: float) -> None:
        finite = bool(np.isfinite(norm))
        self.skipped += not finite
        self._skipped_in_row = 0 if finite else self._skipped_in_row + 1
        if self._skipped_in_row > MAX_SKIPPED_STEPS:
            raise StageError(
                f"training: {self._skipped_in_row} steps in a row without a finite gradient at {self.step}; lower "
                "learning_rate"
            )

    def _gradients(self, batches: Sequence[Batch]) -> list[tuple[Losses, list[Tensor | None]]]:
        """Of each batch; on a CPU with several threads in processes of their own, which start with the first step."""
        if len(batches) == 1 or self.device.type != "cpu" or torch.get_num_threads() == 1:
            return [gradients(self.loss, batch.to(self.device)) for batch in batches]
        self._helpers = self._helpers or Helpers(self.loss, len(batches) - 1)
        return self._helpers.of_batches(batches)

    @property
    def seconds(self) -> float:
        """Time trained, with that before the run was resumed."""
        return self._seconds + self.stopwatch.seconds

    def averaged(self) -> AnyDenoiser:
        """The model with averaged weights."""
        model = build_any(self.config.model).to(self.device)
        model.load_state_dict(self.average)
        return model.eval()

    def state(self) -> Checkpoint:
        """For a checkpoint."""
        return Checkpoint(
            self.step, self.config, self.statistics, self.model.state_dict(), self.average,
            self.optimizer.state_dict(), self.seconds,
        )  # fmt: skip

    def progress(self, total: float, speed: float = 0.0, rows: tuple[Validation, ...] = ()) -> Progress:
        """Where the run is."""
        hours = self.seconds / 3600
        return Progress(self.step, self.step * self.config.step_windows, hours, total, speed, rows, self.skipped)


def _ema_power(width: float) -> float:
    """Exponent of the power-function average whose width is this share of the steps so far (Karras et al. 2024)."""
    t = width**-2
    return float(np.roots([1, 7, 16 - t, 12 - t]).real.max())
