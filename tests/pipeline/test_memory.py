"""Peak memory is that of the work since the reset, or it is not told."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from video2anim.artifacts.manifest import Manifest
from video2anim.cli import show
from video2anim.pipeline import memory
from video2anim.pipeline.runner import StageStatus

STATUS = "Name:\tpython\nVmPeak:\t  900000 kB\nVmHWM:\t  500000 kB\nVmRSS:\t  100000 kB\n"


@pytest.fixture
def proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "status").write_text(STATUS)
    monkeypatch.setattr(memory, "_PROC", tmp_path)
    return tmp_path


def test_the_peak_is_read_and_reset(proc: Path) -> None:
    (proc / "status").write_text(STATUS.replace("100000", "499000"))
    assert memory.peak_mb() == pytest.approx(512.0)
    assert (proc / "clear_refs").read_text() == "5"


def test_a_kernel_that_takes_the_request_and_keeps_the_peak(proc: Path) -> None:
    assert not memory.reset_peak()
    assert memory.peak_mb() is None
    assert (proc / "clear_refs").read_text() == "5"


def test_a_peak_that_cannot_be_reset_is_not_told(proc: Path) -> None:
    """It would be that of everything the process did before."""
    (proc / "clear_refs").mkdir()
    assert not memory.reset_peak()
    assert memory.peak_mb() is None


def test_a_system_without_proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_PROC", tmp_path / "absent")
    assert memory.peak_mb() is None


FRESH = """
import mmap
from video2anim.pipeline import memory
if memory.reset_peak():
    with mmap.mmap(-1, 100_000_000) as block:
        for page in range(0, len(block), mmap.PAGESIZE):
            block[page] = 1
        large = memory.peak_mb()
    memory.reset_peak()
    print(large, memory.peak_mb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux resets a process's peak")
def test_what_was_before_the_reset_does_not_count() -> None:
    """In a process of its own: memory that others have freed would be taken again and add nothing."""
    said = subprocess.run([sys.executable, "-c", FRESH], capture_output=True, text=True, check=True).stdout.split()
    if not said:
        pytest.skip("this kernel does not let a process reset its peak")
    large_mb, small_mb = map(float, said)
    assert large_mb > 100
    assert small_mb < large_mb - 80


def test_the_table_of_stages_does_not_make_one_up(capsys: pytest.CaptureFixture[str]) -> None:
    manifest = Manifest("ingest", 1, "k" * 64, {}, {}, {}, 0, "d" * 64, 2.5, None, [], [], {})
    show.stage_table([StageStatus("ingest", "ran", manifest)])
    assert "n/a" in capsys.readouterr().out
