"""`training/prior.py` in a cache of its own: what it says where there is no run, and that there is never a second."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "training" / "prior.py"


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """Where the script keeps its state in these tests."""
    folder = tmp_path / "cache" / "training"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def stranger() -> Iterator[subprocess.Popen[bytes]]:
    """A process that has nothing to do with training."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(120)"])
    yield process
    process.kill()
    process.wait()


def script(cache: Path, *words: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "VIDEO2ANIM_CACHE": str(cache.parent), "XDG_CACHE_HOME": str(cache.parent.parent / "xdg")}
    return subprocess.run(
        [sys.executable, str(SCRIPT), *words], capture_output=True, text=True, timeout=120, check=False,
        env=env | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def test_progress_without_a_run(cache: Path) -> None:
    done = script(cache, "progress")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["prior: not begun", "lifter: not begun"]


def test_progress_tells_last_and_best_numbers_of_each_network(cache: Path) -> None:
    rows = [
        {"interval": 30, "scene": False, "mjpe_ratio": 0.8125, "jerk_ratio": 1.0, "inside": float("nan")},
        {"interval": 60, "scene": True, "mjpe_ratio": 0.75, "jerk_ratio": 1.0, "inside": 0.125},
    ]
    told = {"step": 5, "windows": 320, "hours": 1.5, "date": "2026-11-24", "validation": rows, "best": {}}
    (cache / "prior").mkdir()
    (cache / "prior" / "progress.json").write_text(json.dumps(told))
    done = script(cache, "progress")
    first, second = done.stdout.splitlines()
    assert "320 windows" in first
    assert "1.50 h" in first
    assert "r30 0.812" in first
    assert "r60s 0.750/0.125" in first
    assert second == "lifter: not begun"
    (cache / "prior" / "progress.json").write_text('{"step": 5')
    assert script(cache, "progress").stdout.splitlines()[0] == "prior: not begun"


def test_stop_without_a_run_says_so(cache: Path) -> None:
    done = script(cache, "stop")
    assert done.returncode == 1
    assert done.stderr.strip() == "training/prior.py: no run is under way"


def test_stop_ends_no_stranger_that_has_the_number_of_an_ended_run(
    cache: Path, stranger: subprocess.Popen[bytes]
) -> None:
    """A run that has ended leaves its number behind, and numbers of processes are used again."""
    (cache / "lock").touch()
    (cache / "pid").write_text(str(stranger.pid))
    done = script(cache, "stop")
    assert stranger.poll() is None
    assert done.returncode == 1
    assert "no run is under way" in done.stderr


def test_stop_ends_the_run(cache: Path) -> None:
    """A run is a process that holds the lock."""
    code = (
        "import fcntl, os, sys, time; from pathlib import Path; folder = Path(sys.argv[1]); "
        "lock = (folder / 'lock').open('a'); fcntl.flock(lock, fcntl.LOCK_EX); "
        "(folder / 'pid').write_text(str(os.getpid())); print('up', flush=True); time.sleep(120)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(cache)], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            assert script(cache, "stop").returncode == 0
            assert process.wait(30) == -signal.SIGTERM
        finally:
            process.kill()


def test_a_second_run_is_refused_and_leaves_the_first_as_it_is(cache: Path, tmp_path: Path) -> None:
    (cache / "pid").write_text("12345")
    with (cache / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        done = script(cache, "run", "--motion", str(tmp_path), "--minutes", "0.1")
    assert done.returncode == 1
    assert "a run is under way already" in done.stderr
    assert "Traceback" not in done.stderr
    assert (cache / "pid").read_text() == "12345"
    assert not (cache / "acted.npz").exists()


def test_weights_are_not_written_beside_a_run(cache: Path, tmp_path: Path) -> None:
    """`weights` trains a moment on the run's own checkpoint: two at once would write the same file."""
    with (cache / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        words = ("--motion", str(tmp_path), "--out", str(tmp_path / "w.safetensors"))
        done = script(cache, "weights", *words)
    assert done.returncode != 0
    assert "a run is under way" in done.stderr


def test_a_run_that_fails_says_where_to_look(cache: Path, tmp_path: Path) -> None:
    """No motion in the folder: the first turn of the prior ends, and the run with it."""
    (cache / "acted.npz").touch()
    done = script(cache, "run", "--motion", str(tmp_path), "--minutes", "1")
    assert done.returncode == 1
    assert str(cache / "log.txt") in done.stderr
    assert "Traceback" not in done.stderr
    assert (cache / "log.txt").read_text()
