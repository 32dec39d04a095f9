"""`video2anim synth` as a user has it: what it refuses, that it repeats itself, what it writes."""

from __future__ import annotations

import errno
import json
import os
import subprocess
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command import command_line, video2anim

from scenemi.data.container import MotionArchive, write_archive
from video2anim.artifacts.folder import folder_digest
from video2anim.lab.synth.generate import SynthConfig, clip_key, finished_clip
from video2anim.lab.synth.presets import clip_specs

MOTION = Path(__file__).resolve().parents[4] / "shared" / "motion"
SMALL = ("--size", "96x72", "--longest", "0.3")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--preset", "nice"), 2, "--preset: want one of bench, random, hidden"),
        (("--count", "25"), 2, "--count: want 1 to 24"),
        (("--count", "0"), 2, "--count"),
        (("--seed", "-1"), 2, "--seed"),
        (("--workers", "0"), 2, "--workers"),
        (("--size", "huge"), 2, "--size: want two numbers"),
        (("--size", "10x10"), 2, "--size: want numbers from 64"),
        (("--room-size", "x"), 2, "--room-size"),
        (("--longest", "0"), 2, "--longest: want more than 0"),
        (("--frames-only", "--motion-only"), 2, "exclude each other"),
        (("--longest", "nan"), 2, "--longest: want more than 0"),
        (("--longest", "inf"), 2, "--longest: want more than 0"),
        (("--size", "96.5x72"), 2, "--size: want whole numbers"),
        (("--seed", "9" * 30), 2, "--seed: want 0 to"),
        (("--frames-only", "--seed", "9" * 30), 2, "--seed: want 0 to"),
        (("--motion-only", "--seed", "9" * 30), 2, "--seed: want 0 to"),
        (("--frames-only", "--count", "-40"), 2, "--count: want 1 to 1000000, got -40"),
        (("--frames-only", "--count", "9" * 12), 2, "--count: want 1 to 1000000, got 999"),
        (("--motion-only", "--count", "9" * 12), 2, "--count: want 1 to 100000, got 999"),
        (("--motion-only", "--preset", "nosuch", "--motion", "absent.npz"), 2, "--preset, --motion: cannot apply with"),
        (("--motion-only", "--meshes", "absent", "--size", "96x72"), 2, "--size, --meshes: cannot apply with"),
        (("--motion-only", "--workers", "1"), 2, "--workers: cannot apply with --motion-only"),
        (("--frames-only", "--preset", "nosuch"), 2, "--preset: cannot apply with --frames-only"),
        (("--frames-only", "--longest", "2"), 2, "--longest: cannot apply with --frames-only"),
        (("--noncommercial",), 2, "--noncommercial: selects clips of --motion"),
        (("--motion", "absent.npz"), 3, "absent.npz"),
        (("--motion", "x" * 300), 3, "file name too long"),
        (("--meshes", "x" * 300), 3, "file name too long"),
        (("--meshes", "absent"), 3, "absent"),
        (("--preset", "bench", "--count", "1", "--room-size", "1x1.5"), 3, "needs a room of"),
    ],
)
def test_an_invalid_request_is_one_line_and_leaves_nothing(
    tmp_path: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    answer = video2anim(
        "synth", "--out", tmp_path / "out", *words, *(() if {"--size", "--motion-only"} & {*words} else SMALL[:2])
    )
    assert answer.code == code
    assert len(answer.errors) == 1
    assert said in answer.err
    assert not list(tmp_path.rglob("*.*"))


@pytest.mark.parametrize("words", [("--count", "1", *SMALL), ("--frames-only", "--count", "1", "--size", "64x64")])
def test_an_output_that_cannot_be_written_is_one_line(tmp_path: Path, words: tuple[str, ...]) -> None:
    """A file where a folder has to be: the table of the set, or the folder itself."""
    (tmp_path / "file").touch()
    answer = video2anim("synth", *words, "--out", tmp_path / "file")
    assert answer.code == 3
    assert len(answer.errors) == 1
    assert "--out: cannot write" in answer.err
    assert "(file exists)" in answer.err


def test_a_motion_archive_that_cannot_be_written_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("video2anim.lab.synth.motions.act", lambda *parts: pytest.fail("procedural for nothing"))
    answer = video2anim("synth", "--motion-only", "--count", "1", "--out", tmp_path)
    assert answer.code == 3
    assert "is a directory" in answer.err


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_an_archive_does_not_replace_what_is_no_file(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "acted.npz"
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("elsewhere.npz")
    answer = video2anim("synth", "--motion-only", "--count", "1", "--out", path)
    assert (answer.code, len(answer.errors)) == (3, 1)
    assert "(a link, pipe or device)" in answer.err
    assert not path.is_file()


@pytest.mark.parametrize("mode", [("00_walk", *SMALL), ("shard_00000", "--frames-only", "--size", "64x64")])
@pytest.mark.parametrize("there", ["file", "link", "notes"])
def test_what_synth_did_not_make_is_not_replaced(tmp_path: Path, mode: tuple[str, ...], there: str) -> None:
    """A clip is made anew over an old one, but not over anything else of its name."""
    place, words = tmp_path / mode[0], mode[1:]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("years of work")
    if there == "file":
        place.write_text("years of work")
    elif there == "link":
        place.symlink_to("mine")
    else:
        (tmp_path / "mine").rename(place)
    before = folder_digest(tmp_path)
    answer = video2anim("synth", "--count", "1", *words, "--out", tmp_path)
    assert (answer.code, len(answer.errors)) == (3, 1), answer.err
    assert str(place) in answer.err
    assert "move" in answer.err
    assert folder_digest(tmp_path) == before


@pytest.mark.parametrize("name", ["write_clip", "_write_set"])
def test_a_full_disk_is_one_line_and_leaves_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Full while a clip is written, and when only the table of the set is left to write."""

    def full(*parts: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if name == "write_clip":
        monkeypatch.setattr("video2anim.lab.synth.store.write_clip", full)
    else:
        monkeypatch.setattr("video2anim.lab.synth.generate._write_set", full)
    out = tmp_path / "out"
    answer = video2anim("synth", "--count", "1", "--out", out, *SMALL)
    assert answer.code == 3
    assert answer.errors[-1] == (
        f"video2anim: --out: cannot write {out} (no space left on device); free space or choose another place, what is "
        "finished is kept"
    )
    kept = ["00_walk"] if name != "write_clip" else []
    assert [path.name for path in out.iterdir()] == kept


def test_a_killed_worker_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*parts: object) -> Iterator[None]:
        raise BrokenProcessPool
        yield

    monkeypatch.setattr("video2anim.lab.synth.generate.in_processes", broken)
    answer = video2anim("synth", "--count", "2", "--workers", "2", "--out", tmp_path / "out", *SMALL)
    assert answer.code == 5
    assert len(answer.errors) == 1
    assert "--workers: a process" in answer.err


@pytest.mark.parametrize("damage", ["", "[]", '{"key": 3}', "[" * 100_000])
def test_a_damaged_clip_is_made_again(tmp_path: Path, damage: str) -> None:
    """Whatever its `meta.json` has become; with one that is right, a missing video is enough."""
    spec, config = clip_specs("bench", 1, 0)[0], SynthConfig()
    key = clip_key(spec, config, {})
    folder = tmp_path / spec.name
    folder.mkdir()
    for name in ("truth.npz", "video.mp4"):
        (folder / name).write_bytes(b"as made")
    (folder / "meta.json").write_text(json.dumps({"key": key}))
    assert finished_clip(folder, key) is not None
    (folder / "video.mp4").unlink() if not damage else (folder / "meta.json").write_text(damage)
    assert finished_clip(folder, key) is None
    (folder / "meta.json").unlink()
    os.mkfifo(folder / "meta.json")
    assert finished_clip(folder, key) is None


def test_unreadable_meshes(tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "chair.glb").write_bytes(b"no mesh at all")
    answer = video2anim("synth", "--out", tmp_path / "out", "--count", "1", "--meshes", folder, *SMALL)
    assert answer.code == 3
    assert len(answer.errors) == 1
    assert "chair.glb" in answer.err
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_motion_that_cannot_be_used(tmp_path: Path) -> None:
    procedural = tmp_path / "acted.npz"
    assert video2anim("synth", "--motion-only", "--count", "1", "--out", procedural).code == 0
    with np.load(procedural, allow_pickle=False) as archive:
        arrays = dict(archive)
    empty = {key: value[:0] if key.startswith("clip_") and key not in ("clip_start", "clip_rot_start") else value
             for key, value in arrays.items()}  # fmt: skip
    empty |= {"clip_start": arrays["clip_start"][:1], "clip_rot_start": arrays["clip_rot_start"][:1]}
    empty |= {"root_pos": arrays["root_pos"][:0], "rot": arrays["rot"][:0]}
    np.savez(tmp_path / "empty.npz", allow_pickle=False, **empty)
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "folder").mkdir()
    for name in ("empty.npz", "text.npz", "folder"):
        answer = video2anim("synth", "--out", tmp_path / "out", "--count", "1", "--motion", tmp_path / name, *SMALL)
        assert answer.code == 3, name
        assert len(answer.errors) == 1
        assert name in answer.err
        assert not (tmp_path / "out").exists()


def test_procedural_motions_are_an_archive_of_source_synthetic(tmp_path: Path) -> None:
    path = tmp_path / "acted.npz"
    for target in (path, tmp_path / "again.npz"):
        assert video2anim("synth", "--motion-only", "--count", "7", "--seed", "5", "--out", target).code == 0
    assert path.read_bytes() == (tmp_path / "again.npz").read_bytes()
    archive = MotionArchive.read(path)
    assert set(archive.sources) == {"synthetic"}
    assert set(archive.kinds) == {"walk", "sit", "lie", "step_up", "pick_up", "lean", "reach"}
    clip = archive.clip(archive.names[0])
    assert clip.fps == 30
    write_archive(tmp_path / "copy.npz", [archive.clip(name) for name in archive.names])
    assert (tmp_path / "copy.npz").read_bytes() == path.read_bytes()


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("one", "two")]
    for out in folders:
        assert video2anim("synth", "--count", "1", "--seed", "3", "--out", out, *SMALL).code == 0
    one, two = ([folder_digest(out / "00_walk"), (out / "set.json").read_text()] for out in folders)
    assert one == two
    assert video2anim("synth", "--count", "1", "--seed", "4", "--out", tmp_path / "other", *SMALL).code == 0
    assert folder_digest(tmp_path / "other" / "00_walk") != one[0]


def test_pictures_in_shards(tmp_path: Path) -> None:
    words = ("synth", "--frames-only", "--count", "9", "--seed", "2", "--size", "96x72")
    for out in (tmp_path / "a", tmp_path / "b"):
        assert video2anim(*words, "--out", out).code == 0
    shard = tmp_path / "a" / "shard_00000"
    meta = json.loads((shard / "meta.json").read_text())
    arrays = {path.stem: np.load(path, mmap_mode="r", allow_pickle=False) for path in sorted(shard.glob("*.npy"))}
    assert arrays["rgb"].shape == (9, 72, 96, 3)
    assert arrays["rgb"].dtype == np.uint8
    for name, array in arrays.items():
        assert len(array) == meta["pictures"] == 9
        assert np.array_equal(array, np.load(tmp_path / "b" / "shard_00000" / f"{name}.npy", allow_pickle=False))
    person = meta["labels"].index("person")
    assert ((arrays["instance"] >= 1000) == (arrays["label"] == person)).all()
    assert ((arrays["label"] == person).mean((1, 2)) > 0.001).any()
    assert len(np.unique(arrays["up_camera"].round(6), axis=0)) == 9
    assert np.allclose(np.linalg.norm(arrays["up_camera"], axis=1), 1, atol=1e-5)
    seen = arrays["depth_mm"] > 0
    assert np.allclose(np.linalg.norm(arrays["normal_camera"][seen] / 127.0, axis=-1), 1, atol=0.02)
    assert seen.mean() > 0.5
    assert (arrays["label"][~seen] == 0).all()
    assert not arrays["instance"][~seen].any()


def test_a_shard_on_a_full_disk_is_an_error_not_a_crash(tmp_path: Path) -> None:
    """Files are limited to 200 kB, as a disk with so much left would; a write through a memory map would be SIGBUS."""
    limited = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)); from video2anim.cli.main import run; run()"
    )
    command, environment = command_line(
        "synth", "--frames-only", "--count", "1", "--size", "640x480", "--out", tmp_path / "out"
    )
    words = [command[0], "-c", limited, *command[3:]]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 3, done.stderr
    assert "--out: cannot write" in done.stderr
    assert not list((tmp_path / "out").iterdir())


def test_meshes_of_ones_own(tmp_path: Path) -> None:
    """A box from a file stands in the room, as a piece of furniture."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    trimesh.creation.box((0.6, 0.9, 0.4)).export(folder / "cabinet.glb")
    out = tmp_path / "out"
    answer = video2anim("synth", "--count", "2", "--out", out, "--meshes", folder, *SMALL)
    assert answer.code == 0, answer.err
    notes = [
        entry["note"]
        for meta in out.glob("*/meta.json")
        for entry in json.loads(meta.read_text())["objects"]
        if entry["is_furniture"]
    ]
    assert any("cabinet.glb" in note for note in notes), notes


@pytest.mark.skipif(not MOTION.is_dir(), reason="captured motion is not beside the checkout")
def test_captured_motion(tmp_path: Path) -> None:
    out = tmp_path / "out"
    answer = video2anim("synth", "--count", "5", "--out", out, "--motion", MOTION / "deepmimic.npz", *SMALL)
    assert answer.code == 0, answer.err
    sources = {
        person["source"] for meta in out.glob("*/meta.json") for person in json.loads(meta.read_text())["persons"]
    }
    assert any("deepmimic" in source for source in sources)
    assert not any("sie" in source for source in sources)


def test_a_key_holds_all_that_decides_a_clip() -> None:
    """A shard or clip made with other sources or another room is not taken for this one."""
    spec, base = clip_specs("random", 1, 0)[0], SynthConfig()
    others = [
        clip_key(spec, base, {"walks.npz": "0"}),
        clip_key(spec, replace(base, room_size_m=(5.0, 4.0)), {}),
        clip_key(spec, replace(base, noncommercial=True), {}),
        clip_key(spec, replace(base, longest_s=1.0), {}),
        clip_key(spec, replace(base, width_px=320), {}),
        clip_key(clip_specs("random", 1, 1)[0], base, {}),
    ]
    assert len({clip_key(spec, base, {}), *others}) == len(others) + 1
