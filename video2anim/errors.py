"""Errors a user can act on. Each carries the exit code that the command line documents.

A message says what was wanted, what came, where, and what to do, in one line.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

_OUTPUT_LOST = (errno.ENOSPC, errno.EPIPE, errno.EBADF, errno.EIO)
"""Writing to the standard output fails so: a full disk, or a pipe that nobody reads."""
_SHORTAGE_TEXTS = ("Insufficient memory", "can't allocate memory", "failed to map segment")
"""How OpenCV, PyTorch and the loader of libraries say it; they have no error class of their own for it."""


MAX_BYTES = 4 * 2**30
"""Of one file, and of all arrays in one archive once unpacked: twelve hours of one person's motion."""
MESSAGE_LETTERS = 200
"""Of what an error quotes: two lines of a terminal (not measured)."""


def printable(text: str) -> str:
    """The text with its control characters written out: what a file or a program says cannot steer the terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


class Video2AnimError(Exception):
    """Root of all expected failures. Its text is fit for a terminal, whatever it quotes."""

    exit_code = 5

    def __str__(self) -> str:
        return printable(super().__str__())


class UsageError(Video2AnimError):
    """A command, option or configuration value is wrong (exit code 2)."""

    exit_code = 2


class InputError(Video2AnimError):
    """The input file or the output folder cannot be used (exit code 3)."""

    exit_code = 3


class ModelMissingError(Video2AnimError):
    """Weights are absent, unreachable or fail their digest (exit code 4)."""

    exit_code = 4


class StageError(Video2AnimError):
    """A stage could not do its work on this input (exit code 5)."""


class ArtifactError(Video2AnimError):
    """A stage folder is unreadable or incomplete (exit code 5)."""


def is_memory_shortage(error: BaseException) -> bool:
    """Whether an error of any library says that the system gave no memory, or no room for another thread."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError):
        return error.errno in (errno.ENOMEM, errno.EAGAIN)
    text = str(error)
    return any(sign in text for sign in _SHORTAGE_TEXTS)


def last_words(error: Exception) -> tuple[str, int] | None:
    """The line and the exit code with which a command ends; None where the error is a fault of the program."""
    if isinstance(error, Video2AnimError):
        return " ".join(str(error).split()), error.exit_code
    if is_memory_shortage(error):
        return "not enough memory; close other programs or raise the limit on memory", Video2AnimError.exit_code
    if isinstance(error, OSError) and error.filename is not None:
        where = printable(" ".join(str(error.filename).split()))
        return f"want a file that can be read or written, got {error.strerror} at {where}", InputError.exit_code
    if isinstance(error, OSError):  # numpy's of a full disk has no number
        return f"output: could not be written ({error})", InputError.exit_code
    return None


def is_output_lost(error: Exception) -> bool:
    """Whether what a command prints finds no reader or no room."""
    return isinstance(error, OSError) and error.filename is None and error.errno in _OUTPUT_LOST


def one_line(error: Exception) -> str:
    """What an error says, in one short line."""
    text = "not enough memory" if isinstance(error, MemoryError) else " ".join(str(error).split())
    return text[:MESSAGE_LETTERS] or type(error).__name__


def expect_file(path: Path, what: str, max_bytes: int = MAX_BYTES) -> None:
    """Refuse what is no file of a size that can be read.

    Raises:
        InputError: nothing is there, a folder, a pipe or a device, or more bytes than that.
    """
    try:
        if not path.is_file():
            problem = f"no such {what}{' (not a plain file)' if path.exists() else ''}"
            raise InputError(f"{path}: cannot read: {problem}")
        size = path.stat().st_size
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise InputError(f"{path}: cannot read the {what}: {one_line(error)}") from error
    if size > max_bytes:
        raise InputError(f"{path}: want a {what} of at most {max_bytes / 2**20:,.0f} MiB, got {size / 2**20:,.0f} MiB")


def expect_values(words: Sequence[str]) -> None:
    """An empty value comes of a variable that is not set; as a path it would be the current folder.

    Raises:
        UsageError: an option has one.
    """
    for word, value in pairwise((*words, "-")):
        if word.startswith("--") and (not value or word.endswith("=")):
            raise UsageError(f"{word.rstrip('=')}: want a value, got an empty one")
