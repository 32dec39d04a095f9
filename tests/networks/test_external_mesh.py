"""A user's own program that makes a mesh of a picture: what it gets, how it may fail, and who may start it."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import video2anim

from stages.reconstruct import ReconstructConfig
from video2anim.cli.compose import rerun_stage
from video2anim.errors import StageError, UsageError
from video2anim.networks.external_mesh import mesh_by_program, object_square, program_digest
from video2anim.pipeline.config import result_config
from video2anim.pipeline.scene_folder import RunRecord, write_record

GRAY, BLUE = (127, 127, 127), (20, 40, 220)


def command_of(tmp_path: Path, code: str, *words: str) -> str:
    """A program of some lines of Python, whose first word is the picture and whose second is the mesh."""
    program = tmp_path / "a program.py"
    program.write_text(f"import shutil, sys, time\nimage, mesh = sys.argv[1:3]\n{code}\n")
    return shlex.join([sys.executable, str(program), "{image}", "{mesh}", *words])


def picture(height: int = 30, width: int = 60) -> np.ndarray:
    """A blue object with gray around it."""
    rgb = np.full((height, width, 3), GRAY, np.uint8)
    rgb[2:-2, 2:-2] = BLUE
    return rgb


def made(command: str, timeout_s: float = 60.0) -> bytes:
    with mesh_by_program(command, picture(), timeout_s) as path:
        return path.read_bytes()


def failure(command: str, kind: type[Exception], timeout_s: float = 60.0) -> str:
    with pytest.raises(kind) as caught:
        made(command, timeout_s)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_mesh_is_there_until_the_block_ends(tmp_path: Path) -> None:
    command = command_of(tmp_path, "open(mesh, 'w').write('a mesh')")
    with mesh_by_program(command, picture(), 60.0) as path:
        assert path.read_text() == "a mesh"
        assert path.suffix == ".glb"
    assert not path.exists()
    assert not path.parent.exists()


def test_the_program_gets_the_picture_and_its_other_words(tmp_path: Path) -> None:
    """Words may hold a path, and spaces; a picture of 512 x 512 comes with colors in the usual order."""
    code = "shutil.copy(image, sys.argv[3]); open(mesh, 'w').write('|'.join(sys.argv[4:]).replace(mesh, 'MESH'))"
    command = command_of(tmp_path, code, str(tmp_path / "seen.png"), "two words", "--out={mesh}")
    assert made(command) == b"two words|--out=MESH"
    seen = cv2.imread(str(tmp_path / "seen.png"))
    assert seen is not None
    assert seen.shape == (512, 512, 3)
    np.testing.assert_array_equal(seen[256, 256, ::-1], BLUE)
    np.testing.assert_array_equal(seen[:, :, ::-1], object_square(picture()))


@pytest.mark.parametrize(("height", "width"), [(30, 60), (60, 30), (700, 1400), (40, 40), (3, 600)])
def test_the_object_is_whole_in_the_middle_of_a_gray_square(height: int, width: int) -> None:
    """Its longer side takes four fifths, its sides keep their ratio."""
    square = object_square(np.full((height, width, 3), BLUE, np.uint8))
    assert (square.shape, square.dtype) == ((512, 512, 3), np.uint8)
    rows, columns = np.nonzero((square != GRAY).any(-1))
    size = np.array([np.ptp(rows) + 1, np.ptp(columns) + 1])
    np.testing.assert_allclose(size, 0.8 * 512 * np.array([height, width]) / max(height, width), atol=1)
    assert abs(rows.min() + rows.max() - 511) <= 1
    assert abs(columns.min() + columns.max() - 511) <= 1
    assert (square[rows, columns] == BLUE).all()


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("print('loading'); print('no luck', file=sys.stderr); print('', file=sys.stderr); sys.exit(3)", "no luck"),
        ("print('loading'); print('out of memory'); sys.exit(3)", "out of memory"),
        ("sys.exit(3)", "it said nothing"),
    ],
)
def test_a_program_that_fails_is_quoted(tmp_path: Path, code: str, told: str) -> None:
    """The exit code and its last line, of its errors before what else it said; a mesh it left does not count."""
    message = failure(command_of(tmp_path, f"open(mesh, 'w').write('half'); {code}"), StageError)
    assert message == f"{sys.executable}: exit code 3: {told}"


def test_a_crash_is_told_in_one_line(tmp_path: Path) -> None:
    assert failure(command_of(tmp_path, "raise ValueError('bad picture')"), StageError).endswith(
        "exit code 1: ValueError: bad picture"
    )


def test_a_program_that_writes_nothing_has_failed(tmp_path: Path) -> None:
    for code in ("pass", "open(mesh + '.part', 'w').write('x')"):
        assert "want a mesh written to {mesh}, found none" in failure(command_of(tmp_path, code), StageError)


def test_a_program_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    command = command_of(tmp_path, "time.sleep(30); open(mesh, 'w').write('late')")
    assert "no mesh after 1 s" in failure(command, StageError, timeout_s=1.0)


def test_a_missing_program_is_named(tmp_path: Path) -> None:
    for program in ("no-such-program-here", str(tmp_path / "none.sh")):
        message = failure(f"{shlex.quote(program)} {{image}} {{mesh}}", UsageError)
        assert "reconstruct.command" in message
        assert program in message


@pytest.mark.parametrize("words", ["", "{image}", "{mesh}", "image mesh"])
def test_a_command_without_its_words_is_not_run(tmp_path: Path, words: str) -> None:
    ran = tmp_path / "ran"
    command = f"touch {shlex.quote(str(ran))} {words}"
    message = failure(command, UsageError)
    assert "want {image} and {mesh}" in message
    assert not ran.exists()


@pytest.mark.parametrize("case", ["not executable", "no first line", "open quote", "not utf-8"])
def test_other_failures_are_the_documented_errors(tmp_path: Path, case: str) -> None:
    """A script without the x bit, one without `#!`, a command with one quote, and a program that prints Latin-1."""
    script = tmp_path / "make.sh"
    script.write_text("#!/bin/sh\n" if case == "not executable" else "echo x > $2\n")
    script.chmod(0o755 if case == "no first line" else 0o644)
    command = f"{script} {{image}} {{mesh}}"
    if case == "open quote":
        command = f"'{command}"
    elif case == "not utf-8":
        command = command_of(tmp_path, "sys.stderr.buffer.write(b'caf\\xe9'); sys.exit(1)")
    with pytest.raises((StageError, UsageError)):
        made(command)


def wait_for(what: Callable[[], object]) -> None:
    """Returns once it is so; a test that waits in vain fails."""
    until = time.monotonic() + 60
    while not what():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    """Not ended, and no zombie that only waits to be reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="looks for processes in /proc")
