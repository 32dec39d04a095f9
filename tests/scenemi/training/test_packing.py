"""A run is carried in small files and goes on elsewhere."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_run import CONFIG, write_procedural
from typer.testing import CliRunner

from scenemi.cli.main import app
from scenemi.data.container import MotionArchive, write_archive
from scenemi.data.split import Split
from scenemi.data.windows import MotionSet
from scenemi.model.build import build_denoiser
from scenemi.model.weights import load_weights
from scenemi.training import packing
from scenemi.training.loop import train
from scenemi.training.packing import pack_run, unpack_run
from scenemi.training.runs import RunFiles
from video2anim.errors import InputError, UsageError

SPLIT = Split({"walk_0": "train", "sit_1": "val", "reach_2": "test", "pick_up_3": "train"})


@pytest.fixture
def trained(motions: MotionSet, tmp_path: Path) -> Path:
    """A folder with a run of three steps."""
    train(CONFIG, motions, tmp_path / "run", stop_at=3)
    return tmp_path / "run"


def test_motion_comes_out_as_it_went_in_without_test_clips(archive: Path, tmp_path: Path) -> None:
    packing_files = RunFiles(CONFIG, (archive,), SPLIT, None)
    size = pack_run(tmp_path / "pack", packing_files, tmp_path / "nothing")
    assert size < 0.7 * archive.stat().st_size
    found = unpack_run(tmp_path / "pack", tmp_path / "out")
    assert found.start is None
    assert found.files is not None
    assert found.files.config == CONFIG
    assert found.files.split is not None
    assert found.files.split.named == {k: v for k, v in SPLIT.named.items() if v != "test"}
    before, after = MotionArchive.read(archive), MotionArchive.read(found.files.motion[0])
    assert set(after.names) == {"walk_0", "sit_1", "pick_up_3"}
    for name in after.names:
        a, b = before.clip(name), after.clip(name)
        np.testing.assert_array_equal(a.rotation_wxyz, b.rotation_wxyz)
        assert np.abs(a.root_position_m - b.root_position_m).max() < 1e-4
        assert (a.fps, a.kind, a.skeleton.names) == (b.fps, b.kind, b.skeleton.names)


def test_clips_that_a_run_may_not_use_stay_behind(archive: Path, tmp_path: Path) -> None:
    clips = [MotionArchive.read(archive).clip(name) for name in ("walk_0", "sit_1")]
    write_archive(tmp_path / "both.npz", [clips[0], replace(clips[1], source="bandai1")])
    pack_run(tmp_path / "pack", RunFiles(CONFIG, (tmp_path / "both.npz",), SPLIT, None), tmp_path)
    found = unpack_run(tmp_path / "pack", tmp_path / "out").files
    assert found is not None
    assert MotionArchive.read(found.motion[0]).names == ("walk_0",)


def test_the_state_goes_on_where_it_was_and_files_are_small(
    trained: Path, motions: MotionSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packing, "PIECE_BYTES", 100_000)
    pack_run(tmp_path / "pack", RunFiles(CONFIG, (), None, None), trained)
    pieces = sorted((tmp_path / "pack").iterdir())
    assert len(pieces) > 3
    assert max(piece.stat().st_size for piece in pieces) <= 100_000
    found = unpack_run(tmp_path / "pack", tmp_path / "there")
    assert found.files is None
    assert found.start is not None
    loaded = load_weights(found.start)
    model = build_denoiser(CONFIG.model)
    for name, value in loaded.denoiser.state_dict().items():
        assert value.shape == model.state_dict()[name].shape
    exact = load_weights(found.start).denoiser.state_dict()
    held = train(CONFIG, motions, tmp_path / "there" / "run", start=found.start, stop_at=3)
    assert held.step == 3, "nothing was left to do"
    assert all(torch.equal(held.model[name], exact[name]) for name in exact)
    whole = packing.load_checkpoint(trained / "checkpoint.safetensors").ema
    for name, value in whole.items():
        assert (exact[name] - value).abs().max() <= value.abs().max() / 127, name


def test_the_command_packs_and_goes_on_from_a_pack(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "split.json").write_text(json.dumps({"train": ["walk_0"], "val": ["sit_1"], "test": ["reach_2"]}))
    (tmp_path / "config.json").write_text(json.dumps(CONFIG.to_json()))
    words = ["--motion", str(archive), "--split", str(tmp_path / "split.json")]
    words += ["--config", str(tmp_path / "config.json")]
    pack = ["train", *words, "--out", str(tmp_path / "run"), "--pack", str(tmp_path / "pack")]
    done = CliRunner().invoke(app, pack)
    assert done.exit_code == 0, done.output
    assert "MiB" in done.output
    there = ["train", "--from-pack", str(tmp_path / "pack"), "--out", str(tmp_path / "there"), "--minutes", "0.01"]
    done = CliRunner().invoke(app, there)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "there" / "weights.safetensors").is_file()
    back = ["train", "--out", str(tmp_path / "there"), "--pack", str(tmp_path / "back")]
    assert CliRunner().invoke(app, back).exit_code == 0
    assert sorted(path.name for path in (tmp_path / "back").iterdir()) == ["run.json", "state.00"]
    returned = unpack_run(tmp_path / "back", tmp_path / "home").start
    assert returned is not None
    assert load_weights(returned).config == CONFIG.model, "the run's own configuration, not the default"
    both = CliRunner().invoke(app, [*there, "--motion", str(archive)])
    assert isinstance(both.exception, UsageError)
    assert "give one of both" in str(both.exception)


def test_what_is_no_pack_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="scenemi train --pack"):
        unpack_run(tmp_path / "none", tmp_path / "out")
    with pytest.raises(InputError, match="neither motion nor a run"):
        pack_run(tmp_path / "pack", RunFiles(CONFIG, (), None, None), tmp_path / "none")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    archive = write_procedural(tmp_path / "a.npz", ("walk",))
    with pytest.raises(InputError, match="empty folder"):
        pack_run(tmp_path / "full", RunFiles(CONFIG, (archive,), None, None), tmp_path)
    pack_run(tmp_path / "pack", RunFiles(CONFIG, (archive,), None, None), tmp_path)
    monkeypatch.setattr(packing, "MAX_BYTES", 1000)
    with pytest.raises(InputError, match="unpacks to more than"):
        unpack_run(tmp_path / "pack", tmp_path / "out")
    monkeypatch.undo()
    piece = tmp_path / "pack" / "motion.00"
    piece.write_bytes(piece.read_bytes()[:-100])
    with pytest.raises(InputError, match="scenemi train --pack"):
        unpack_run(tmp_path / "pack", tmp_path / "out")
