"""Batches drawn on the device: the pool's windows, with the shares of the configuration, and the same loss."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG, loss_of

from scenemi.data.windows import MotionSet
from scenemi.features import JOINTS, Statistics
from scenemi.model.diffusion import STEPS
from scenemi.model.mirror import mirrored
from scenemi.scene.field import BoxField
from scenemi.scene.rows import BoxRows
from scenemi.training import device_batches
from scenemi.training.batches import PoolBatches
from scenemi.training.config import TrainConfig
from scenemi.training.device_batches import AllBoxes, DeviceBatches, read_shard
from scenemi.training.noise import PipelineErrors
from scenemi.training.pool import Shard

WIDE = replace(CONFIG, batch=200)
NARROW = replace(CONFIG, batch=40)
"""50 batches of these tell a mean as well as 12 of 200 (0.018 of 0.44), in two thirds of the time: whether a batch is
conditioned on an estimate is drawn more often. All shares of 40 windows are whole numbers of windows, as those of 200
are."""
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def fewer_masks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Still more than the windows that any of these tests draws."""
    monkeypatch.setattr(device_batches, "_MASKS", 4096)


@pytest.fixture(scope="module")
def errors() -> PipelineErrors:
    """Two runs, the second shorter than a window; constant errors of a tenth of a radian, shifts that grow."""
    grow = np.concatenate([np.arange(200), np.arange(20)])
    shift_m = (grow[:, None] * np.array([0.001, 0.0, 0.002])).astype(np.float16)
    return PipelineErrors(np.full((220, 22, 3), 0.1, np.float16), shift_m, np.array([0, 200, 220]))


def filled(
    shards: list[Shard], errors: PipelineErrors | None = None, seed: int = 0, config: TrainConfig = WIDE
) -> DeviceBatches:
    data = DeviceBatches(config, sum(map(len, shards)), CPU, errors, seed)
    for shard in shards:
        data.add(shard)
    return data


def test_windows_are_those_of_the_pool_and_half_are_mirrored(shards: list[Shard]) -> None:
    batch = filled(shards).draw()
    units = np.concatenate([shard.features for shard in shards])
    features = torch.from_numpy(units.astype(np.float32) / 8192)
    apart = [
        torch.cdist(batch.features[:, 60], some[:, 60], p=torch.inf).amin(1) for some in (features, mirrored(features))
    ]
    assert (torch.minimum(*apart) < 1e-5).all()
    assert 0.35 < float((apart[1] < apart[0]).float().mean()) < 0.65


def test_shares_are_those_of_the_configuration(shards: list[Shard], errors: PipelineErrors) -> None:
    batch = filled(shards, errors).draw()
    count = WIDE.batch
    assert batch.shown is not None
    assert len(batch.shown) == round(WIDE.scene_share * count)
    assert len(batch.noisy) == round((WIDE.pipeline_share + WIDE.noisy_share) * count)
    assert abs(float((batch.step == STEPS).float().mean()) - WIDE.first_step_share) < 0.1
    assert (batch.mask[:, 0] == 1).all()
    assert (batch.mask[:, -1] == 1).all()
    assert (batch.noise[len(batch.noisy) :] == 0).all()
    assert (batch.noise[: len(batch.noisy)] > 0).all()


def test_errors_of_the_pipeline_keep_their_size_and_begin_at_the_window(
    shards: list[Shard], errors: PipelineErrors
) -> None:
    data = filled(shards, errors)
    batch = data.draw()
    turn, shift = batch.turn_rad[: data.piped], batch.shift_m[: data.piped]
    size = turn[:, 0, 0, 0] / 0.1
    assert (turn == turn[:, :1, :1, :1]).all()
    assert float(size.min()) >= 0.4
    assert float(size.max()) <= 1.3
    torch.testing.assert_close(shift[:, 0], torch.zeros(data.piped, 3))
    lengths = shift.norm(dim=-1) / size[:, None]
    assert float(lengths.max()) <= 120 * np.hypot(0.001, 0.002) + 1e-2
    assert float(lengths[:, 1:].max(1).values.min()) > 0.9 * 19 * np.hypot(0.001, 0.002), "short runs too go on"


def test_all_boxes_at_once_answer_as_one_after_the_other(shards: list[Shard]) -> None:
    batch = filled(shards).draw()
    known = torch.zeros(WIDE.batch)
    known[batch.shown] = 1
    points = batch.features[..., JOINTS].reshape(WIDE.batch, -1, 3)
    field, wanted = batch.scene.field(known), BoxRows(batch.boxes).field(known)
    assert isinstance(field, AllBoxes)
    assert type(wanted) is BoxField
    for found, expected in zip(field.query(points), wanted.query(points), strict=True):
        torch.testing.assert_close(found, expected)
    found, expected = torch.zeros(2, WIDE.batch, points.shape[1])
    found[field.rows], expected[wanted.rows] = field.distance_m(points), wanted.distance_m(points)
    torch.testing.assert_close(found, expected)


def test_the_loss_is_that_of_batches_of_the_processor(
    shards: list[Shard], motions: MotionSet, statistics: Statistics
) -> None:
    """Both draw at random: means of many windows agree within four standard errors."""
    loss = loss_of(motions, statistics, NARROW)
    ours, theirs = filled(shards, config=NARROW), PoolBatches(shards, NARROW)
    with torch.no_grad():
        rows = [torch.tensor([[float(loss(batch).total) for batch in (ours.draw(), theirs[i])]]) for i in range(50)]
    apart = torch.cat(rows).diff(dim=1)[:, 0]
    assert abs(float(apart.mean())) < 4 * float(apart.std()) / len(apart) ** 0.5


def test_the_same_seed_draws_the_same_batch(shards: list[Shard]) -> None:
    first, again, other = (filled(shards, seed=seed).draw() for seed in (3, 3, 4))
    assert torch.equal(first.features, again.features)
    assert torch.equal(first.mask, again.mask)
    assert not torch.equal(first.features, other.features)


def test_a_full_device_takes_no_more(shards: list[Shard], pool_folder: Path) -> None:
    data = DeviceBatches(WIDE, len(shards[0]), CPU, None, 0)
    for path in sorted(pool_folder.glob("shard_????")):
        data.add(read_shard(path))
    assert data.windows == len(shards[0])
