"""Arrays of `.npz` files as the types describe them. A header is held against the annotation before a byte of data is
unpacked; members that nobody asks for are never touched, and nothing is ever unpickled."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from video2anim.artifacts.stage_files import opened, shown
from video2anim.errors import MAX_BYTES, ArtifactError
from video2anim.types.checks import annotation, content_fault, shape_fault
from video2anim.types.storage import Holds

Axes = MutableMapping[str, int]
"""Lengths of named axes, filled in by the first array that has one."""

CLIP_AXES = ("frames", "height", "width")
"""Axes that mean the same in every value made from a clip."""

_DEFLATE_RATIO = 1032
"""The most that one byte of a zip's deflate stream can become."""


class Archive:
    """An open `.npz`."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, file_bytes: int) -> None:
        self._path, self._archive, self._file_bytes = path, archive, file_bytes
        self._unpacked = 0

    def __contains__(self, key: str) -> bool:
        return f"{key}.npy" in self._archive.NameToInfo

    def read(self, key: str, hint: Any, axes: Axes) -> np.ndarray:
        """An array that fits its annotation; whole numbers are taken where fractions are wanted.

        Raises:
            ArtifactError: absent, damaged, too large, or not what the annotation says.
        """
        if key not in self:
            there = ", ".join(name.removesuffix(".npy") for name in self._archive.namelist())
            raise ArtifactError(f"want key {shown(key)}, got {shown(there)} in {self._path}")
        info = self._archive.getinfo(f"{key}.npy")
        with damage(self._path):
            shape, dtype = self._header(info)
        expect_shape(shape, dtype, hint, axes, key, self._path)
        self._unpacked += info.file_size
        if self._unpacked > MAX_BYTES:
            raise ArtifactError(f"{shown(key)}: want at most {MAX_BYTES} bytes of arrays, got more in {self._path}")
        with damage(self._path), self._archive.open(info) as stream:
            array = np.lib.format.read_array(stream, allow_pickle=False)
        kind, marks = annotation(hint)
        # Whole numbers, and halves, which linear algebra does not take, become doubles.
        doubled = "float64" in _kinds(hint) and (dtype.kind in "iu" or dtype.itemsize < 4)
        wanted = np.float64 if doubled and kind is not np.ndarray else dtype.newbyteorder("=")
        array = array.astype(wanted, copy=False)
        expect_content(array, marks, axes, key, self._path)
        return array

    def _header(self, info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
        """Shape and kind of a member, with the promise that there is as much data behind it."""
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("packed in a way that numpy does not use")
        if info.compress_size > self._file_bytes or info.file_size > _DEFLATE_RATIO * info.compress_size + 1024:
            raise ValueError("less data than announced")
        with self._archive.open(info) as stream:
            if np.lib.format.read_magic(stream) == (1, 0):
                shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
            else:
                shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
            data_bytes = dtype.itemsize * math.prod(shape)
            if dtype.hasobject or min(shape, default=0) < 0 or stream.tell() + data_bytes != info.file_size:
                raise ValueError("its header does not fit its data")
        return shape, dtype


@contextmanager
def opened_archive(path: Path) -> Iterator[Archive]:
    """An `.npz`, open until the block ends.

    Raises:
        ArtifactError: missing, no regular file, or no archive.
    """
    with opened(path) as stream:
        with damage(path):
            archive = zipfile.ZipFile(stream)
        with archive:
            yield Archive(path, archive, os.fstat(stream.fileno()).st_size)


@contextmanager
def damage(path: Path) -> Iterator[None]:
    """Turns whatever a library raises over the bytes of a file into one line that names it."""
    try:
        yield
    except ArtifactError:
        raise
    except Exception as error:  # zipfile, zlib, numpy, OpenCV and trimesh raise many classes
        detail = shown(str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__)
        raise ArtifactError(f"{path.name} is damaged ({detail}) at {path}") from error


def expect_shape(shape: tuple[int, ...], dtype: np.dtype, hint: Any, axes: Axes, name: str, where: Path) -> None:
    """Hold a shape and kind of numbers against an annotation; lengths of axes not met before are entered.

    Raises:
        ArtifactError: they do not fit.
    """
    kind, _ = annotation(hint)
    kinds = _kinds(hint)
    whole_for_fraction = dtype.kind in "iu" and "float64" in kinds
    if not ((dtype.kind == "U" and "text" in kinds) or dtype.name in kinds or whole_for_fraction):
        raise ArtifactError(f"{shown(name)}: want {kinds[-1]}, got {shown(str(dtype))} in {where}")
    if kind is np.ndarray:
        return
    own: dict[str, int] = dict(axes)
    if fault := shape_fault(shape, kind, own):
        raise ArtifactError(f"{shown(name)}: {fault} in {where}")
    named = [word for word in kind.dim_str.split() if not word.isdigit()]
    if any(own[word] == 0 for word in named if word in CLIP_AXES):
        raise ArtifactError(f"{shown(name)}: want at least one of {', '.join(named)}, got shape {shape} in {where}")
    axes.update({word: own[word] for word in named})


def _kinds(hint: Any) -> tuple[str, ...]:
    """Names of the dtypes that an array type admits, the usual one last."""
    kind, marks = annotation(hint)
    if Holds.TEXT in marks:
        return ("text",)
    return ("text", "bool", "uint8", "int64", "float64") if kind is np.ndarray else kind.dtypes


def expect_content(array: np.ndarray, marks: tuple[Any, ...], axes: Mapping[str, int], name: str, where: Path) -> None:
    """Hold the numbers of an array against what its annotation says of them.

    Raises:
        ArtifactError: they are not; names the first row that is wrong.
    """
    if fault := content_fault(array, marks, axes):
        raise ArtifactError(f"{shown(name)}: {fault} in {where}")
