"""Everything a run needs to go on as if it had never stopped, in one safetensors file."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from scenemi.features import Statistics
from scenemi.model.baselines.build import build_any
from scenemi.model.weights import statistics_from
from scenemi.training.config import TrainConfig
from scenemi.training.loop_parts import named_part, optimizer_moments, optimizer_tensors, write_training
from video2anim.errors import InputError, one_line

CHECKPOINT = "checkpoint.safetensors"
"""Name of the file in a run's folder."""
FORMAT = "scenemi-checkpoint-2"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """State after `step` steps."""

    step: int
    config: TrainConfig
    statistics: Statistics
    model: dict[str, Tensor]
    ema: dict[str, Tensor]
    optimizer: dict[str, Any]
    """As `Optimizer.state_dict`."""
    seconds: float
    """Time trained so far; everything random is drawn from (seed, step)."""


def save_checkpoint(path: Path, state: Checkpoint) -> None:
    """Write aside and move into place: a broken run leaves the last whole checkpoint."""
    tensors = {f"model.{k}": v for k, v in state.model.items()} | {f"ema.{k}": v for k, v in state.ema.items()}
    tensors |= optimizer_tensors(state.optimizer["state"])
    for item in fields(Statistics):
        tensors[f"statistics.{item.name}"] = torch.from_numpy(getattr(state.statistics, item.name).copy())
    header = {
        "format": FORMAT, "step": str(state.step), "seconds": repr(state.seconds),
        "config": json.dumps(state.config.to_json()), "groups": json.dumps(state.optimizer["param_groups"]),
    }  # fmt: skip
    write_training(path, tensors, header)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read what `save_checkpoint` wrote.

    Raises:
        InputError: the file is missing or not a checkpoint.
    """
    try:
        with safe_open(str(path), "pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a mapping)
    except (OSError, SafetensorError) as error:
        raise InputError(f"checkpoint: cannot read {path}: {one_line(error)}") from error
    if header.get("format") != FORMAT:
        raise InputError(f"checkpoint: want format {FORMAT} in {path}, got {header.get('format')}")
    try:
        return _restored(header, tensors)
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        problem = f"it lacks {error}" if isinstance(error, KeyError) else one_line(error)
        raise InputError(f"checkpoint: {path} is damaged: {problem}; delete it to begin again") from error


def _restored(header: dict[str, str], tensors: dict[str, Tensor]) -> Checkpoint:
    config = TrainConfig.from_json(json.loads(header["config"]))
    weights = {part: named_part(tensors, part) for part in ("model", "ema")}
    for values in weights.values():
        build_any(config.model).load_state_dict(values)  # complains of what does not fit
    return Checkpoint(
        step=int(header["step"]),
        config=config,
        statistics=statistics_from(tensors),
        model=weights["model"],
        ema=weights["ema"],
        optimizer={"state": optimizer_moments(tensors), "param_groups": json.loads(header["groups"])},
        seconds=float(header["seconds"]),
    )
