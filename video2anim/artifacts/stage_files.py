"""Files that somebody else may have put there: none reaches out of its folder, blocks a run or fills the memory."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from pydantic import TypeAdapter, ValidationError

from video2anim.errors import MAX_BYTES, ArtifactError

VALUE_JSON, ARRAYS_NPZ, MASKS_NPZ = "value.json", "arrays.npz", "masks.npz"

MAX_TEXT_BYTES = 64 << 20
"""Of one JSON file."""
_SHOWN = 60
"""Characters of a wrong value that a message repeats."""


def member(folder: Path, name: str) -> Path:
    """The regular file that a folder calls by this name.

    Raises:
        ArtifactError: it leads out of the folder, is missing, or is something else.
    """
    path = folder / name
    try:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise ArtifactError(f"want files inside the folder, got {shown(name)}; put a copy into {folder}")
        there = path.is_file()
    except (OSError, ValueError, RuntimeError) as error:  # a name too long, with a NUL, or a circle of links
        raise ArtifactError(f"want the name of a file, got {shown(name)} in {folder}") from error
    if not there:
        raise ArtifactError(
            f"want a file {shown(name)} in {folder}, found {'none' if not path.exists() else 'no file'}"
        )
    return path


@contextmanager
def opened(path: Path, max_bytes: int = MAX_BYTES) -> Iterator[BinaryIO]:
    """A regular file, open for reading; a pipe or device does not block.

    Raises:
        ArtifactError: missing, unreadable, too large or no regular file.
    """
    try:
        stream = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ArtifactError(f"want a readable file, got {reason.lower()} at {path}") from error
    with stream:
        found = os.fstat(stream.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise ArtifactError(f"want a regular file, got a folder, pipe or device at {path}")
        if found.st_size > max_bytes:
            raise ArtifactError(f"want at most {max_bytes} bytes, got {found.st_size} at {path}")
        yield stream


def read_json(path: Path, kind: Any) -> Any:
    """A JSON file as a type that pydantic checks strictly: no text for numbers, no unknown fields.

    Raises:
        ArtifactError: unreadable or of another form; names the field, what was wanted and what came.
    """
    with opened(path, MAX_TEXT_BYTES) as stream:
        data = stream.read()
    try:
        return TypeAdapter(kind).validate_json(data, strict=True)
    except ValidationError as error:
        raise ArtifactError(f"{path.name}: {first_fault(error)} in {path}") from error


def first_fault(error: ValidationError) -> str:
    """The first fault that pydantic found, in one line."""
    fault = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(part) for part in fault["loc"]) or "the whole"
    if fault["type"] == "json_invalid":
        return f"damaged, {shown(fault['msg'])}"
    return f"{shown(where)}: {fault['msg'][:1].lower()}{fault['msg'][1:]}, got {shown(fault['input'])}"


def shown(value: Any) -> str:
    """A value in a message: one line, cut where it is long."""
    text = value if isinstance(value, str) else repr(value)
    text = "".join(letter if letter.isprintable() else "?" for letter in text[: _SHOWN + 1])
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def value_files(folder: Path) -> list[Path]:
    """The files that hold the value of a stage folder: `value.json`, its archives and what it names. Others, such as
    those that file managers leave, are none of it. Where `value.json` is damaged, every file counts."""
    try:
        with opened(folder / VALUE_JSON, MAX_TEXT_BYTES) as stream:
            names = {VALUE_JSON, ARRAYS_NPZ, MASKS_NPZ, *_references(json.loads(stream.read()))}
        return sorted(path for path in (_own(folder, name) for name in names) if path is not None)
    except (ArtifactError, ValueError, RecursionError):
        return sorted(path for path in folder.rglob("*") if path.is_file())


def _own(folder: Path, name: str) -> Path | None:
    try:
        return member(folder, name)
    except ArtifactError:
        return None  # the digest then differs from that of the whole value, and the reader says why


def _references(data: Any) -> Iterator[str]:
    if isinstance(data, list):
        for item in data:
            yield from _references(item)
    elif isinstance(data, dict):
        for key, item in data.items():
            if key in ("$file", "$image", "$motion", "$mesh") and isinstance(item, str):
                yield item
            yield from _references(item)
