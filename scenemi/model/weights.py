"""Weights on disk: safetensors (fp16 when shipped) with configuration and card in the header. No pickle."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from scenemi.data.files import write_tensors
from scenemi.features import Statistics
from scenemi.model.build import AnyDenoiser, build_denoiser
from scenemi.model.config import AnyConfig, config_from_json
from scenemi.prior import WEIGHTS_FOLDER
from video2anim.errors import InputError, ModelMissingError, one_line

FORMAT = "scenemi-weights-2"


@dataclass(frozen=True, slots=True, eq=False)
class LoadedModel:
    """A denoiser ready for use."""

    denoiser: AnyDenoiser
    """In evaluation mode, float32."""
    config: AnyConfig
    statistics: Statistics
    card: dict[str, Any]
    """Data, steps, license, numbers."""
    path: Path


def save_weights(
    path: str | Path, denoiser: AnyDenoiser, statistics: Statistics, card: dict[str, Any], *, half: bool = True
) -> None:
    """Write weights, statistics and card to one file.

    Raises:
        InputError: the file cannot be written.
    """
    dtype = torch.float16 if half else torch.float32
    tensors = {f"model.{name}": value.detach().to(dtype).contiguous() for name, value in denoiser.state_dict().items()}
    for item in fields(Statistics):
        tensors[f"statistics.{item.name}"] = torch.from_numpy(getattr(statistics, item.name).copy())
    header = {"format": FORMAT, "config": json.dumps(denoiser.config.to_json()), "card": json.dumps(card)}
    write_tensors(Path(path), tensors, header)


def load_weights(
    name: str | Path = "small", *, device: str = "cpu", build: Callable[[AnyConfig], AnyDenoiser] = build_denoiser
) -> LoadedModel:
    """Weights by name (a file in `scenemi/weights`) or path; `build` makes the denoiser of their configuration.

    Raises:
        ModelMissingError: no such file.
        InputError: the file is not one of these.
    """
    path = Path(name) if str(name).endswith(".safetensors") else WEIGHTS_FOLDER / f"{name}.safetensors"
    if not path.is_file():
        there = ", ".join(sorted(file.stem for file in WEIGHTS_FOLDER.glob("*.safetensors"))) or "none"
        raise ModelMissingError(f"scenemi weights: found no {path.name} in {path.parent}; present are: {there}")
    try:
        with safe_open(str(path), "pt", device=device) as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a mapping)
    except (OSError, SafetensorError) as error:
        raise InputError(f"scenemi weights: want a safetensors file at {path}: {one_line(error)}") from error
    if header.get("format") != FORMAT:
        raise InputError(f"scenemi weights: want format {FORMAT} in {path}, got {str(header.get('format'))[:40]}")
    try:
        config, card = config_from_json(dict(json.loads(header["config"]))), dict(json.loads(header["card"]))
        denoiser = build(config).to(device)
        denoiser.load_state_dict({
            key.removeprefix("model."): value.float() for key, value in tensors.items() if key.startswith("model.")
        })  # fmt: skip
        statistics = statistics_from(tensors)
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        problem = f"it lacks {error}" if isinstance(error, KeyError) else one_line(error)
        raise InputError(f"scenemi weights: {path} does not fit its own configuration: {problem}") from error
    return LoadedModel(denoiser.eval(), config, statistics, card, path)


def statistics_from(tensors: Mapping[str, Tensor]) -> Statistics:
    """Statistics of a file's tensors.

    Raises:
        KeyError: one is missing.
        ValueError: wrong shapes, or numbers that cannot divide.
    """
    found = Statistics(*(tensors[f"statistics.{item.name}"].float().cpu().numpy() for item in fields(Statistics)))
    for item in fields(Statistics):
        values = getattr(found, item.name)
        if values.ndim != 1 or not np.isfinite(values).all():
            raise ValueError(f"statistics.{item.name}: want finite numbers in one row, got shape {values.shape}")
    return found
