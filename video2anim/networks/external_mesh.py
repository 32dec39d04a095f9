"""A user's own program that turns a picture of an object into a mesh: the hook for InstantMesh, Hunyuan3D and the like.

Contract: the program gets a PNG (512 x 512, the object centered and whole, gray around it) and writes a GLB with +Y up
and the side that the picture shows towards +Z, in any unit.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from jaxtyping import UInt8

from video2anim.digest import file_digest
from video2anim.errors import StageError, UsageError
from video2anim.networks.amodal import GRAY

PICTURE_PX = 512
FILL = 0.8
"""Share of the picture that the object's longer side takes."""


@contextmanager
def mesh_by_program(command: str, picture_rgb: UInt8[np.ndarray, "height width 3"], timeout_s: float) -> Iterator[Path]:
    """The mesh file that a command makes of a picture; it is gone after the block.

    Args:
        command: With the words {image} and {mesh}, which become paths.
        picture_rgb: The object, gray (127) around it.
        timeout_s: Longer is a failure.

    Raises:
        UsageError: the command lacks a word, or there is no such program.
        StageError: it failed, took too long, or left no file.
    """
    words = _words(command)
    for want in ("{image}", "{mesh}"):
        if not any(want in word for word in words):
            raise UsageError(f"reconstruct.command: want {{image}} and {{mesh}} in the command, got {command!r}")
    with tempfile.TemporaryDirectory() as folder:
        image, mesh = Path(folder, "object.png"), Path(folder, "object.glb")
        cv2.imwrite(str(image), object_square(picture_rgb)[..., ::-1])
        call = [word.replace("{image}", str(image)).replace("{mesh}", str(mesh)) for word in words]
        code, told = _called(call, timeout_s)
        if code != 0:
            raise StageError(f"{words[0]}: exit code {code}: {told}")
        if not mesh.is_file():
            raise StageError(f"{words[0]}: want a mesh written to {{mesh}}, found none")
        yield mesh


def program_digest(command: str) -> str:
    """sha256 of a command and of the files that it names (the program, its script, weights): what its meshes depend on.

    Raises:
        UsageError: the command has an open quote.
    """
    found = hashlib.sha256(command.encode(errors="surrogateescape"))
    for word in _words(command):
        for name in (word, word.partition("=")[2]):
            path = Path(shutil.which(name) or name) if name else None
            if path is not None and _is_file(path):
                found.update(bytes.fromhex(file_digest(path)))
    return found.hexdigest()


def _is_file(path: Path) -> bool:
    """Whether there is a file that can be read; words may be no paths at all."""
    try:
        return path.is_file() and os.access(path, os.R_OK)
    except (OSError, ValueError):
        return False


def _words(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError as error:
        raise UsageError(f"reconstruct.command: {str(error).lower()} in {command!r}") from error


def _called(call: list[str], timeout_s: float) -> tuple[int, str]:
    """Exit code and last line of a program, which is ended with all that it started when its time is over or the wait
    for it is broken off."""
    try:
        program = subprocess.Popen(
            call, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
        )
    except (OSError, ValueError) as error:
        raise UsageError(f"reconstruct.command: cannot run {call[0]} ({getattr(error, 'strerror', error)})") from error
    assert program.stdout is not None
    said = _Tail(program.stdout)
    try:
        code = program.wait(timeout=timeout_s)
    except BaseException as error:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.pid, signal.SIGKILL)
        program.wait()
        if isinstance(error, subprocess.TimeoutExpired):
            raise StageError(f"{call[0]}: no mesh after {timeout_s:.0f} s") from error
        raise
    return code, said.last_line()


class _Tail:
    """Reads what a program says as it says it, and keeps the end."""

    _KEPT_BYTES = 4096
    _LINGER_S = 1.0
    """Wait for the end of what was said; what the program left running may keep its output open for ever."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self._kept = stream, b""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with self._stream:
            while chunk := os.read(self._stream.fileno(), 1 << 16):
                self._kept = (self._kept + chunk)[-self._KEPT_BYTES :]

    def last_line(self) -> str:
        """The last line with something in it, up to 200 characters of it."""
        self._reader.join(self._LINGER_S)
        lines = self._kept.decode(errors="replace").strip().splitlines()
        return lines[-1][:200] if lines else "it said nothing"


def object_square(picture_rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "512 512 3"]:
    """The picture in the middle of a gray square."""
    height, width = picture_rgb.shape[:2]
    scale = FILL * PICTURE_PX / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(picture_rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    square = np.full((PICTURE_PX, PICTURE_PX, 3), GRAY, np.uint8)
    top, left = (PICTURE_PX - size[1]) // 2, (PICTURE_PX - size[0]) // 2
    square[top : top + size[1], left : left + size[0]] = small
    return square
