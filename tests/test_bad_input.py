"""What goes wrong gives one line that says what to do, the documented exit code, and leaves what was there."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command import Answer, command_line, payload_digests, process, video2anim

from video2anim.artifacts.folder import file_digest
from video2anim.pipeline.scene_folder import stage_folder

USAGE, INPUT, MODEL, STAGE = 2, 3, 4, 5
SMALL = ("--set", "ingest.max_long_side_px=320", "--set", "ingest.stop_s=0.6", "--device", "cpu")
"""Settings of a quick run: 18 frames."""


def assert_one_line(answer: Answer, code: int, *parts: str) -> None:
    """One line on stderr that names all parts, the right code, no traceback."""
    assert answer.code == code, answer
    assert "Traceback" not in answer.out + answer.err
    assert len(answer.errors) == 1, answer.err
    line = answer.errors[0]
    assert line.startswith("video2anim: ")
    assert len(line) < 500
    for part in parts:
        assert part in line, f"want {part!r} in {line!r}"


@pytest.fixture(scope="session")
def lab_clip(shared_media: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A small clip with people, and its scene folder after `track`."""
    video = shared_media / "bad" / "small_portrait_216x384.mp4"
    folder = tmp_path_factory.mktemp("lab") / "scene"
    answer = video2anim("run", video, "--out", folder, *SMALL, "--until", "track")
    assert answer.code == 0, answer.err
    return video, folder


@pytest.fixture
def scene(lab_clip: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    """The same, to break."""
    shutil.copytree(lab_clip[1], tmp_path / "scene")
    return lab_clip[0], tmp_path / "scene"


# Files that are no video, or not enough of one.


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("zero_bytes", "0 bytes"),
        ("text_named", "video"),
        ("jpeg_named", "still image"),
        ("audio_only", "no video"),
        ("truncated_no_index", "video"),
        ("one_frame", "want at least 5 frames"),
        ("three_frames", "want at least 5 frames"),
    ],
)
def test_unusable_file(shared_media: Path, tmp_path: Path, name: str, said: str) -> None:
    path = shared_media / "bad" / f"{name}.mp4"
    answer = video2anim("run", path, "--out", tmp_path / "out", "--until", "ingest")
    assert_one_line(answer, INPUT, str(path))
    assert said in answer.err.lower()
    assert not list((tmp_path / "out").glob("stages/*")), "nothing half-made stays"


@pytest.mark.parametrize(
    ("name", "warning"),
    [
        ("truncated_midstream", "header claims 100 frames"),
        ("corrupted_payload", "damaged data"),
        ("variable_frame_rate", "the image before is held"),
        ("low_frame_rate_5fps", "low frame rate: 5.0 fps"),
        ("scene_cut", "2 shots found"),
        ("small_portrait_216x384", "small picture"),
        ("grayscale", ""),
    ],
)
def test_odd_file_works_and_says_what_is_odd(shared_media: Path, tmp_path: Path, name: str, warning: str) -> None:
    """What becomes of these and other files: `tests/stages/test_ingest.py`."""
    answer = video2anim("run", shared_media / "bad" / f"{name}.mp4", "--out", tmp_path, "--until", "ingest")
    assert answer.code == 0, answer.err
    assert answer.errors == []
    assert warning in answer.err
    assert warning or "warning" not in answer.err


@pytest.mark.parametrize("name", ["no_person_static_camera", "no_person_moving_camera_4x3"])
def test_nobody_found(shared_media: Path, tmp_path: Path, name: str) -> None:
    answer = video2anim("run", shared_media / "bad" / f"{name}.mp4", "--out", tmp_path, "--set", "ingest.stop_s=1.5")
    assert_one_line(answer, STAGE, "nobody found")
    assert [path.name for path in (tmp_path / "stages").iterdir()] == ["01_ingest"], "no body is made up"
    assert not (tmp_path / "motion.npz").exists()
    assert video2anim("status", tmp_path).states["ingest"] == "cached"


@pytest.mark.slow
def test_damaged_video_gives_finite_results(shared_media: Path, tmp_path: Path) -> None:
    """Half the frames are lost; what comes out has no NaN."""
    video = shared_media / "bad" / "truncated_midstream.mp4"
    answer = process("run", video, "--out", tmp_path / "out", "--set", "ingest.max_long_side_px=480", "--device", "cpu")
    assert answer.code == 0, answer.err
    assert "header claims 100 frames, 39 decode" in answer.err
    with np.load(tmp_path / "out" / "motion.npz", allow_pickle=False) as archive:
        numbers = [archive[key] for key in archive.files if archive[key].dtype.kind == "f"]
    assert len(numbers) >= 8
    assert all(np.isfinite(values).all() for values in numbers)


