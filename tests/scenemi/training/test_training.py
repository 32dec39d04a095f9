from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG

from scenemi.data.windows import MotionSet
from scenemi.features import Statistics
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.training.batches import StepBatches
from scenemi.training.checkpoint import load_checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.keyframe_masks import draw_mask
from scenemi.training.loop import CHECKPOINT, LOG, train
from scenemi.training.losses import TrainingLoss, features_of
from scenemi.training.validate import Validator
from video2anim.errors import InputError


def losses(folder: Path) -> list[float]:
    with (folder / LOG).open(newline="") as file:
        return [float(row["total"]) for row in csv.DictReader(file)]


def test_masks_have_both_ends_and_every_density() -> None:
    rng = np.random.default_rng(0)
    for law in ("paper", "mixed"):
        masks = np.stack([draw_mask(rng, 121, law) for _ in range(500)])
        assert masks[:, [0, -1]].all()
        assert masks.sum(1).min() <= 4
        assert masks.sum(1).max() >= 115
    share = np.mean([draw_mask(rng, 121, "mixed").sum() <= 10 for _ in range(1000)])
    assert share > 0.15, "sparse keyframes are common in the mixed law"


@torch.no_grad()
def test_a_step_is_the_same_whenever_it_is_drawn(motions: MotionSet, statistics: Statistics) -> None:
    data = StepBatches(motions, statistics, CONFIG)
    a, b, c = data[3], data[3], data[4]
    assert torch.equal(a.noise, b.noise)
    assert torch.equal(a.occupancy, b.occupancy)
    assert not torch.equal(a.noise, c.noise)


@torch.no_grad()
def test_processes_share_the_same_global_batch(motions: MotionSet, statistics: Statistics) -> None:
    whole = StepBatches(motions, statistics, CONFIG)[2]
    halves = [StepBatches(motions, statistics, CONFIG, rank=rank, world=2)[2] for rank in range(2)]
    assert torch.equal(whole.translation_m[[0, 2]], halves[0].translation_m)
    assert torch.equal(whole.mask[[1, 3]], halves[1].mask)


@torch.no_grad()
def test_frames_beyond_the_clip_are_given_and_do_not_count(motions: MotionSet, statistics: Statistics) -> None:
    data = StepBatches(motions, statistics, CONFIG)
    batch = data[0]
    valid = batch.valid.clone()
    valid[:, 80:] = 0
    loss = TrainingLoss(tiny(), statistics, CONFIG)
    with torch.no_grad():
        x0 = (features_of(batch.R_parent_joint, batch.translation_m, batch.rest_joints_m) - loss.mean) / loss.std
    wrong = x0.clone()
    wrong[:, 80:] += 1.0
    late = replace(batch, valid=valid, looked_at=torch.full_like(batch.looked_at, 70))
    assert float(loss.compared(wrong, x0, late).total) < 1e-8
    wrong[:, 75:80] += 1.0
    assert float(loss.compared(wrong, x0, late).total) > 0.01


def tiny() -> Denoiser:
    torch.manual_seed(1)
    return Denoiser(CONFIG.model)


@torch.no_grad()
def test_losses_of_a_perfect_answer_are_zero(motions: MotionSet, statistics: Statistics) -> None:
    """With every frame an exact keyframe the untrained model answers with the truth: every loss vanishes."""
    batch = StepBatches(motions, statistics, CONFIG)[1]
    exact = replace(batch, mask=torch.ones_like(batch.mask), noise_level=torch.zeros_like(batch.noise_level))
    out = TrainingLoss(tiny(), statistics, CONFIG)(exact)
    assert float(out.simple) < 1e-8
    assert float(out.joints) < 1e-8
    assert float(out.velocity) < 1e-8


@torch.no_grad()
def test_losses_of_shifted_joints_are_in_metres(motions: MotionSet, statistics: Statistics) -> None:
    batch = StepBatches(motions, statistics, CONFIG)[1]
    loss = TrainingLoss(tiny(), statistics, CONFIG)
    clean = (features_of(batch.R_parent_joint, batch.translation_m, batch.rest_joints_m) - loss.mean) / loss.std
    shifted = clean.clone()
    shifted[..., 0] += 0.1 / loss.std[0]
    out = loss.compared(shifted, clean, replace(batch, valid=torch.ones(4, 121)))
    assert float(out.joints) == pytest.approx(22 * 0.01, rel=1e-3)
    assert float(out.velocity) == pytest.approx(0.0, abs=1e-7)


