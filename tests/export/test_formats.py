"""Where exported files go, and what is left of them when it goes wrong."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command import Answer, video2anim
from walk_scene import room, walk

from video2anim.cli import results
from video2anim.errors import InputError, UsageError
from video2anim.export import FORMATS, ExportScene, write_format
from video2anim.export.fbx import blender_command
from video2anim.export.formats import MissingLibraryError
from video2anim.pipeline.runner import StageStatus
from video2anim.pipeline.scene_folder import locked
from video2anim.types import RefinedMotion

SINGLE = [name for name, one in FORMATS.items() if one.suffixes and name != "fbx"]
"""Formats whose main file is one file, and that need no other program."""


def content(frames: int = 6) -> ExportScene:
    return ExportScene((walk(frames), walk(frames, 7, side_m=-1.0)), room())


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"cannot mount a small disk: {done.stderr.strip()}")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.mark.parametrize("bytes_left", [8 * 1024, 128 * 1024])
@pytest.mark.parametrize("name", FORMATS)
def test_a_full_disk_leaves_the_good_file(
    small_disk: Path, capfd: pytest.CaptureFixture[str], name: str, bytes_left: int
) -> None:
    if name == "fbx" and blender_command() is None:
        pytest.skip("no Blender")
    good = small_disk / ("fbx_ready/person_1.glb" if name == "fbx-ready" else FORMATS[name].main)
    good.parent.mkdir(exist_ok=True)
    good.write_bytes(b"good")
    (small_disk / "ballast").write_bytes(b"0" * (2**20 - bytes_left - 2 * 4096))
    with pytest.raises(InputError, match=r"^--out: cannot write .*No space left on device.*; free space [^\n]*$"):
        write_format(name, content(300), small_disk)
    assert good.read_bytes() == b"good"
    assert names(small_disk) == {"ballast", good.relative_to(small_disk).as_posix()}
    assert capfd.readouterr() == ("", ""), "libraries say nothing of their own"


def test_files_appear_only_once_all_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second person's file fails: the first one's is not replaced either."""
    from video2anim.export import bvh

    real, calls = bvh.write_bvh, []

    def fails_at_the_second(path: Path, character: Any) -> None:
        calls.append(path)
        if len(calls) == 2:
            raise OSError(5, "Input/output error")
        real(path, character)

    (tmp_path / "motion.bvh").write_text("before")
    monkeypatch.setattr(bvh, "write_bvh", fails_at_the_second)
    with pytest.raises(InputError, match="Input/output error"):
        write_format("bvh", content(), tmp_path)
    assert len(calls) == 2
    assert names(tmp_path) == {"motion.bvh"}
    assert (tmp_path / "motion.bvh").read_text() == "before"


def test_what_a_killed_export_left_is_swept_by_the_next_run(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path; sys.path.insert(0, sys.argv[2])\n"
        "import video2anim.export.bvh as bvh\n"
        "from walk_scene import walk; from video2anim.export import ExportScene, write_format\n"
        "bvh.write_bvh = lambda path, character: os._exit(9)\n"
        "write_format('bvh', ExportScene((walk(4),), None), Path(sys.argv[1]))\n"
    )
    tests = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path), str(tests)], check=False)
    assert done.returncode == 9
    assert len(list(tmp_path.iterdir())) == 1
    with locked(tmp_path):
        assert {path.name for path in tmp_path.iterdir()} == {".lock"}


@pytest.mark.parametrize("name", SINGLE)
def test_a_named_file_is_that_file(tmp_path: Path, name: str) -> None:
    out = tmp_path / "new" / f"my{FORMATS[name].suffixes[0]}"
    written = write_format(name, content(), out)
    assert written[0] == out
    assert names(tmp_path / "new") == {path.name for path in written}
    assert len(written) == {"glb": 1, "usd": 1, "bvh": 2, "amass": 4}[name]
    assert all(path.name.startswith("my") for path in written)
    in_folder = write_format(name, content(), tmp_path / "folder")
    assert in_folder[0].read_bytes() == out.read_bytes(), "the same motion is the same bytes"


def test_usd_may_be_text(tmp_path: Path) -> None:
    (out,) = write_format("usd", content(), tmp_path / "my.usda")
    assert out.read_bytes().startswith(b"#usda 1.0")


