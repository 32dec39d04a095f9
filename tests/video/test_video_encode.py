"""Writing of video files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ENCODE = """
import sys
from pathlib import Path
import numpy as np
from video2anim.video.encode import FrameWriter

rng = np.random.default_rng(0)
ground = rng.integers(60, 200, (12, 59, 3)).astype(np.uint8).repeat(15, 0).repeat(15, 1)[:180, :880]
with FrameWriter(Path(sys.argv[1]), width_px=880, height_px=180, crf=20) as writer:
    for step in range(40):
        frame = ground.copy()
        frame[40:140, 100 + 12 * step : 160 + 12 * step] = (200, 160, 40)
        noise = rng.integers(-4, 5, frame.shape)
        writer.write(np.clip(frame + noise, 0, 255).astype(np.uint8))
"""
"""A moving block over a noisy still ground."""


def test_bytes_do_not_depend_on_what_was_in_memory(tmp_path: Path) -> None:
    files = []
    # glibc fills memory that is handed out or given back with this byte; elsewhere the variable means nothing.
    for fill in ("0", "1", "254"):
        files.append(tmp_path / f"{fill}.mp4")
        environment = os.environ | {"MALLOC_PERTURB_": fill}
        subprocess.run([sys.executable, "-c", ENCODE, str(files[-1])], env=environment, check=True)
    assert len({file.read_bytes() for file in files}) == 1
