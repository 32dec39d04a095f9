"""The paper's form trains from the same pool: its descriptors are those that the prior makes of the same scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG, exact

from scenemi.data.windows import MotionSet
from scenemi.features import decode
from scenemi.model.config import SIZES, PaperConfig
from scenemi.model.scene_input import SceneReader
from scenemi.prior import KeyframeWindow
from scenemi.scene.boxes import Boxes
from scenemi.scene.geometry import HalfSpace, SceneGeometry
from scenemi.training.batches import Batch, PoolBatches
from scenemi.training.descriptors import descriptors_of
from scenemi.training.loop import train
from scenemi.training.pool import Shard
from scenemi.training.run import Run

NARROW = SIZES["paper-narrow"]
assert isinstance(NARROW, PaperConfig)
RUN = replace(
    CONFIG, model=NARROW, keyframes="paper", noisy_share=1.0, relative=False, scene_share=1.0, drop_global=0.4,
    drop_local=0.0, learning_rate=1e-3, warmup=5,
)  # fmt: skip


@pytest.fixture(scope="module")
def batch(shards: list[Shard]) -> Batch:
    """Exact keyframes; some windows are shown all of their scene, some the local part only."""
    found = exact(PoolBatches(shards, RUN)[0])
    filled = (found.boxes[:, 0, 3] > 0).float()
    assert filled.sum() >= 3, "another seed, please"
    one = torch.zeros(4)
    one[int(filled.argmax())] = 1
    return replace(found, scene_known=filled * (1 - one), local_known=filled)


def windows(batch: Batch, motions: MotionSet) -> list[tuple[KeyframeWindow, int]]:
    """The same windows as the prior is given them, in their own canonical frame."""
    found = []
    for i in torch.nonzero(batch.scene_known > 0)[:, 0].tolist():
        R, translation_m = decode(batch.features[i].double().numpy())
        rows = batch.boxes[i][batch.boxes[i, :, 3] > 0].double().numpy()
        scene = SceneGeometry.of(Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6]), HalfSpace(0.0))
        body = motions.body(0)
        keys = batch.mask[i].numpy() > 0
        found.append((KeyframeWindow(R, translation_m, keys, body.rest_joints_m, 30.0, scene, body=body), i))
    return found


def test_descriptors_are_those_the_prior_makes_of_the_same_scene(batch: Batch, motions: MotionSet) -> None:
    made = descriptors_of(batch, batch.features, [motions.body(0)], NARROW)
    assert made is not None
    assert made.occupancy.shape == (4, *NARROW.grid)
    for window, i in windows(batch, motions):
        given = SceneReader().read(window, np.eye(4), NARROW)
        assert given.occupancy is not None
        found = made.local_m[i].numpy()
        # Two solids equally near may be told apart by rounding.
        off_m = np.linalg.norm(found - given.local_m, axis=-1)[window.is_keyframe]
        assert np.quantile(off_m, 0.99) < 1e-3
        assert not found[~window.is_keyframe].any(), "read at keyframes only"
        np.testing.assert_array_equal(made.occupancy[i].numpy() > 0, given.occupancy)


def test_descriptors_know_which_windows_are_shown_what(batch: Batch, motions: MotionSet) -> None:
    made = descriptors_of(batch, batch.features, [motions.body(0)], NARROW)
    assert made is not None
    assert torch.equal(made.global_known, batch.scene_known)
    assert torch.equal(made.local_known, batch.local_known)
    hidden = (batch.scene_known == 0) & (batch.local_known == 0)
    assert not made.local_m[hidden].any()
    none = replace(batch, scene_known=torch.zeros(4), local_known=torch.zeros(4))
    assert descriptors_of(none, batch.features, [motions.body(0)], NARROW) is None


def test_a_few_steps_learn_something_from_the_pool(motions: MotionSet, shards: list[Shard]) -> None:
    """The same batch again and again: the loss falls, and every part of the network gets a gradient."""
    run = Run(replace(RUN, scene_share=1.0), [motions.body(0)], shards, "cpu", None)
    batch = PoolBatches(shards, RUN)[1]
    assert batch.scene_known.any()
    assert len(batch.noisy) == 4
    losses = [float(run.advance([batch])[0].total) for _ in range(12)]
    assert np.isfinite(losses).all()
    assert min(losses[-3:]) < 0.7 * losses[0]
    still = [name for name, value in run.model.named_parameters() if value.grad is None or not value.grad.any()]
    assert [name for name in still if name != "no_scene"] == []


@pytest.mark.usefixtures("small_shards")
def test_a_run_of_the_papers_form_resumes(motions: MotionSet, run_folder: Callable[[str], Path]) -> None:
    out = run_folder("paper")
    train(RUN, motions, out, stop_at=1)
    assert train(RUN, motions, out, stop_at=2).step == 2
