"""What is written down and said of a training run: losses, validation, checkpoints."""

from __future__ import annotations

import contextlib
import csv
import json
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenemi.data.files import write_text
from scenemi.training.checkpoint import CHECKPOINT, save_checkpoint
from scenemi.training.losses import Losses
from scenemi.training.run import Progress, Run
from scenemi.training.validate import Validation, Validator

LOG, PROGRESS = "log.csv", "progress.json"
_COLUMNS = (
    "step", "total", "simple", "joints_m2", "velocity_m2", "inside_cm", "gradient_norm", "windows_per_s", "seconds",
)  # fmt: skip


class Watch:
    """What is written down and said of a run."""

    def __init__(self, run: Run, out: Path, check: Validator | None, on_progress: Callable[[Progress], None]) -> None:
        self._run, self._out, self._check, self._say = run, out, check, on_progress
        self._log = _Log(out / LOG, run.step)
        self._recent: list[Tensor] = []
        self._saved, self._since = run.step, time.perf_counter()
        self._rows: tuple[Validation, ...] = ()

    def took(self, losses: Losses, norm: float) -> None:
        """A step was taken."""
        run, config = self._run, self._run.config
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


def _write_progress(path: Path, now: Progress, rows: tuple[Validation, ...]) -> None:
    """Steps, windows, hours, last numbers and best ones with the step they were reached at."""
    told: dict[str, Any] = {"best": {}}
    with contextlib.suppress(OSError, ValueError):
        told |= json.loads(path.read_text())
    told |= {"step": now.step, "windows": now.windows, "hours": round(now.hours, 3)}
    told["date"] = datetime.now(UTC).isoformat(timespec="seconds")
    if rows:
        told["validation"] = [asdict(row) for row in rows]
        told["validated_at"] = now.step
        for row in rows:
            key = f"mjpe_ratio r={row.interval}{' scene' if row.scene else ''}"
            if row.mjpe_ratio < told["best"].get(key, {"value": np.inf})["value"]:
                told["best"][key] = {"value": row.mjpe_ratio, "step": now.step}
    write_text(path, json.dumps(told, indent=1))


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