# Paths.


def test_missing_file(tmp_path: Path) -> None:
    answer = video2anim("run", tmp_path / "no.mp4", "--out", tmp_path / "out")
    assert_one_line(answer, INPUT, str(tmp_path / "no.mp4"), "found nothing")
    assert not (tmp_path / "out").exists()


def test_folder_as_input(tmp_path: Path) -> None:
    assert_one_line(video2anim("run", tmp_path, "--out", tmp_path / "out"), INPUT, "folder", str(tmp_path))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("target", "said"), [(None, "got a pipe"), ("/dev/zero", "got a device")])
def test_input_that_never_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str | None, said: str) -> None:
    path = tmp_path / "mine.mp4"
    os.mkfifo(path) if target is None else path.symlink_to(target)

    def opened(file: Path, *_: object) -> str:
        raise AssertionError(f"opened {file}")

    monkeypatch.setattr("video2anim.cli.compose.file_digest", opened)  # it would block, or never end
    assert_one_line(video2anim("run", path, "--out", tmp_path / "out"), INPUT, said, str(path))
    assert not (tmp_path / "out").exists()


def test_address_as_input(tmp_path: Path) -> None:
    answer = video2anim("run", "https://example.org/a.mp4", "--out", tmp_path / "out")
    assert_one_line(answer, INPUT, "got the address https://example.org/a.mp4", "download")
    assert not (tmp_path / "out").exists()


def test_playlist_as_input(tmp_path: Path) -> None:
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile other.mp4\n")
    answer = video2anim("run", tmp_path / "list.mp4", "--out", tmp_path / "out", "--until", "ingest")
    assert_one_line(answer, INPUT, "list.mp4", "'concat'", "playlist")


