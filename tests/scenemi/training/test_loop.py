"""Runs that can be cut anywhere, refuse what does not fit, and learn."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG, SHARD, shrink

from scenemi.data.windows import MotionSet
from scenemi.features import Statistics
from scenemi.model.base import join_keyframes
from scenemi.model.build import build_denoiser
from scenemi.model.conditions import Conditions
from scenemi.model.config import SIZES
from scenemi.model.denoiser import Denoiser
from scenemi.model.weights import load_weights, save_weights
from scenemi.training.batches import PoolBatches
from scenemi.training.checkpoint import FORMAT, Checkpoint, load_checkpoint
from scenemi.training.loop import CHECKPOINT, POOL, cool, train
from scenemi.training.pool import Shard, open_pool
from scenemi.training.run import Progress, Run
from scenemi.training.runs import RunFiles, motions_for, write_run_weights
from scenemi.training.validate import Validator
from scenemi.training.watch import LOG, PROGRESS
from video2anim.errors import InputError, StageError

RunFolder = Callable[[str], Path]


def losses(folder: Path) -> list[float]:
    with (folder / LOG).open(newline="") as file:
        return [float(row["total"]) for row in csv.DictReader(file)]


def same(a: Checkpoint, b: Checkpoint) -> bool:
    parts = ((a.ema, b.ema), (a.model, b.model))
    return a.step == b.step and all(torch.equal(x[name], y[name]) for x, y in parts for name in x)


def a_run(motions: MotionSet, shards: list[Shard], **changes: object) -> Run:
    return Run(replace(CONFIG, **changes), [motions.body(0)], shards, "cpu", None)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def whole(motions: MotionSet, pool_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Checkpoint]:
    """Six steps without a break."""
    out = tmp_path_factory.mktemp("whole")
    (out / POOL).symlink_to(pool_folder)
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        return out, train(CONFIG, motions, out, stop_at=6)


def test_resuming_changes_nothing(motions: MotionSet, whole: tuple[Path, Checkpoint], run_folder: RunFolder) -> None:
    out = run_folder("cut")
    train(CONFIG, motions, out, stop_at=3)
    assert load_checkpoint(out / CHECKPOINT).step == 3
    assert same(train(CONFIG, motions, out, stop_at=6), whole[1])
    assert losses(out) == losses(whole[0])
    assert len(losses(out)) == 6


def test_an_interrupted_run_saves_its_state_and_goes_on(
    motions: MotionSet, whole: tuple[Path, Checkpoint], run_folder: RunFolder
) -> None:
    """As on Ctrl-C."""
    out = run_folder("cut")

    def stop(progress: Progress) -> None:
        if progress.step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, motions, out, on_progress=stop)
    assert load_checkpoint(out / CHECKPOINT).step == 5
    assert json.loads((out / PROGRESS).read_text())["step"] == 5
    assert same(train(CONFIG, motions, out, stop_at=6), whole[1])
    assert losses(out) == losses(whole[0])


KILLED = """
import os, signal, sys
from pathlib import Path
from scenemi.data.windows import MotionSet
import pytest
from scenemi.training import checkpoint, loop
from small_run import CONFIG, PLAIN, shrink
shrink(pytest.MonkeyPatch())
plain = os.replace
saved = []
def replace(aside, path):
    saved.extend([path] if Path(path).name == checkpoint.CHECKPOINT else [])
    if len(saved) == 2:
        os.truncate(aside, os.path.getsize(aside) // 2)
        os.kill(os.getpid(), signal.SIGKILL)
    plain(aside, path)
os.replace = replace
motions = MotionSet.build([sys.argv[1]], None, None, bodies=1, config=PLAIN)
loop.train(CONFIG, motions, Path(sys.argv[2]))
"""


def test_a_run_killed_while_it_saves_leaves_its_last_whole_checkpoint(
    motions: MotionSet, archive: Path, whole: tuple[Path, Checkpoint], run_folder: RunFolder
) -> None:
    out = run_folder("killed")
    paths = [str(Path(__file__).parent), *sys.path]
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(archive), str(out)],
        capture_output=True, text=True, timeout=300, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert load_checkpoint(out / CHECKPOINT).step == 2
    assert len(losses(out)) == 4, "two steps were not saved"
    resumed = train(CONFIG, motions, out, stop_at=6)
    np.testing.assert_allclose(losses(out), losses(whole[0]), rtol=1e-3)
    assert resumed.step == 6


def test_another_configuration_does_not_resume(motions: MotionSet, run_folder: RunFolder) -> None:
    out = run_folder("run")
    train(CONFIG, motions, out, stop_at=1)
    with pytest.raises(InputError, match="trained with other learning_rate"):
        train(replace(CONFIG, learning_rate=1.0), motions, out, stop_at=2)
    with pytest.raises(InputError, match="trained with other model, seed"):
        train(replace(CONFIG, seed=5, model=replace(SIZES["tiny"], layers=1)), motions, out, stop_at=2)
    free = replace(CONFIG, log_every=5, workers=1, save_every=7, validate_every=9)
    assert train(free, motions, out, stop_at=2).step == 2


def test_a_broken_checkpoint_is_named(motions: MotionSet, run_folder: RunFolder) -> None:
    out = run_folder("run")
    (out / CHECKPOINT).write_bytes(b"no")
    with pytest.raises(InputError, match="cannot read"):
        train(CONFIG, motions, out, stop_at=1)
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(1)}, str(out / CHECKPOINT), {"format": "other"})
    with pytest.raises(InputError, match=f"want format {FORMAT}"):
        train(CONFIG, motions, out, stop_at=1)


@pytest.mark.parametrize("part", ["model", "ema", "statistics"])
def test_a_checkpoint_that_does_not_fit_itself_is_named(
    whole: tuple[Path, Checkpoint], tmp_path: Path, part: str
) -> None:
    from scenemi.training.checkpoint import save_checkpoint

    held = getattr(whole[1], part)
    odd = replace(held, mean=held.mean[None]) if part == "statistics" else {**held, next(iter(held)): torch.zeros(3)}
    save_checkpoint(tmp_path / CHECKPOINT, replace(whole[1], **{part: odd}))
    with pytest.raises(InputError, match="is damaged") as caught:
        load_checkpoint(tmp_path / CHECKPOINT)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_written_leaves_what_was_there(whole: tuple[Path, Checkpoint], tmp_path: Path) -> None:
    """A limit on the size of files stands for a full disk."""
    from scenemi.training.checkpoint import save_checkpoint

    model = Denoiser(SIZES["tiny"])  # type: ignore[arg-type]
    writers = {
        CHECKPOINT: lambda path: save_checkpoint(path, whole[1]),
        "weights.safetensors": lambda path: save_weights(path, model, whole[1].statistics, {}),
    }
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for name, write in writers.items():
        write(tmp_path / name)
        before = (tmp_path / name).read_bytes()
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
        try:
            with pytest.raises(InputError, match="cannot be written"):
                write(tmp_path / name)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert (tmp_path / name).read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(writers)


@pytest.mark.parametrize("size", sorted(SIZES))
def test_the_configuration_of_any_size_comes_back_from_a_checkpoint(
    whole: tuple[Path, Checkpoint], tmp_path: Path, size: str
) -> None:
    from scenemi.training.checkpoint import save_checkpoint

    config = replace(CONFIG, model=SIZES[size], sources=("cmu",))
    state = build_denoiser(config.model).state_dict()
    saved = replace(whole[1], config=config, model=state, ema=state)
    save_checkpoint(tmp_path / CHECKPOINT, saved)
    found = load_checkpoint(tmp_path / CHECKPOINT)
    assert found.config == config
    assert same(found, saved)
    for number, values in whole[1].optimizer["state"].items():
        for name, value in values.items():
            assert torch.equal(found.optimizer["state"][number][name], torch.as_tensor(value))
    np.testing.assert_array_equal(found.statistics.std, whole[1].statistics.std)


def test_cooling_leaves_the_run_as_it_is(motions: MotionSet, run_folder: RunFolder) -> None:
    out = run_folder("run")
    held = train(CONFIG, motions, out, stop_at=2)
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    cooled = cool(out, motions, 3)
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    assert cooled.step == 5
    assert not same(replace(cooled, step=2), load_checkpoint(out / CHECKPOINT))
    assert same(load_checkpoint(out / CHECKPOINT), held)
    with pytest.raises(InputError, match="cannot read"):
        cool(out / "none", motions, 1)


def test_the_rate_falls_to_zero_while_cooling(
    motions: MotionSet, run_folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run_folder("run")
    train(CONFIG, motions, out, stop_at=2)
    rates: list[float] = []
    plain = Run.advance

    def seen(self: Run, batch: object, rate: float = 1.0):
        found = plain(self, batch, rate)
        rates.append(self.optimizer.param_groups[0]["lr"] / CONFIG.learning_rate)
        return found

    monkeypatch.setattr(Run, "advance", seen)
    cool(out, motions, 4)
    np.testing.assert_allclose(rates, [1.0, 0.75, 0.5, 0.25])


def test_the_rate_rises_at_the_beginning_and_stays(motions: MotionSet, shards: list[Shard], data: PoolBatches) -> None:
    run = a_run(motions, shards, warmup=3)
    rates = []
    for step in range(5):
        run.advance(data.of_step(step))
        rates.append(run.optimizer.param_groups[0]["lr"] / CONFIG.learning_rate)
    np.testing.assert_allclose(rates, [1 / 3, 2 / 3, 1, 1, 1])


def test_batches_of_a_step_are_averaged_alike_on_one_thread_and_on_two(motions: MotionSet, shards: list[Shard]) -> None:
    held = torch.get_num_threads()
    data = PoolBatches(shards, replace(CONFIG, parts=2))
    try:
        found = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            run = a_run(motions, shards, parts=2, warmup=0)
            losses, norm = run.advance(data.of_step(0))
            assert torch.get_num_threads() == threads, "the next run has its threads, too"
            found.append((run, float(losses.total), norm))
    finally:
        torch.set_num_threads(held)
    (one, loss, norm), (two, other_loss, other_norm) = found
    assert (loss, norm) == pytest.approx((other_loss, other_norm), rel=1e-5)
    for a, b in zip(one.model.parameters(), two.model.parameters(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0)
    alone = [float(a_run(motions, shards).advance([batch])[0].total) for batch in data.of_step(0)]
    assert loss == pytest.approx(np.mean(alone), rel=1e-5)


def test_a_run_whose_helper_has_died_says_so(motions: MotionSet, shards: list[Shard]) -> None:
    held = torch.get_num_threads()
    data = PoolBatches(shards, replace(CONFIG, parts=2))
    run = a_run(motions, shards, parts=2)
    try:
        torch.set_num_threads(2)
        before = set(multiprocessing.active_children())
        run.advance(data.of_step(0))
        (helper,) = set(multiprocessing.active_children()) - before
        helper.kill()
        helper.join()
        with pytest.raises(StageError, match="start again"):
            run.advance(data.of_step(1))
    finally:
        torch.set_num_threads(held)


def test_steps_without_a_finite_gradient_change_nothing(
    motions: MotionSet, shards: list[Shard], data: PoolBatches
) -> None:
    run = a_run(motions, shards)
    run.advance(data.of_step(0))
    before = [value.clone() for value in (*run.model.state_dict().values(), *run.average.values())]
    bad = replace(data[1], features=torch.full_like(data[1].features, torch.nan))
    _, norm = run.advance([bad])
    assert not np.isfinite(norm)
    after = (*run.model.state_dict().values(), *run.average.values())
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert run.step == 2
    assert run.progress(0.0).skipped == 1, "told to who watches"
    _, norm = run.advance(data.of_step(2))
    assert np.isfinite(norm), "the next step is one like any other"
    for _ in range(20):
        run.advance([bad])
    with pytest.raises(StageError, match="21 steps in a row without a finite gradient"):
        run.advance([bad])


def test_a_run_without_finite_gradients_ends_with_one_line(motions: MotionSet, run_folder: RunFolder) -> None:
    with pytest.raises(StageError, match="without a finite gradient") as raised:
        train(replace(CONFIG, learning_rate=1e30), motions, run_folder("run"), stop_at=100)
    assert "\n" not in str(raised.value)
    assert "learning_rate" in str(raised.value), "what to do"


def test_the_average_follows_the_weights(motions: MotionSet, shards: list[Shard], data: PoolBatches) -> None:
    """Its width is a share of the steps so far: a tenth of the mean age, whatever the step (Karras et al. 2024)."""
    run = a_run(motions, shards, ema=0.1)
    name = "network.leave.bias"
    seen = []
    for step in range(40):
        run.advance(data.of_step(step))
        seen.append(run.model.state_dict()[name].clone())
    # Weights of past steps by the power function t^gamma whose relative width is 0.1 (gamma = 6.94).
    steps = np.arange(1, 41)
    share = steps**6.94 / (steps**6.94).sum()
    expected = sum(float(part) * value for part, value in zip(share, seen, strict=True))
    torch.testing.assert_close(run.average[name], expected, atol=2e-2 * float(expected.abs().max()), rtol=0.05)


def test_the_pool_grows_while_training(motions: MotionSet, run_folder: RunFolder) -> None:
    out = run_folder("run")
    train(replace(CONFIG, pool_windows=3 * SHARD), motions, out, stop_at=4)
    assert len(open_pool(out / POOL)) == 3, "one more shard at a time, as many as wanted"
    train(replace(CONFIG, pool_windows=3 * SHARD), motions, out, stop_at=8)
    assert len(open_pool(out / POOL)) == 3


def test_a_run_ends_in_time_and_tells_where_it_is(motions: MotionSet, run_folder: RunFolder) -> None:
    out, told = run_folder("run"), []
    found = train(
        replace(CONFIG, validate_every=1), motions, out, validation=motions, time_limit_s=0.0,
        on_progress=told.append,
    )  # fmt: skip
    assert found.step == 1
    assert load_checkpoint(out / CHECKPOINT).step == 1
    progress = json.loads((out / PROGRESS).read_text())
    assert progress["step"] == 1
    assert progress["windows"] == CONFIG.batch
    assert progress["validated_at"] == 1
    assert [row["interval"] for row in progress["validation"]] == [15, 30, 60, 60]
    best = progress["best"]["mjpe_ratio r=30"]
    assert best["step"] == 1
    assert best["value"] == progress["validation"][1]["mjpe_ratio"]
    assert [len(one.validation) for one in told] == [0, 4]
    train(replace(CONFIG, validate_every=2), motions, out, validation=motions, stop_at=2)
    later = json.loads((out / PROGRESS).read_text())
    assert later["step"] == later["validated_at"] == 2
    assert later["best"]["mjpe_ratio r=30"]["value"] <= best["value"]


def test_a_run_may_begin_from_shipped_weights(
    motions: MotionSet, run_folder: RunFolder, whole: tuple[Path, Checkpoint], tmp_path: Path
) -> None:
    model = Denoiser(SIZES["tiny"])  # type: ignore[arg-type]
    model.load_state_dict(whole[1].ema)
    path = tmp_path / "shipped.safetensors"
    save_weights(path, model, whole[1].statistics, {"steps": 6, "hours": 0.5}, half=False)
    going_on = train(CONFIG, motions, run_folder("a"), start=path, stop_at=7)
    assert going_on.step == 7
    assert going_on.seconds > 1800
    save_weights(path, Denoiser(replace(SIZES["tiny"], layers=1)), whole[1].statistics, {"steps": 6})  # type: ignore
    assert train(CONFIG, motions, run_folder("b"), start=path, stop_at=1).step == 1, "another architecture does not fit"
    path.write_bytes(b"of an older format")
    assert train(CONFIG, motions, run_folder("c"), start=path, stop_at=1).step == 1
    assert train(CONFIG, motions, run_folder("d"), start=tmp_path / "none.safetensors", stop_at=1).step == 1


def test_weights_of_a_run_tell_what_they_were_trained_on(
    motions: MotionSet, whole: tuple[Path, Checkpoint], tmp_path: Path
) -> None:
    loaded = load_weights(write_run_weights(tmp_path / "w.safetensors", whole[1], motions))
    assert loaded.config == CONFIG.model
    assert loaded.card["steps"] == 6
    assert loaded.card["sources"] == ["synthetic"]
    assert loaded.card["minutes"] == pytest.approx(motions.minutes, abs=0.1)
    for name, value in loaded.denoiser.state_dict().items():
        torch.testing.assert_close(value, whole[1].ema[name], atol=2e-3, rtol=1e-3)


def test_a_run_is_made_of_a_configuration_and_clips(archive: Path, tmp_path: Path) -> None:
    split = tmp_path / "split.json"
    split.write_text(json.dumps({"train": ["walk_0", "sit_1"], "val": ["reach_2"], "test": ["pick_up_3"]}))
    config = tmp_path / "run.json"
    config.write_text('{"model": "tiny", "bodies": 1}')
    training, watched = motions_for(RunFiles.of(config, [archive], split, None))
    assert set(training.store.clip_name) == {"walk_0", "sit_1"}
    assert watched is not None
    assert set(watched.store.clip_name) == {"reach_2"}
    split.write_text(json.dumps({"train": ["walk_0"], "val": [], "test": []}))
    assert motions_for(RunFiles.of(config, [archive], split, None))[1] is None
    assert RunFiles.of(None, [archive], None, None).config.model == SIZES["small"]


def test_joined_keyframes_are_the_measure_of_validation(motions: MotionSet, statistics: Statistics) -> None:
    """A model that answers with them has ratio 1; one that knows the truth has 0 and collides with nothing."""
    validator = Validator(motions, statistics)

    class Joined(Denoiser):
        def forward(self, x: object, t: object, given: Conditions, *_: object) -> torch.Tensor:  # type: ignore[override]
            return given.base

    rows = validator(Joined(SIZES["tiny"]))  # type: ignore[arg-type]
    assert [(row.interval, row.scene) for row in rows] == [(15, False), (30, False), (60, False), (60, True)]
    assert all(row.mjpe_ratio == pytest.approx(1.0, abs=1e-5) for row in rows)
    assert all(row.jerk_ratio < 0.6 for row in rows), "curves are smoother than people"
    assert np.isnan([row.inside for row in rows[:2]]).all()
    assert rows[2].inside == rows[3].inside

    class Knowing(Denoiser):
        def forward(self, *_: object) -> torch.Tensor:  # type: ignore[override]
            return statistics.normalize(validator.features)

    (perfect,) = (validator.row(Knowing(SIZES["tiny"]), 30, shown=False),)  # type: ignore[arg-type]
    assert perfect.mjpe_ratio == pytest.approx(0.0, abs=1e-4)
    assert perfect.jerk_ratio == pytest.approx(1.0, abs=1e-3)
    assert perfect.inside == pytest.approx(0.0, abs=0.02)


def test_validation_leaves_the_model_training(motions: MotionSet, statistics: Statistics) -> None:
    model = Denoiser(SIZES["tiny"]).train()  # type: ignore[arg-type]
    validator = Validator(motions, statistics)
    first, again = validator(model), validator(model)
    assert model.training
    assert [row.mjpe_ratio for row in first] == [row.mjpe_ratio for row in again], "the same windows each time"


@pytest.mark.slow
def test_a_tiny_model_learns_four_clips_by_heart(motions: MotionSet, shards: list[Shard], data: PoolBatches) -> None:
    """Half of what joined keyframes miss at one keyframe a second, in sampled windows; without the terms for speed,
    with which learning takes several times as long."""
    run = a_run(motions, shards, batch=8, learning_rate=1e-3, warmup=20, velocity_weight=0.0, acceleration_weight=0.0)
    validator = Validator(motions, run.statistics)
    features, mask = validator.features.repeat(2, 1, 1), torch.zeros(8, 121)
    mask[:, ::30] = 1
    assert len(features) == 8
    plain = PoolBatches(shards, replace(run.config, scene_share=0.0, noisy_share=0.0))
    for step in range(150):  # 0.33, with either of two seeds
        run.advance([replace(plain[step], features=features, mask=mask, valid=torch.ones(8, 121))])
    row = validator.row(run.averaged(), 30)
    assert row.mjpe_ratio < 0.5
    base = join_keyframes(features, mask)
    assert (base - features)[mask > 0].abs().max() < 1e-5
