"""Options that cannot apply are errors, help says what there is, and licenses are a gate."""

from __future__ import annotations

import importlib.util
import json
import os
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scenemi_cases import keyframe_arrays, scenemi, walk_archive, walk_bvh, walk_clip

from scenemi.cli import main as cli
from scenemi.data.container import MotionArchive, write_archive
from scenemi.data.import_clip import UNITS_M
from scenemi.data.plain_files import MAX_FRAMES
from scenemi.data.sources import FREE_LICENSES, license_of
from scenemi.data.windows import MotionSet, MotionSetConfig
from scenemi.training.config import TrainConfig, shipped_configs
from scenemi.training.runs import RunFiles, left_out, licenses_of
from video2anim.errors import UsageError
from video2anim.lab.synth.library import MotionDatabase

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def keyframes(tmp_path: Path) -> Path:
    np.savez(tmp_path / "keys.npz", **keyframe_arrays())
    return tmp_path / "keys.npz"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--weights", "interpolation", "--steps", "20"), "--steps: does not apply"),
        (("--weights", "interpolation", "--temperature", "0"), "--temperature: does not apply"),
        (("--weights", "interpolation", "--seed", "0"), "--seed: does not apply"),
        (("--weights", "interpolation", "--noisy"), "--noisy: does not apply"),
        (("--weights", "interpolation", "--noise", "2"), "--noise: does not apply"),
        (("--noisy", "--noise", "3"), "--noisy: does not apply with --noise"),
    ],
)
def test_sampling_options_that_cannot_apply(
    words: tuple[str, ...], message: str, keyframes: Path, tmp_path: Path
) -> None:
    done = scenemi("sample", "--keyframes", keyframes, "--out", tmp_path / "m.npz", *words)
    assert done.code == 2
    assert message in done.err
    assert not (tmp_path / "m.npz").exists()


def test_evaluation_options_that_cannot_apply(tmp_path: Path) -> None:
    words = ("evaluate", "--clips", walk_archive(tmp_path / "c.npz", 121))
    for more, message in (
        (("--part", "val"), "--part: does not apply without --split"),
        (("--weights", "interpolation", "--steps", "5"), "--steps: does not apply"),
    ):
        done = scenemi(*words, *more)
        assert done.code == 2
        assert message in done.err


def test_data_options_that_cannot_apply(tmp_path: Path) -> None:
    archive, bvh, out = walk_archive(tmp_path / "c.npz", 121), walk_bvh(tmp_path / "w.bvh"), tmp_path / "o.npz"
    mapping = tmp_path / "map.json"
    mapping.write_text("{}")
    for words, message in (
        ((archive, "--unit", "m"), "--unit: does not apply to other files than BVH"),
        ((archive, "--mapping", mapping), "--mapping: does not apply"),
        ((archive, "--kind", "walk"), "--kind: does not apply"),
        ((archive, "--source", "mine", "--license", "own"), "--source: does not apply"),
        ((bvh, "--license", "own"), "--license: does not apply without --source"),
        ((bvh, "--out", out), "--out: want --source NAME"),
        ((bvh, "--out", out, "--source", "mine"), "--license: want the license of 'mine'"),
        ((bvh, "--out", out, "--source", "bandai1", "--license", "MIT"), "bandai1 has CC-BY-NC-4.0, got MIT"),
    ):
        done = scenemi("data", *words)
        assert done.code == 2, done.err
        assert message in done.err
        assert not out.exists()


def test_training_options_that_cannot_apply(tmp_path: Path) -> None:
    words = ("train", "--motion", walk_archive(tmp_path / "c.npz", 121), "--out", tmp_path / "run")
    for more in (("--minutes", "1"), ("--cool-steps", "5"), ("--start", "w"), ("--errors", "e"), ("--cache", "c")):
        done = scenemi(*words, "--pack", tmp_path / "pack", *more)
        assert done.code == 2
        assert f"{more[0]}: does not apply with --pack" in done.err
        assert not (tmp_path / "pack").exists()


def test_weights_to_begin_from_must_be_there(tmp_path: Path) -> None:
    words = ("train", "--motion", walk_archive(tmp_path / "c.npz", 121), "--out", tmp_path / "run")
    done = scenemi(*words, "--start", tmp_path / "typo.safetensors")
    assert done.code == 3
    assert "--start: want a file of weights, found none" in done.err
    assert not (tmp_path / "run").exists()


def test_what_the_system_refuses_is_one_line(tmp_path: Path) -> None:
    words = ("train", "--motion", walk_archive(tmp_path / "c.npz", 121))
    for out, code, message in (("", 2, "--out: want a value"), ("/dev/null/run", 3, "Not a directory")):
        done = scenemi(*words, "--out", out, "--pack", out)
        assert done.code == code, done.err
        assert message in done.err
        assert len(done.err.splitlines()) == 1


def test_a_device_is_no_place_for_a_file(tmp_path: Path) -> None:
    """It would be replaced by a file."""
    os.mkfifo(tmp_path / "pipe")
    done = scenemi("data", walk_archive(tmp_path / "c.npz", 121), "--out", tmp_path / "pipe")
    assert done.code == 3
    assert "want a file" in done.err
    assert (tmp_path / "pipe").is_fifo()