class FinishedFolder:
    """What `export` asks of the runner of a finished scene folder."""

    def status(self) -> list[StageStatus]:
        return [StageStatus("refine", "cached", None)]

    def value(self, kind: type) -> Any:
        made = content()
        assert kind is RefinedMotion
        assert made.scene is not None
        return RefinedMotion(made.people, ("scenemi",) * 2, (1.0,) * 2, made.people, made.scene)


@pytest.fixture
def finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    made = SimpleNamespace(results={"motion.npz": "", "motion.bvh": ""})
    monkeypatch.setattr(results, "open_scene", lambda scene_dir: (FinishedFolder(), made))
    (tmp_path / "scene" / "stages" / "04_humans").mkdir(parents=True)
    return tmp_path / "scene"


def export(folder: Path, format_name: str, out: Path | str) -> Answer:
    return video2anim("export", folder, "--format", format_name, "--out", out)


def expect_one_line(answer: Answer, code: int, *parts: str) -> None:
    assert answer.code == code, answer.err
    (line,) = answer.errors
    for part in parts:
        assert part in line


def test_the_command_writes_the_named_file(finished: Path, tmp_path: Path) -> None:
    answer = export(finished, "bvh", tmp_path / "mine.bvh")
    assert answer.code == 0, answer.err
    assert answer.out.splitlines() == [str(tmp_path / "mine.bvh"), str(tmp_path / "mine_7.bvh")]
    assert (tmp_path / "mine.bvh").read_text().startswith("HIERARCHY")


def test_out_that_is_no_place_is_told_in_one_line(finished: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine")
    expect_one_line(export(finished, "bvh", tmp_path / "taken"), 2, "--out", "a file that ends in .bvh", "taken")
    expect_one_line(export(finished, "bvh", tmp_path / "my.glb"), 2, "--out", "a file that ends in .bvh", "my.glb")
    expect_one_line(export(finished, "fbx-ready", tmp_path / "taken"), 2, "--out", "want a folder, got the file")
    expect_one_line(export(finished, "bvh", tmp_path / "taken" / "deeper"), 3, "--out", "taken")
    expect_one_line(export(finished, "usd", tmp_path / "taken" / "my.usdc"), 3, "--out", "taken")
    if Path("/proc/self").exists():  # where even the superuser may not make a folder
        expect_one_line(export(finished, "glb", "/proc/video2anim"), 3, "--out", "/proc/video2anim")
    assert (tmp_path / "taken").read_text() == "mine"


def test_what_the_run_made_is_not_written_over(finished: Path, tmp_path: Path) -> None:
    taken = (
        finished / "motion.npz",
        finished / "stages" / "04_humans" / "motion.npz",
        finished / "stages" / "04_humans",
    )
    (tmp_path / "link").symlink_to(finished)
    for out in (*taken, tmp_path / "link" / "motion.npz"):
        expect_one_line(export(finished, "amass", out), 2, str(out), "belongs to the run")
    answer = video2anim("view", finished, "--screenshot", finished / "stages" / "04_humans" / "0.png")
    expect_one_line(answer, 2, "0.png", "belongs to the run")
    assert export(finished, "bvh", finished / "motion.bvh").code == 0, "the format's own place"


def test_without_blender_the_exact_command_is_told(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("VIDEO2ANIM_BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "bpy", None)
    answer = export(finished, "fbx", tmp_path / "out dir")
    ready = tmp_path / "out dir" / "fbx_ready"
    command = (
        f"blender --background --python '{ready}/blender_to_fbx.py' -- '{ready}/person_7.glb' "
        f"'{tmp_path}/out dir/motion_7.fbx'"
    )
    expect_one_line(answer, 2, command, "VIDEO2ANIM_BLENDER")
    assert names(ready) == {"person_1.glb", "person_7.glb", "blender_to_fbx.py"}


def test_a_named_blender_must_be_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("VIDEO2ANIM_BLENDER", str(tmp_path / "none"))
    with pytest.raises(UsageError, match="VIDEO2ANIM_BLENDER: want a Blender"):
        write_format("fbx", content(), tmp_path)


def test_the_missing_library_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(MissingLibraryError, match="pip install usd-core"):
        write_format("usd", content(), tmp_path)
    assert names(tmp_path) == set()
