"""Memory goes back when pictures are freed, though small results made between them stay."""

from __future__ import annotations

import subprocess
import sys

import pytest

KEPT_MB = """
import contextlib, sys
import numpy as np
from video2anim.video.heap import pictures_apart

def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

with pictures_apart() if sys.argv[1] == "apart" else contextlib.nullcontext():
    np.ones(20_000_000, np.uint8)  # glibc's own threshold is above a picture from now on
    before = resident_mb()
    pictures, results = [], []
    for number in range(200):
        pictures.append(np.full(1_000_000, number % 250, np.uint8))
        results.append(bytes(4096))
    pictures.clear()
    print(resident_mb() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc; the C library of Linux is meant")
@pytest.mark.parametrize(("how", "min_mb", "max_mb"), [("apart", -30.0, 20.0), ("plain", 100.0, 400.0)])
def test_pictures_give_their_memory_back(how: str, min_mb: float, max_mb: float) -> None:
    """`plain` shows that there is something to mend: when it fails, the C library no longer needs the help."""
    done = subprocess.run([sys.executable, "-c", KEPT_MB, how], capture_output=True, text=True, check=True)
    assert min_mb < float(done.stdout) < max_mb