def test_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = tmp_path / "mine.mp4"
    video.write_bytes(b"not for you")
    video.chmod(0)
    if os.access(video, os.R_OK):  # the superuser reads everything: let the system call fail instead
        real = Path.open

        def refuse(self: Path, *args: object, **options: object) -> object:
            if self == video:
                raise PermissionError(13, "Permission denied", str(self))
            return real(self, *args, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(Path, "open", refuse)
    answer = video2anim("run", video, "--out", tmp_path / "out")
    assert_one_line(answer, INPUT, "Permission denied", str(video))


def test_output_folder_is_a_file(shared_media: Path, tmp_path: Path) -> None:
    video = shared_media / "bad" / "grayscale.mp4"
    (tmp_path / "taken").write_text("mine")
    for out in (tmp_path / "taken", tmp_path / "taken" / "deeper"):
        assert_one_line(video2anim("run", video, "--out", out), INPUT, "--out", str(out))
    assert (tmp_path / "taken").read_text() == "mine"


def test_output_folder_has_no_name_or_too_long_a_name(shared_media: Path, tmp_path: Path) -> None:
    video = shared_media / "bad" / "grayscale.mp4"
    assert_one_line(video2anim("run", video, "--out", ""), USAGE, "--out: want a value")
    assert_one_line(video2anim("run", video, "--out", tmp_path / ("x" * 300)), INPUT, "File name too long")


def test_output_folder_is_not_writable(shared_media: Path) -> None:
    """Where even the superuser may not make a folder."""
    if not Path("/proc/self").exists():
        pytest.skip("needs a system with /proc")
    answer = video2anim("run", shared_media / "bad" / "grayscale.mp4", "--out", "/proc/video2anim")
    assert_one_line(answer, INPUT, "--out", "/proc/video2anim")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        pytest.skip(f"cannot mount a small disk: {done.stderr.strip()}")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_disk_full(shared_media: Path, small_disk: Path) -> None:
    out = small_disk / "out"
    video = shared_media / "bad" / "hevc_10bit.mp4"
    (small_disk / "ballast").write_bytes(b"0" * 2**19)
    answer = video2anim("run", video, "--out", out, "--until", "track")
    assert answer.code in (INPUT, STAGE)
    assert_one_line(answer, answer.code, "space", str(out))
    assert not list((out / "stages").glob(".unfinished-*"))
    assert set(video2anim("status", out).states.values()) <= {"missing", "stale", "cached"}


@pytest.mark.parametrize("bytes_left", [0, 8 * 1024, 48 * 1024])
def test_disk_full_from_the_start(shared_media: Path, small_disk: Path, bytes_left: int) -> None:
    """Also the small files, the record and the lock, may find no room."""
    with (small_disk / "ballast").open("wb", buffering=0) as ballast:
        try:
            while True:
                ballast.write(b"0" * 4096)
        except OSError:
            ballast.truncate(max(0, ballast.tell() - bytes_left))
    answer = video2anim("run", shared_media / "bad" / "grayscale.mp4", "--out", small_disk / "out", "--until", "ingest")
    assert answer.code in (INPUT, STAGE)
    assert_one_line(answer, answer.code, "space", str(small_disk))


@pytest.mark.parametrize("error", [MemoryError(), BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")])
def test_not_enough_memory(
    shared_media: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """A limit on memory shows as whatever a library makes of it: here FFmpeg, which cannot start a thread."""

    def reformat(*_: object, **options: object) -> None:
        raise error

    monkeypatch.setattr("video2anim.video.decode.SourcePicture.rgb", reformat)
    video = shared_media / "bad" / "grayscale.mp4"
    answer = video2anim("run", video, "--out", tmp_path / "out", "--until", "ingest")
    assert_one_line(answer, STAGE, "'ingest': not enough memory", "ingest.max_long_side_px")
    assert list((tmp_path / "out" / "stages").iterdir()) == []


def test_not_enough_memory_before_the_first_stage(
    shared_media: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(*_: object) -> str:
        raise ImportError("libavcodec.so.62: failed to map segment from shared object")

    monkeypatch.setattr("video2anim.cli.compose.file_digest", load)
    answer = video2anim("run", shared_media / "bad" / "grayscale.mp4", "--out", tmp_path / "out")
    assert_one_line(answer, STAGE, "not enough memory")


KILLED_WHILE_WRITING = """
import os, signal
from video2anim.cli.main import run
from video2anim.video.encode import FrameWriter
write = FrameWriter.write
def write_or_die(self, rgb):
    if self.frame_count == 10:
        os.kill(os.getpid(), signal.SIGKILL)
    write(self, rgb)
FrameWriter.write = write_or_die
run()
"""


def test_killed_while_the_clip_is_written(shared_media: Path, tmp_path: Path) -> None:
    video = shared_media / "bad" / "small_portrait_216x384.mp4"
    words = ("run", video, "--out", tmp_path / "out", *SMALL, "--until", "ingest")
    _, environment = command_line()
    done = subprocess.run([sys.executable, "-c", KILLED_WHILE_WRITING, *map(str, words)], env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    stages = tmp_path / "out" / "stages"
    assert [path.name.startswith(".unfinished-") for path in stages.iterdir()] == [True]
    assert video2anim(*words).states == {"ingest": "ran"}
    assert [path.name for path in stages.iterdir()] == ["01_ingest"], "what the killed run left is gone"
    whole = video2anim("run", video, "--out", tmp_path / "whole", *SMALL, "--until", "ingest")
    assert whole.code == 0
    assert payload_digests(tmp_path / "out") == payload_digests(tmp_path / "whole")


def test_output_on_a_disk_that_is_read_only(shared_media: Path, small_disk: Path) -> None:
    video = shared_media / "bad" / "small_portrait_216x384.mp4"
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for out in (small_disk, small_disk / "out"):
        answer = video2anim("run", video, "--out", out, "--until", "ingest")
        assert_one_line(answer, INPUT, "--out", "Read-only file system", str(out))


# Commands and configuration.


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (("--set", "depth.sample=3"), ("unknown key 'depth.sample'",)),
        (("--set", "ingest.max_long_side=3"), ("unknown key", "did you mean 'ingest.max_long_side_px'?")),
        (("--set", "dept.samples=3"), ("unknown key 'dept'", "did you mean 'depth'?")),
        (("--set", "ingest.stop_s=soon"), ("ingest.stop_s", "'soon'")),
        (("--set", "ingest.stop_s=-1"), ("stop_s", "-1")),
        (("--set", "ingest.max_long_side_px"), ("--set", "STAGE.OPTION=VALUE")),
        (("--set", "a.b.c=1"), ("--set", "STAGE.OPTION=VALUE")),
        (("--set", "ingest.stop_s=[1"), ("--set", "ingest.stop_s=[1")),
        (("--set", "ingest=3"), ("ingest", "3")),
        (("--set", "seed=many"), ("seed", "'many'")),
        (("--preset", "fancy"), ("--preset", "embedded", "'fancy'")),
        (("--preset", "nowhere.yaml"), ("--preset", "'nowhere.yaml'")),
        (("--from", "traking"), ("'traking'", "track")),
        (("--until", "traking"), ("'traking'", "track")),
        (("--device", "tpu"), ("--device", "'tpu'")),
        (("--preset", ""), ("--preset: want a value",)),
        (("--preset=",), ("--preset: want a value",)),
    ],
)
def test_wrong_option(shared_media: Path, tmp_path: Path, words: tuple[str, ...], parts: tuple[str, ...]) -> None:
    video = shared_media / "bad" / "grayscale.mp4"
    assert_one_line(video2anim("run", video, "--out", tmp_path / "out", *words), USAGE, *parts)
    assert not list((tmp_path / "out").rglob("manifest.json"))


@pytest.mark.parametrize("text", ["- a\n- list\n", "track: {model: [\n", "track: 3\n", "tracks: {}\n"])
def test_wrong_preset_file(shared_media: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    video = shared_media / "bad" / "grayscale.mp4"
    answer = video2anim("run", video, "--out", tmp_path / "out", "--preset", tmp_path / "mine.yaml")
    assert_one_line(answer, USAGE, "mine.yaml")


@pytest.mark.parametrize(
    "words", [("run",), ("run", "a.mp4"), ("fly",), ("run", "a.mp4", "--out", "b", "--fast"), ("models", "drop")]
)
def test_wrong_command(words: tuple[str, ...]) -> None:
    answer = video2anim(*words)
    assert answer.code == USAGE
    assert "Traceback" not in answer.err


def test_unknown_person_lists_the_ids(scene: tuple[Path, Path]) -> None:
    video, folder = scene
    before = payload_digests(folder)
    answer = video2anim("run", video, "--out", folder, *SMALL, "--person", "99")
    assert_one_line(answer, USAGE, "--person 99")
    known = [
        str(p["person_id"]) for p in json.loads((stage_folder(folder, "track") / "value.json").read_text())["people"]
    ]
    assert known
    assert all(person in answer.err for person in known)
    assert payload_digests(folder) == before


def test_person_may_be_given_by_set(scene: tuple[Path, Path]) -> None:
    """YAML reads `1` as a number; an ID is a name."""
    video, folder = scene
    answer = video2anim("run", video, "--out", folder, *SMALL, "--set", "track.person=99", "--until", "track")
    assert_one_line(answer, USAGE, "--person 99")


@pytest.mark.parametrize("words", [("--focal-px", "3"), ("--height-m", "9")])
def test_impossible_camera_or_person(scene: tuple[Path, Path], words: tuple[str, str]) -> None:
    video, folder = scene
    before = payload_digests(folder)
    answer = video2anim("run", video, "--out", folder, *SMALL, *words, "--until", "camera")
    assert_one_line(answer, USAGE, words[0], words[1])
    assert payload_digests(folder) == before


@pytest.mark.parametrize("command", [("status",), ("stage", "track"), ("export", "--format", "glb"), ("view",)])
def test_not_a_scene_folder(tmp_path: Path, command: tuple[str, ...]) -> None:
    words = [command[0], tmp_path, *command[1:]]
    assert_one_line(video2anim(*words), INPUT, str(tmp_path), "video2anim run")
    assert list(tmp_path.iterdir()) == []


def test_unfinished_scene_is_not_exported_or_shown(lab_clip: tuple[Path, Path]) -> None:
    _, folder = lab_clip
    assert_one_line(video2anim("export", folder, "--format", "glb"), USAGE, "refine", "video2anim run")
    assert_one_line(video2anim("view", folder), USAGE, "refine", "video2anim run")
    assert_one_line(video2anim("stage", folder, "scene"), USAGE, "scene", "video2anim run")
    assert_one_line(video2anim("show", folder, "scene"), INPUT, "scene", "not run yet")
    assert_one_line(video2anim("show", folder, "sceen"), USAGE, "'sceen'")


def test_other_video_into_the_same_folder(scene: tuple[Path, Path], shared_media: Path) -> None:
    _, folder = scene
    other = shared_media / "bad" / "grayscale.mp4"
    before, record = payload_digests(folder), (folder / "run.json").read_text()
    answer = video2anim("run", other, "--out", folder, "--until", "ingest")
    assert_one_line(answer, USAGE, "--out", "another video", "--overwrite")
    assert payload_digests(folder) == before
    assert (folder / "run.json").read_text() == record
    replaced = video2anim("run", other, "--out", folder, "--until", "ingest", "--overwrite")
    assert replaced.code == 0, replaced.err
    assert replaced.states == {"ingest": "ran"}


# Damage in the scene folder.


@pytest.mark.parametrize("name", ["arrays.npz", "masks.npz", "value.json"])
def test_damaged_artifact(scene: tuple[Path, Path], name: str) -> None:
    video, folder = scene
    path = stage_folder(folder, "track") / name
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    answer = video2anim("run", video, "--out", folder, *SMALL, "--until", "camera")
    assert_one_line(answer, STAGE, str(path.parent), name, "video2anim stage", "track --discard-edits")
    assert (stage_folder(folder, "ingest") / "manifest.json").is_file()
    repaired = video2anim("stage", folder, "track", "--discard-edits")
    assert repaired.code == 0, repaired.err
    assert path.read_bytes() == whole, "the remedy that the message names works"


def test_missing_payload_file(scene: tuple[Path, Path]) -> None:
    video, folder = scene
    (stage_folder(folder, "ingest") / "video.mp4").unlink()
    answer = video2anim("run", video, "--out", folder, *SMALL, "--from", "track", "--until", "track")
    assert_one_line(answer, STAGE, "video.mp4", "video2anim stage", "ingest --discard-edits")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"stage": "track"}'])
def test_damaged_manifest(scene: tuple[Path, Path], text: str) -> None:
    video, folder = scene
    path = stage_folder(folder, "track") / "manifest.json"
    path.write_text(text)
    answer = video2anim("run", video, "--out", folder, *SMALL, "--until", "track")
    assert_one_line(answer, STAGE, str(path), "delete")
    shutil.rmtree(path.parent)
    assert video2anim("run", video, "--out", folder, *SMALL, "--until", "track").code == 0


@pytest.mark.parametrize("text", ["", "{", "[]", '{"preset": 3}'])
def test_damaged_record(scene: tuple[Path, Path], text: str) -> None:
    video, folder = scene
    (folder / "run.json").write_text(text)
    assert_one_line(video2anim("status", folder), STAGE, "run.json", str(folder), "delete")
    before = payload_digests(folder)
    (folder / "run.json").unlink()
    again = video2anim("run", video, "--out", folder, *SMALL, "--until", "track")
    assert again.states == {"ingest": "cached", "track": "cached"}, "the remedy works and costs nothing"
    assert payload_digests(folder) == before


def test_record_of_another_version_opens_and_names_the_option(scene: tuple[Path, Path]) -> None:
    _, folder = scene
    record = json.loads((folder / "run.json").read_text())
    record["config"]["ingest"]["of_the_future"] = 1
    (folder / "run.json").write_text(json.dumps(record))
    answer = video2anim("status", folder)
    assert answer.code == 0
    assert "ingest.of_the_future" in answer.err
    assert str(folder / "run.json") in answer.err


# Weights.


def test_wrong_digest(shared_media: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = tmp_path / "cache"
    cache.mkdir()
    for name in ("blazepose-detector", "blazepose-heavy"):
        (cache / f"{name}.tflite").write_bytes(b"other weights")
    monkeypatch.setenv("VIDEO2ANIM_CACHE", str(cache))
    video = shared_media / "bad" / "small_portrait_216x384.mp4"
    answer = video2anim("run", video, "--out", tmp_path / "out", *SMALL, "--until", "track")
    assert_one_line(answer, MODEL, "digest", str(cache), "video2anim models pull")
    assert [path.name for path in (tmp_path / "out" / "stages").iterdir()] == ["01_ingest"]
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [(row["stage"], row["state"]) for row in record["stages"]] == [("ingest", "ran")], "a failed run is recorded"
    assert record["settings"]["ingest"] == {"max_long_side_px": 320, "stop_s": 0.6}
    assert record["input_digest"] == file_digest(video)
    assert_one_line(video2anim("models", "verify"), MODEL, "blazepose", "video2anim models pull")


def test_unknown_model(shared_media: Path, tmp_path: Path) -> None:
    answer = video2anim(
        "run", shared_media / "bad" / "grayscale.mp4", "--out", tmp_path / "out", "--set", "track.model=nopose"
    )
    assert_one_line(answer, USAGE, "'nopose'", "blazepose-heavy")
    assert_one_line(video2anim("models", "pull", "nopose"), USAGE, "'nopose'")


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    """The option works where people type it: at the end too."""
    for words in (
        ("--debug", "run", tmp_path / "no.mp4", "--out", tmp_path / "out"),
        ("run", tmp_path / "no.mp4", "--out", tmp_path / "out", "--debug"),
    ):
        answer = process(*words)
        assert answer.code != 0
        assert "Traceback" in answer.err
        assert "InputError" in answer.err