def test_help_names_all_units_and_limits_and_no_types_of_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for command in ("sample", "evaluate", "train", "data"):
        text = scenemi(command, "--help").out
        assert "list[" not in text
        assert "<bool>" not in text
        assert "--help" in text
    for unit in UNITS_M:
        assert re.search(rf"\b{unit}\b", cli.UNITS), unit
    assert cli.MAX_FRAMES == MAX_FRAMES


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": "abc"}, "unknown steps"),
        ({"model": 5}, "model: want"),
        ({"model": None}, "model: want"),
        ({"model": {"width": "abc"}}, "width"),
        ({"model": {"heads": 0}}, "heads"),
        ({"model": {"layers": 10**9}}, "layers"),
        ({"model": {"size": ["tiny"]}}, "model: want"),
        ({"log_every": 0}, "log_every"),
        ({"noisy_share": 1.5}, "noisy_share"),
        ({"learning_rate": float("inf")}, "learning_rate"),
        ({"bodies": -1}, "bodies"),
    ],
)
def test_training_settings_are_checked_before_the_run(values: dict[str, Any], message: str, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps(values))
    archive = walk_archive(tmp_path / "c.npz", 121)
    words = ("train", "--motion", archive, "--out", tmp_path / "run", "--config", tmp_path / "run.json")
    done = scenemi(*words)
    assert (done.code, len(done.err.splitlines())) == (3, 1), done.err
    assert message in done.err
    assert not (tmp_path / "run").exists()


def test_settings_have_names_and_the_default_is_small() -> None:
    assert {"small", "tiny", "gpu", "paper", "research"} <= set(shipped_configs())
    assert TrainConfig.read("small") == TrainConfig()
    assert TrainConfig.read("research").sources is not None
    with pytest.raises(UsageError, match=r"want a \.json file or one of"):
        TrainConfig.read("enormous")


def test_what_is_not_known_is_not_free(tmp_path: Path) -> None:
    """A raw BVH file got the source `bvh`, which counted as free."""
    mine, theirs = walk_bvh(tmp_path / "mine.bvh"), walk_bvh(tmp_path / "theirs.bvh")
    for path, source, license_name in ((mine, "mine", "own"), (theirs, "somebody", "CC-BY-NC-4.0")):
        words = ("--source", source, "--license", license_name, "--out", path.with_suffix(".npz"))
        assert scenemi("data", path, *words).code == 0
    archives = tmp_path / "mine.npz", tmp_path / "theirs.npz"
    assert [MotionArchive.read(path).free for path in archives] == [(True,), (False,)]
    chosen = MotionSet.build(archives, None, None, 1)
    assert chosen.store.clip_name.tolist() == ["mine"]
    every = MotionSet.build(archives, None, None, 1, MotionSetConfig(noncommercial=True))
    assert sorted(every.store.clip_name.tolist()) == ["mine", "theirs"]
    assert [row[1] for row in MotionDatabase.read(archives).clips] == ["mine"]
    files = RunFiles(TrainConfig(), archives, None, None)
    assert len(left_out(files)) == 1
    assert "1 clips of somebody (license CC-BY-NC-4.0)" in left_out(files)[0]
    assert licenses_of(files, every) == {"mine": "own", "somebody": "CC-BY-NC-4.0"}


def test_one_table_for_both_packages(tmp_path: Path) -> None:
    """`video2anim synth` had a table of its own, in which amass was free."""
    sources = ("amass", "trumans", "gimo", "prox", "bandai1", "bandai2", "sie", "mhad", "bvh", "synthetic")
    write_archive(tmp_path / "c.npz", [walk_clip(40, name=source, source=source) for source in sources])
    assert [row[1] for row in MotionDatabase.read([tmp_path / "c.npz"]).clips] == ["synthetic"]
    assert len(MotionDatabase.read([tmp_path / "c.npz"], noncommercial=True).clips) == len(sources)


def test_archives_keep_licenses_and_old_ones_have_those_of_their_sources(tmp_path: Path) -> None:
    clips = [walk_clip(40, name="a"), walk_clip(40, name="b", source="mine", license="own")]
    write_archive(tmp_path / "new.npz", clips)
    archive = MotionArchive.read(tmp_path / "new.npz")
    assert archive.licenses == (license_of("synthetic"), "own")
    write_archive(tmp_path / "again.npz", [archive.clip(name) for name in archive.names])
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "new.npz").read_bytes()
    write_archive(tmp_path / "old.npz", clips[:1])
    with np.load(tmp_path / "old.npz", allow_pickle=False) as file:
        assert "clip_license" not in file.files, "as older versions wrote it"


@pytest.fixture(scope="module")
def publish() -> ModuleType:
    spec = importlib.util.spec_from_file_location("publish_weights", REPOSITORY / "tools" / "publish_weights.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_weights_of_what_is_not_known_to_be_free_are_not_published(publish: ModuleType) -> None:
    assert publish.barred_sources({"sources": ["cmu_daz", "accad", "synthetic"]}) == {}
    assert publish.barred_sources({"sources": ["cmu_daz", "bvh"]}) == {"bvh": "unknown"}
    assert publish.barred_sources({"sources": ["mine"], "licenses": {"mine": "own"}}) == {}
    assert publish.barred_sources({"sources": ["x"], "licenses": {"x": "CC-BY-NC-4.0"}}) == {"x": "CC-BY-NC-4.0"}
    assert all("NC" not in name for name in FREE_LICENSES)
