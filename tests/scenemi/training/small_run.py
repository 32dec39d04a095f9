"""A run of a few steps, and batches made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scenemi.data.container import write_archive
from scenemi.data.windows import MotionSet, MotionSetConfig
from scenemi.features import ROTATIONS, TRANSLATION, Statistics
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.model.kinematics import matrices
from scenemi.training import loop, pool, run
from scenemi.training.batches import Batch
from scenemi.training.config import TrainConfig
from scenemi.training.losses import TrainingLoss
from scenemi.training.noise import features_of
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.lab.synth.acting import act, to_source_clip
from video2anim.types import BodyShape

SHARD = 32
"""Windows of a shard in these tests."""
CONFIG = TrainConfig(
    model=SIZES["tiny"],
    batch=4,
    parts=1,
    workers=0,
    log_every=1,
    save_every=2,
    grow_every=2,
    warmup=2,
    bodies=1,
    validate_every=1000,
    pool_windows=2 * SHARD,
)
PLAIN = MotionSetConfig(mirror=0.0, warp=0.0)


def shrink(patch: pytest.MonkeyPatch) -> None:
    """Small shards, and scales from few windows."""
    patch.setattr(pool, "SHARD_WINDOWS", SHARD)
    patch.setattr(loop, "SHARD_WINDOWS", SHARD)
    patch.setattr(run, "_SCALE_WINDOWS", 4 * CONFIG.batch)


def write_procedural(path: Path, kinds: tuple[str, ...]) -> Path:
    """An archive of procedural clips of five seconds."""
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    clips = [
        to_source_clip(act(kind, body, np.random.default_rng(i), duration_s=(4.5, 5.5)), body, f"{kind}_{i}")
        for i, kind in enumerate(kinds)
    ]
    write_archive(path, clips)
    return path


def loss_of(motions: MotionSet, statistics: Statistics, config: TrainConfig = CONFIG) -> TrainingLoss:
    """The objective of an untrained denoiser."""
    torch.manual_seed(1)
    assert config.model == SIZES["tiny"]
    return TrainingLoss(Denoiser(SIZES["tiny"]), statistics, [motions.body(0)], config)


def consistent(batch: Batch, motions: MotionSet) -> Batch:
    """With joints of exactly these rotations: stored ones are rounded on their own."""
    R = matrices(batch.features[..., ROTATIONS].unflatten(-1, (22, 6)))
    rest = torch.from_numpy(motions.rest_joints_m)[batch.body]
    return replace(batch, features=features_of(R, batch.features[..., TRANSLATION], rest))


def exact(batch: Batch) -> Batch:
    """Without noise of keyframes."""
    return replace(
        batch, noise=torch.zeros_like(batch.noise), noisy=batch.noisy[:0], turn_rad=batch.turn_rad[:0],
        shift_m=batch.shift_m[:0],
    )  # fmt: skip