def test_finer_voxels_show_the_same_scenes(motions: MotionSet, statistics: Statistics) -> None:
    """Table 8's grid: every voxel of 10 cm with something in it has a filled voxel of 5 cm, and the same scenes are
    drawn (scan noise aside)."""
    fine = replace(CONFIG, model=replace(CONFIG.model, grid=(96, 48, 96), voxel_m=0.05), scene_share=1.0)
    wide = StepBatches(motions, statistics, replace(CONFIG, scene_share=1.0))[0].occupancy
    found = StepBatches(motions, statistics, fine)[0].occupancy
    assert found.shape == (4, 96, 48, 96)
    pooled = torch.nn.functional.max_pool3d(found[:, None].float(), 2)[:, 0]
    assert float((pooled == wide).float().mean()) > 0.95


def test_resuming_changes_nothing(motions: MotionSet, tmp_path: Path) -> None:
    whole = train(CONFIG, motions, tmp_path / "whole")
    train(CONFIG, motions, tmp_path / "cut", stop_at=3)
    assert load_checkpoint(tmp_path / "cut" / CHECKPOINT).step == 3
    cut = train(CONFIG, motions, tmp_path / "cut")
    assert losses(tmp_path / "whole") == losses(tmp_path / "cut")
    for name, value in whole.ema.items():
        assert torch.equal(value, cut.ema[name]), name


def test_another_configuration_does_not_resume(motions: MotionSet, tmp_path: Path) -> None:
    train(CONFIG, motions, tmp_path, stop_at=1)
    with pytest.raises(InputError, match="trained with other learning_rate"):
        train(replace(CONFIG, learning_rate=1.0), motions, tmp_path)
    train(replace(CONFIG, log_every=5), motions, tmp_path, stop_at=2)


def test_two_processes_learn_what_one_learns(archive: Path, tmp_path: Path) -> None:
    """On the command line, with torchrun and without."""
    config = tmp_path / "run.json"
    values = {"model": "tiny", "steps": 4, "batch": 4, "bodies": 1, "workers": 0, "log_every": 1, "warmup": 2}
    config.write_text(json.dumps(values | {"joiner_steps": 2, "joiner_batch": 4, "joiner_windows": 16}))
    split = tmp_path / "split.json"
    split.write_text(json.dumps({"train": ["walk_0", "sit_1", "reach_2", "pick_up_3"], "val": [], "test": []}))
    words = ["-m", "scenemi.cli", "train", "--motion", archive, "--split", split, "--config", config, "--device", "cpu"]
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    for out, run in (("one", words), ("two", torchrun + words)):
        done = subprocess.run(
            [sys.executable, *map(str, run), "--out", str(tmp_path / out)],
            timeout=300, capture_output=True, text=True, env=env, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stderr.count("no clip is for validation") == 1
    assert len(losses(tmp_path / "two")) == 4
    np.testing.assert_allclose(losses(tmp_path / "two"), losses(tmp_path / "one"), rtol=1e-4)


def test_configurations_come_from_files(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text('{"model": {"size": "tiny", "residual": false}, "steps": 7}')
    config = TrainConfig.read(path)
    assert config.model == replace(SIZES["tiny"], residual=False)
    assert config.steps == 7
    assert TrainConfig.from_json(config.to_json()) == config
    for text, match in (
        ('{"stepps": 1}', "unknown stepps"),
        ('{"model": "huge"}', "model: want"),
        ("[", "cannot read"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=match):
            TrainConfig.read(path)


def test_tiny_overfits_four_clips(motions: MotionSet, tmp_path: Path) -> None:
    """The whole of training in a minute: the learned interpolation halves the error of interpolation on clips it has
    seen, and sampling does not lose it."""
    config = TrainConfig.read(Path(__file__).parents[3] / "configs" / "scenemi" / "tiny.json")
    run = train(replace(config, workers=0, log_every=1000, validate_every=1000), motions, tmp_path)
    model = Denoiser(run.config.model)
    model.load_state_dict(run.ema)
    for row in Validator(motions, run.statistics)(model)[1:]:
        assert row.base_mjpe_m < 0.7 * row.interpolated_mjpe_m
        assert row.mjpe_m < 0.7 * row.interpolated_mjpe_m
