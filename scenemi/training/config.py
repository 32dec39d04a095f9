"""What a training run is."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from scenemi.model.config import SIZES, ModelConfig
from video2anim.errors import InputError


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """One run. All but `workers`, `log_every`, `save_every` and `validate_every` changes the weights; of these, `steps`
    may be another when a run is resumed."""

    model: ModelConfig = field(default_factory=lambda: SIZES["small"])
    steps: int = 30_000
    batch: int = 32
    """Windows of a step, over all processes."""
    learning_rate: float = 1e-3
    """Rises over `warmup` steps, stays, and falls linearly to zero over the last `cooldown` share of the steps (paper:
    1e-4, batch 256, constant). A run may be given another end: until the fall begins, `steps` decides nothing."""
    warmup: int = 300
    cooldown: float = 0.2
    weight_decay: float = 1e-2
    ema: float = 0.999
    """Decay of the weights' moving average, shorter in the first steps (paper: 0.9999)."""
    clip_norm: float = 1.0
    seed: int = 0
    bodies: int = 8
    """Adult bodies the clips are put on."""
    noncommercial: bool = False
    """Also train on sources that are free for research only."""
    synthetic_share: float = 0.3
    """Share of the windows drawn from acted (synthetic) clips, where there are any: captured ones have no sitting,
    lying, stepping up or reaching."""
    reverse: float = 0.35
    """Share of windows run backward in time, and `mix`: share with the arms and the head of another window. Captured
    motion is scarce, and what networks learn of it by heart does not hold for other clips."""
    mix: float = 0.35
    keyframes: Literal["paper", "mixed"] = "mixed"
    """`paper`: 2 to N random ones. `mixed`: half of the windows so, else regular intervals, log-uniform, and known
    beginnings as in long motion: sparse keyframes are rare in the paper's draw."""
    noisy_share: float = 0.5
    """Share of windows with noisy keyframes, l ~ U(0, 1) (paper 3.2.1); the others have exact ones."""
    stop_step: int = 20
    """T*: noisy keyframes are imputed above this step only."""
    scene_share: float = 0.6
    """Share of windows around which a scene is drawn; the others have none, as many uses have none."""
    drop_global: float = 0.1
    """Share of the scenes of which only the local part is given; `drop_local`: only the global part."""
    drop_local: float = 0.1
    joints_weight: float = 2.0
    velocity_weight: float = 10.0
    relative: bool = True
    """Errors count relative to those of interpolation at the same distance from the keyframes. Else (the paper's eq.
    4) the loss is ruled by the sparsest keyframes, where most of the error cannot be known. Needs `model.residual`."""
    joiner_steps: int = 12_000
    """Steps of each network of the learned interpolation, before the denoiser's."""
    joiner_windows: int = 12_000
    """Windows drawn for it: 0.15 MB of memory each."""
    joiner_batch: int = 48
    joiner_rate: float = 1e-3
    joiner_decay: float = 0.05
    """Weight decay."""
    workers: int = 1
    """Processes that make batches."""
    log_every: int = 20
    save_every: int = 100
    validate_every: int = 500

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> TrainConfig:
        """Inverse of `to_json`; `model` may be a size by name, and missing keys take defaults.

        Raises:
            InputError: an unknown key or a value that does not fit.
        """
        known = {item.name for item in fields(cls)}
        unknown = set(values) - known
        if unknown:
            raise InputError(
                f"training config: unknown {', '.join(sorted(unknown))}; known are {', '.join(sorted(known))}"
            )
        rest = dict(values)
        model = rest.pop("model", "small")
        if isinstance(model, str):
            if model not in SIZES:
                raise InputError(f"training config: model: want {', '.join(SIZES)} or a table, got {model!r}")
            shape = SIZES[model]
        else:
            size = SIZES[model.get("size", "small")].to_json()
            try:
                shape = ModelConfig.from_json({**size, **{k: v for k, v in model.items() if k != "size"}})
            except ValueError as error:
                raise InputError(f"training config: {error}") from error
        return cls(model=shape, **rest)

    @classmethod
    def read(cls, path: str | Path) -> TrainConfig:
        """From a JSON file.

        Raises:
            InputError: the file is missing or not such a table.
        """
        try:
            values = json.loads(Path(path).read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"training config: cannot read {path}: {error}") from error
        if not isinstance(values, dict):
            raise InputError(f"training config: want a table in {path}, got {type(values).__name__}")
        return cls.from_json(values)