def test_an_interrupt_ends_the_program_and_what_it_started(tmp_path: Path) -> None:
    """Ctrl-C reaches this process alone: the program has a session of its own."""
    pids = tmp_path / "pids"
    child = "import subprocess, os\nchild = subprocess.Popen(['sleep', '600'])\n"
    code = f"{child}open({str(pids)!r} + '.part', 'w').write(f'{{os.getpid()}} {{child.pid}}')\n"
    code += f"os.rename({str(pids)!r} + '.part', {str(pids)!r})\ntime.sleep(600)"

    def interrupt() -> None:
        wait_for(pids.exists)
        signal.raise_signal(signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    # A process that was started in the background of a script ignores Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            made(command_of(tmp_path, code), timeout_s=600.0)
    finally:
        signal.signal(signal.SIGINT, before)
    thread.join()
    for pid in map(int, pids.read_text().split()):
        wait_for(lambda pid=pid: not is_running(pid))


def test_what_a_program_left_running_is_not_waited_for(tmp_path: Path) -> None:
    """A server that it started for its next call keeps the output open; the mesh is there already."""
    pid = tmp_path / "pid"
    code = f"import subprocess\nopen({str(pid)!r}, 'w').write(str(subprocess.Popen(['sleep', '600']).pid))"
    try:
        assert made(command_of(tmp_path, f"{code}\nopen(mesh, 'w').write('a mesh')"), timeout_s=300.0) == b"a mesh"
    finally:
        os.kill(int(pid.read_text()), signal.SIGKILL)


def test_of_a_flood_of_output_the_end_is_kept(tmp_path: Path) -> None:
    """64 MB of progress, without a line's end; this process may grow by a fraction of that."""
    resource = pytest.importorskip("resource")
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    code = "for _ in range(1024): sys.stdout.write('x' * 65536)\nprint('\\nno luck'); sys.exit(3)"
    assert failure(command_of(tmp_path, code), StageError) == f"{sys.executable}: exit code 3: no luck"
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb
    assert grown * (1 if sys.platform == "darwin" else 1024) < 32e6


def test_what_a_program_says_does_not_steer_the_terminal(tmp_path: Path) -> None:
    """Colors, a new title of the window, and a line that writes over itself."""
    code = r"print('\x1b]0;title\x07\x1b[31mred\x1b[0m \x9b2J caf\u00e9'); sys.exit(1)"
    message = failure(command_of(tmp_path, code), StageError)
    assert message.isprintable()
    assert r"\x1b]0;title\x07\x1b[31mred\x1b[0m \x9b2J caf" in message
    assert message.endswith("é")


def test_the_program_itself_counts_for_the_cache(tmp_path: Path) -> None:
    """A mended program is another one; a folder that only moved on in time is not."""
    command = command_of(tmp_path, "sys.exit(1)", f"--weights={tmp_path / 'weights.bin'}", "--steps=9")
    before = result_config(ReconstructConfig(command=command))
    assert command in before["command"]
    assert result_config(ReconstructConfig(command=command)) == before
    os.utime(tmp_path / "a program.py", (1, 1))
    assert result_config(ReconstructConfig(command=command)) == before
    (tmp_path / "weights.bin").write_bytes(b"weights")
    weighed = result_config(ReconstructConfig(command=command))
    assert weighed != before
    command_of(tmp_path, "open(mesh, 'w').write('a mesh')")
    assert result_config(ReconstructConfig(command=command)) not in (before, weighed)
    assert result_config(ReconstructConfig())["command"] == ""


@pytest.mark.parametrize("words", ["no-such-program-here", "/dev/null /dev/zero /", "a\0b", "x" * 5000, "=", "''"])
def test_words_that_are_no_files_count_as_text(words: str) -> None:
    assert program_digest(f"{words} {{image}} {{mesh}}") == program_digest(f"{words} {{image}} {{mesh}}")
    assert program_digest(f"{words} {{image}} {{mesh}}") != program_digest(f"{words} {{image}} {{mesh}} more")


def scene_folder(tmp_path: Path, config: dict) -> Path:
    """A scene folder of somebody else, with nothing but its run record."""
    folder = tmp_path / "scene"
    folder.mkdir()
    write_record(folder, RunRecord("v.mp4", "d", "embedded", 0, config, {}))
    return folder


def test_a_folder_does_not_choose_the_program_that_is_run(tmp_path: Path) -> None:
    """`video2anim stage reconstruct` takes the folder's configuration, but for its program."""
    command = f"touch {tmp_path / 'ran'} {{image}} {{mesh}}"
    folder = scene_folder(tmp_path, {"reconstruct": {"command": command}})
    before = (folder / "run.json").read_bytes()
    with pytest.raises(UsageError, match="runs a program") as caught:
        rerun_stage(folder, "reconstruct", device="cpu", on_event=lambda event: None)
    assert "\n" not in str(caught.value)
    for word in (command, "--from reconstruct", "--set reconstruct.command="):
        assert word in str(caught.value)
    answer = video2anim("stage", folder, "reconstruct")
    assert answer.code == 2
    assert "runs a program" in answer.err
    assert not (tmp_path / "ran").exists()
    assert (folder / "run.json").read_bytes() == before
    assert [path.name for path in folder.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    ("config", "stage"),
    [
        ({}, "reconstruct"),
        ({"reconstruct": {"command": ""}}, "reconstruct"),
        ({"reconstruct": {"command": "touch {image} {mesh}"}}, "place"),
    ],
)
def test_without_a_program_in_that_stage_it_is_run(tmp_path: Path, config: dict, stage: str) -> None:
    """Here it stops only at what comes before, which was never made."""
    with pytest.raises(UsageError, match="earlier stage 'ingest' is missing"):
        rerun_stage(scene_folder(tmp_path, config), stage, device="cpu", on_event=lambda event: None)
