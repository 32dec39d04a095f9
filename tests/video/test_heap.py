"""Memory goes back when pictures are freed, though small results made between them stay."""

from __future__ import annotations

import subprocess
import sys

import pytest

KEPT_MB = """
import numpy as np
from video2anim.video.heap import frames_in_mapped_memory

def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

with frames_in_mapped_memory():
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
def test_pictures_give_their_memory_back() -> None:
    """Without it 200 MB stay, or nothing, as the C library's heap happens to lie."""
    done = subprocess.run([sys.executable, "-c", KEPT_MB], capture_output=True, text=True, check=True)
    assert -30.0 < float(done.stdout) < 20.0
