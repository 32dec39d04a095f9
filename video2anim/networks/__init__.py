"""Models and their weights. Only this package knows ONNX and TFLite; nothing is fetched at import."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from video2anim.errors import UsageError
from video2anim.networks.fetch import (
    ModelState,
    OnProgress,
    cache_dir,
    ensure,
    model_path,
    pull,
    verify,
    weight_digests,
)
from video2anim.networks.table import ModelEntry, find_model, list_models, weight_licenses

__all__ = [
    "ModelEntry",
    "ModelState",
    "OnProgress",
    "cache_dir",
    "ensure",
    "find_model",
    "list_models",
    "load_model",
    "model_path",
    "pull",
    "verify",
    "weight_digests",
    "weight_licenses",
]


def load_model(name_or_slot: str, *, on_progress: OnProgress | None = None) -> Any:
    """The adapter of a model, with its weights loaded; they are fetched first where missing.

    Args:
        name_or_slot: A model's name, a slot (its first model), or NAME@PATH for weights of the user's own.
        on_progress: Called while weights are fetched.

    Raises:
        ModelMissingError: weights cannot be had or fail their digest.
        UsageError: there is no such model, or none that is loaded by its name.
    """
    entry = find_model(name_or_slot)
    if not entry.adapter:
        raise UsageError(f"model: want a network that a stage runs, got {entry.name}, which is of slot {entry.slot}")
    paths: list[Path] = [ensure(name, on_progress) for name in (name_or_slot, *entry.requires)]
    module, _, adapter = entry.adapter.partition(":")
    return getattr(importlib.import_module(module), adapter)(*paths)
