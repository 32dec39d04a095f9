"""Reads model files of SMPL, SMPL-H and SMPL-X as distributed, without executing anything in them.

Pickles are read by `array_pickle`: numpy arrays, scipy sparse matrices, and the chumpy arrays of old files.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from video2anim.body.array_pickle import MALFORMED, line, load_held, numbers
from video2anim.errors import InputError

_AXES: dict[str, tuple[str | int, ...]] = {
    "v_template": ("vertices", 3),
    "shapedirs": ("vertices", 3, "shapes"),
    "weights": ("vertices", "joints"),
    "J_regressor": ("joints", "vertices"),
    "kintree_table": (2, "joints"),
    "f": ("faces", 3),
}
"""Axes of the arrays that are read, by their names in the files."""
_AS_SHIPPED = "use the model file as distributed by its makers"


@dataclass(frozen=True, slots=True, eq=False)
class SmplFile:
    """The arrays read from a model file. Meters, +Y up, facing +Z, in the model's own frame."""

    template_m: Float[np.ndarray, "vertices 3"]
    shape_basis_m: Float[np.ndarray, "vertices 3 shapes"]
    """Vertex offsets of each shape coefficient; in SMPL-X files the expressions follow."""
    weights: Float[np.ndarray, "vertices joints"]
    joint_regressor: Float[np.ndarray, "joints vertices"]
    parents: Int[np.ndarray, "joints"]
    """-1 for the root."""
    faces: Int[np.ndarray, "faces 3"]


def read_smpl_file(path: Path) -> SmplFile:
    """Read a `.npz` or `.pkl` model file. Nothing in it is executed.

    Raises:
        InputError: the file is missing or damaged, contains anything but numbers, or an array is missing or has a wrong
            shape.
    """
    if not path.is_file():
        raise InputError(f"SMPL file: want a .npz or .pkl file at {path}, there is none; correct the path")
    if path.suffix not in (".npz", ".pkl"):
        raise InputError(f"SMPL file: want .npz or .pkl, got {path.suffix!r} at {path}; {_AS_SHIPPED}")
    found = _read_npz(path) if path.suffix == ".npz" else _read_pickle(path)
    _check_shapes(path, found)
    integers = {key: _whole(path, key, found.pop(key)) for key in ("kintree_table", "f")}
    numbers = {key: value.astype(np.float64) for key, value in found.items()}
    for key, value in numbers.items():
        if not np.isfinite(value).all():
            raise InputError(f"SMPL file: {key}: want finite numbers, got NaN or infinity in {path}; {_AS_SHIPPED}")
    faces, vertices = integers["f"], len(numbers["v_template"])
    if faces.min() < 0 or faces.max() >= vertices:
        raise InputError(
            f"SMPL file: f: want vertices 0..{vertices - 1}, got {faces.min()}..{faces.max()} in {path}; {_AS_SHIPPED}"
        )
    parents = integers["kintree_table"][0]
    parents[0] = -1  # the files say 2^32 - 1
    return SmplFile(
        template_m=numbers["v_template"],
        shape_basis_m=numbers["shapedirs"],
        weights=numbers["weights"],
        joint_regressor=numbers["J_regressor"],
        parents=parents,
        faces=faces,
    )


def _check_shapes(path: Path, found: dict[str, np.ndarray]) -> None:
    lengths: dict[str | int, int] = {}
    for key, axes in _AXES.items():
        got = found[key].shape
        want = tuple(lengths.get(axis, axis) for axis in axes)
        fits = len(got) == len(want) and all(
            g == w if isinstance(w, int) else g for w, g in zip(want, got, strict=True)
        )
        if not fits:
            text = ", ".join(str(w) for w in want)
            raise InputError(f"SMPL file: {key}: want shape ({text}), got {got} in {path}; {_AS_SHIPPED}")
        lengths.update({axis: length for axis, length in zip(axes, got, strict=True) if isinstance(axis, str)})


def _whole(path: Path, key: str, found: np.ndarray) -> np.ndarray:
    """An array of indices as int64."""
    if not (np.isfinite(found).all() and (found == np.round(found)).all() and (np.abs(found) < 2**53).all()):
        raise InputError(f"SMPL file: {key}: want whole numbers, got others in {path}; {_AS_SHIPPED}")
    return found.astype(np.int64)


def _absent(path: Path, keys: list[str]) -> InputError:
    missing = ", ".join(key for key in _AXES if key not in keys)
    there = ", ".join(sorted(keys)) or "nothing"
    return InputError(f"SMPL file: want arrays {missing}, got {there[:200]} in {path}; {_AS_SHIPPED}")


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        # Opened here, because `np.load` would leave its own handle open for a damaged archive.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            if not set(_AXES) <= set(archive.files):
                raise _absent(path, archive.files)
            found = {key: archive[key] for key in _AXES}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"SMPL file: want arrays of numbers, got {line(error)} in {path}; {_AS_SHIPPED}") from error
    for key, value in found.items():
        if value.dtype.kind not in "fiub":
            raise InputError(f"SMPL file: {key}: want numbers, got {value.dtype} in {path}; {_AS_SHIPPED}")
    return found


def _read_pickle(path: Path) -> dict[str, np.ndarray]:
    try:
        content = load_held(path)
    except ValueError as error:
        raise InputError(f"SMPL file: {error}; {_AS_SHIPPED}") from error
    if not isinstance(content, dict) or not set(_AXES) <= set(content):
        raise _absent(path, [str(key) for key in content] if isinstance(content, dict) else [])
    found = {}
    for key in _AXES:
        try:
            found[key] = numbers(content[key])
        except MALFORMED as error:
            raise InputError(f"SMPL file: {key}: want numbers, got {line(error)} in {path}; {_AS_SHIPPED}") from error
    return found
