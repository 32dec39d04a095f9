"""A run's configuration with its motion, and the weights that come out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from scenemi.data.balance import BalanceConfig
from scenemi.data.motion_store import StoreConfig
from scenemi.data.split import Split
from scenemi.data.windows import MotionSet, MotionSetConfig
from scenemi.model.build import build_denoiser
from scenemi.model.weights import save_weights
from scenemi.training.checkpoint import Checkpoint
from scenemi.training.config import TrainConfig
from video2anim.errors import InputError


@dataclass(frozen=True, slots=True)
class RunFiles:
    """What a run is made of."""

    config: TrainConfig
    motion: tuple[Path, ...]
    """Archives or folders of archives."""
    split: Split | None
    cache: Path | None

    @classmethod
    def of(cls, config: Path | None, motion: Sequence[Path], split: Path | None, cache: Path | None) -> RunFiles:
        """From the files that a command line names; the default configuration is the shipped model's."""
        run = TrainConfig() if config is None else TrainConfig.read(config)
        return cls(run, tuple(motion), None if split is None else Split.read(split), cache)


def motions_for(files: RunFiles) -> tuple[MotionSet, MotionSet | None]:
    """Clips to train on, and clips to watch the run by, where there are any.

    Raises:
        InputError: no clip to train on.
    """
    config = files.config
    use = MotionSetConfig(
        sources=config.sources, balance=BalanceConfig(source_share={"synthetic": config.synthetic_share}),
        reverse=config.reverse, mix=config.mix,
    )  # fmt: skip
    bent = replace(use, store=StoreConfig(bends=config.bends))
    motions = MotionSet.build(files.motion, files.split, "train", config.bodies, bent, cache=files.cache)
    try:
        return motions, MotionSet.build(files.motion, files.split, "val", 1, use, cache=files.cache)
    except InputError:
        return motions, None


def write_run_weights(path: Path, state: Checkpoint, motions: MotionSet) -> Path:
    """The averaged weights of a run (fp16) with what they were trained on."""
    model = build_denoiser(state.config.model)
    model.load_state_dict({name: value.cpu() for name, value in state.ema.items()})
    card = {
        "steps": state.step, "hours": round(state.seconds / 3600, 2), "minutes": round(motions.minutes, 1),
        "sources": sorted(set(map(str, motions.store.clip_source))), "config": state.config.to_json(),
    }  # fmt: skip
    save_weights(path, model, state.statistics, card)
    return path
