"""Reading of untrusted files: known keys only, sizes within limits, errors of one line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import IO, Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ValidationError

from video2anim.errors import MAX_BYTES, MESSAGE_LETTERS, InputError, expect_file, one_line
from video2anim.types.clip import FPS

MAX_TEXT_BYTES = 256 * 2**20
"""Of a text file."""
MAX_FRAMES = round(FPS * timedelta(hours=1).total_seconds())
"""Of one motion: an hour."""
MAX_NUMBER = 1e9
"""Of lengths and angles in text files, whatever the unit: a thousand kilometers in millimeters."""

Model = TypeVar("Model", bound=BaseModel)


def read_text(path: Path, what: str) -> str:
    """Text of a file; bytes that are no UTF-8 become question marks.

    Raises:
        InputError: missing, too large, or not to be read.
    """
    expect_file(path, what, MAX_TEXT_BYTES)
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {error.strerror or error}") from error


def read_json(path: Path, what: str) -> dict[str, Any]:
    """A JSON object, a table of values by name.

    Raises:
        InputError: missing, too large, no JSON, or not an object.
    """
    values = read_json_value(path, what)
    if not isinstance(values, dict):
        raise InputError(f"{path}: want a table (JSON object) as {what}, got {type(values).__name__}")
    return values


def read_json_value(path: Path, what: str) -> Any:
    """Any JSON value.

    Raises:
        InputError: missing, too large, or no JSON.
    """
    expect_file(path, what, MAX_TEXT_BYTES)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: {what} cannot be read as JSON: {one_line(error)}") from error


def read_arrays(
    source: Path | IO[bytes],
    names: Sequence[str],
    what: str,
    *,
    needed: Sequence[str] = (),
    max_bytes: int = MAX_BYTES,
    where: str | None = None,
) -> dict[str, np.ndarray]:
    """Those arrays of numbers or text of an `.npz` archive that are named and there; nothing else is unpacked.

    Args:
        source: the file.
        names: wanted arrays.
        what: of which the errors speak.
        needed: arrays that must be there, read too.
        max_bytes: of all of them, unpacked.
        where: name of the file in errors; None = its path.

    Raises:
        InputError: the file is missing, damaged, encrypted or too large, lacks a needed array, or an array holds
            objects, complex numbers or times.
    """
    where = where or str(source)
    if isinstance(source, Path):
        with _opened(source, what) as stream:
            return read_arrays(stream, names, what, needed=needed, max_bytes=max_bytes, where=where)
    found: dict[str, Any] = {}
    try:
        loaded = np.load(source, allow_pickle=False)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            raise InputError(f"{where}: a single array, not a {what} (.npz)")
        with loaded as archive:
            missing = [name for name in needed if name not in archive.files]
            if missing:
                raise InputError(f"{where}: not a {what}, it lacks {', '.join(missing[:4])}")
            wanted = [name for name in dict.fromkeys((*needed, *names)) if name in archive.files]
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.zip.infolist()}  # pyright: ignore[reportOptionalMemberAccess]
            if sum(sizes[name] for name in wanted) > max_bytes:
                raise InputError(f"{where}: want at most {max_bytes / 2**20:,.0f} MiB of arrays in a {what}")
            found = {name: archive[name] for name in wanted}
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and numpy's parser of headers raise classes of many kinds
        raise InputError(f"{where}: cannot be read as a {what} (plain .npz arrays): {one_line(error)}") from error
    for name, value in found.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biufU":
            kind = value.dtype if isinstance(value, np.ndarray) else "other data"
            raise InputError(f"{where}: {name} wants numbers or text, got {kind}")
    return found


def _opened(path: Path, what: str) -> IO[bytes]:
    expect_file(path, what)
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {one_line(error)}") from error


def read_array(path: Path, what: str, *, mapped: bool = False) -> np.ndarray:
    """The numbers or text of an `.npy` file.

    Args:
        path: the file.
        what: of which the errors speak.
        mapped: whether the file is mapped into memory instead of read.

    Raises:
        InputError: the file is missing, damaged or too large, or holds objects.
    """
    expect_file(path, what)
    try:
        found = np.load(path, mmap_mode="r" if mapped else None, allow_pickle=False)
    except Exception as error:  # numpy's parser of headers raises classes of many kinds
        raise InputError(f"{path}: cannot be read as a {what} (.npy): {one_line(error)}") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "biufU":
        raise InputError(f"{path}: want numbers or text as {what}")
    return found


def checked(model: type[Model], where: str, values: dict[str, Any]) -> Model:
    """The values as a model.

    Raises:
        InputError: the first fault.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"]) or "file"
        text = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{where}: {name} {text}"[: 2 * MESSAGE_LETTERS]) from error


def _numbers(value: Any) -> np.ndarray:
    try:
        found = np.asarray(value)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"wants numbers in rows of equal length: {one_line(error)}") from error
    if found.dtype.kind not in "biuf":
        raise ValueError("wants numbers in rows of equal length")
    return found


def _one_number(value: Any) -> float:
    found = _numbers(value)
    if found.size != 1 or not np.isfinite(found).all():
        raise ValueError("wants one finite number")
    return float(found.reshape(()))


def _texts(value: Any) -> tuple[str, ...]:
    found = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(found, list | tuple) or not all(isinstance(text, str) for text in found):
        raise ValueError("wants a list of text")
    return tuple(found)


def _text(value: Any) -> str:
    found = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    if not isinstance(found, str):
        raise ValueError("wants text")
    return found


def shaped(*shape: int | None, letters: str = "K") -> AfterValidator:
    """Check of an array's shape; None = any length, told by a letter."""
    told = iter(letters)
    words = ", ".join(next(told) if size is None else str(size) for size in shape)
    wanted = f"({words},)" if len(shape) == 1 else f"({words})"

    def check(value: np.ndarray) -> np.ndarray:
        fits = value.ndim == len(shape) and all(w in (None, h) for w, h in zip(shape, value.shape, strict=True))
        if not fits:
            raise ValueError(f"wants shape {wanted}, got {value.shape}")
        return value

    return AfterValidator(check)


Numbers = Annotated[np.ndarray, BeforeValidator(_numbers)]
"""An array of numbers, from nested lists or an array."""
OneNumber = Annotated[float, BeforeValidator(_one_number)]
Texts = Annotated[tuple[str, ...], BeforeValidator(_texts)]
Text = Annotated[str, BeforeValidator(_text)]
