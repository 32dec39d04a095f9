"""A short synthetic clip for the preview and the stage, and where the Makefile puts Blender."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from video2anim.types import PayloadFile, SourceInfo, VideoClip
from video2anim.video import FrameWriter

_BLENDER = Path(sys.prefix, "blender", "bin", "python")
if _BLENDER.is_file():
    os.environ.setdefault("VIDEO2ANIM_BLENDER", str(_BLENDER))

FRAMES = 8
GRAY = 128


@pytest.fixture(scope="session")
def gray_clip(tmp_path_factory: pytest.TempPathFactory) -> VideoClip:
    """Eight plain gray frames of 640 x 360."""
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    with FrameWriter(path, width_px=640, height_px=360) as writer:
        for _ in range(FRAMES):
            writer.write(np.full((360, 640, 3), GRAY, np.uint8))
    time_s = np.arange(FRAMES) / 30.0
    source = SourceInfo("h264", "yuv420p", 640, 360, 0, 1.0, 30.0, FRAMES, FRAMES, FRAMES / 30, 0.0)
    return VideoClip(PayloadFile(path), 640, 360, 30.0, time_s, time_s, source, ((0.0, FRAMES / 30),), 0, ())
