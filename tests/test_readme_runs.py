"""README's commands, run as they are written, on a cut of a real clip."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

import av
import cv2
import pytest
from command import command_line
from test_readme import commands_told

pytestmark = pytest.mark.slow

START_S, FRAMES = 4.6, 40
CRF = "18"


@pytest.fixture(scope="module")
def folder(demo_video: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `input.mp4`, in which a man lands from a flip, at half the size, and `photo.jpg`."""
    made = tmp_path_factory.mktemp("readme")
    with (
        av.open(str(demo_video)) as source,
        av.open(str(made / "input.mp4"), "w") as target,
    ):
        stream = source.streams.video[0]
        out = target.add_stream("libx264", rate=stream.average_rate, options={"crf": CRF})
        out.width, out.height = stream.width // 4 * 2, stream.height // 4 * 2
        pictures = (frame for frame in source.decode(stream) if frame.time is not None and frame.time >= START_S)
        for number in range(FRAMES):
            rgb = next(pictures).to_ndarray(format="rgb24", width=out.width, height=out.height)
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            target.mux(out.encode(frame))
            if number == 0:
                cv2.imwrite(str(made / "photo.jpg"), rgb[..., ::-1])
        target.mux(out.encode())
    return made


@pytest.mark.parametrize("line", commands_told())
def test_command_runs_as_written(folder: Path, line: str) -> None:
    """In README's order: each goes on with what the ones before left."""
    words = shlex.split(line, comments=True)
    command, environment = command_line(*words[1:])
    environment = {name: value for name, value in environment.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, timeout=400, check=False
    )
    if words[1] == "view":
        assert done.returncode == 2
        assert "want a display for the window" in done.stderr or "open3d could not be imported" in done.stderr
    elif "fbx" in words and done.returncode == 2:
        assert "want Blender, found none" in done.stderr
        assert "blender" in done.stderr.lower()
    else:
        assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
