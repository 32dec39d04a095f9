"""What all training loops share: learning rate, step, average of weights, optimizer on disk, time limit.

The loops: `scenemi.training.loop` (the prior), `video2anim.lab.lifter.train` and `video2anim.lab.scene_network.train`.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor, nn

from scenemi.data.files import write_tensors

_OPTIMIZER = "optimizer."


class Stopwatch:
    """Time since a loop began."""

    def __init__(self) -> None:
        self._begun = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._begun

    def is_over(self, limit_s: float | None) -> bool:
        """Whether more time has passed than the limit; None = no limit."""
        return limit_s is not None and self.seconds > limit_s


def warmup(step: int, steps: int) -> float:
    """Share of the learning rate at a step (from 0): rises linearly over `steps`, then stays at 1."""
    return min(1.0, (step + 1) / max(1, steps))


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameter groups; a group with a `share` gets that share of it."""
    for group in optimizer.param_groups:
        group["lr"] = group.get("share", 1.0) * rate


def take_step(network: nn.Module, optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float) -> None:
    """One step of the optimizer with the norm of the gradient clipped."""
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), max_norm)
    optimizer.step()


def ramped_decay(step: int, decay: float) -> float:
    """Decay of the moving average after `step` steps: short at first, so that it soon forgets the initial weights."""
    return min(decay, (step + 1) / (step + 10))


@torch.no_grad()
def update_average(average: Mapping[str, Tensor], weights: Mapping[str, Tensor], decay: float) -> None:
    """Moving average of weights and running statistics, in place; counters are left as they are."""
    names = [name for name, value in average.items() if value.dtype.is_floating_point]
    mean, now = [average[name] for name in names], [weights[name] for name in names]
    torch._foreach_lerp_(mean, now, 1 - decay)  # pyright: ignore[reportPrivateImportUsage]


def mean_measures(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each measure over validation batches."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def measures_text(measures: Mapping[str, float]) -> str:
    """Names and values on one line."""
    return " ".join(f"{name} {value:.3g}" for name, value in measures.items())


@functools.cache
def bfloat16_is_quicker(device: torch.device) -> bool:
    """Whether matrix products of the size of the networks' are: on GPUs, and on processors that have them (AVX-512
    BF16, AMX); on others they take many times as long."""
    if device.type != "cpu":
        return True
    took = []
    for dtype in (torch.float32, torch.bfloat16):
        a, b = torch.ones(512, 512, dtype=dtype), torch.ones(512, 512, dtype=dtype)
        times = []
        for _ in range(5):
            begun = time.perf_counter()
            torch.matmul(a, b)
            times.append(time.perf_counter() - begun)
        took.append(min(times))
    return took[1] < 0.8 * took[0]


def optimizer_tensors(state: Mapping[int, Mapping[str, Any]]) -> dict[str, Tensor]:
    """The optimizer's moments (`state_dict()["state"]`) by names for a file."""
    return {f"{_OPTIMIZER}{i}.{k}": torch.as_tensor(v) for i, values in state.items() for k, v in values.items()}


def optimizer_moments(tensors: Mapping[str, Tensor]) -> dict[int, dict[str, Tensor]]:
    """Inverse of `optimizer_tensors`; other tensors are ignored."""
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith(_OPTIMIZER):
            number, _, name = key.removeprefix(_OPTIMIZER).partition(".")
            moments.setdefault(int(number), {})[name] = value
    return moments


def named_part(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """Tensors whose names begin with `part.`, without that."""
    return {key.removeprefix(f"{part}."): value for key, value in tensors.items() if key.startswith(f"{part}.")}


def write_training(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write copies of tensors; a file that is there is replaced when the new one is whole.

    Raises:
        InputError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tensors(path, {key: value.detach().cpu().contiguous().clone() for key, value in tensors.items()}, header)


def write_networks(path: Path, networks: Mapping[str, nn.Module], optimizer: torch.optim.Optimizer, step: int) -> None:
    """Checkpoint of several networks and their optimizer after a step.

    Raises:
        InputError: the file cannot be written.
    """
    tensors = {f"{name}.{key}": v for name, network in networks.items() for key, v in network.state_dict().items()}
    write_training(path, tensors | optimizer_tensors(optimizer.state_dict()["state"]), {"step": str(step)})


def read_networks(path: Path, networks: Mapping[str, nn.Module], optimizer: torch.optim.Optimizer | None = None) -> int:
    """Load what `write_networks` wrote into networks of the same names; returns the step."""
    with safe_open(str(path), "pt") as file:
        step = int(file.metadata()["step"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    for name, network in networks.items():
        network.load_state_dict(named_part(tensors, name))
    if optimizer is not None:
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": optimizer_moments(tensors), "param_groups": groups})
    return step
