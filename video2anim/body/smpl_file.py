"""Model files of SMPL, SMPL-H and SMPL-X as their makers ship them, read without running anything in them.

A pickle is a program. Here its names are looked up in a short list, and every name of the list leads to an inert
holder that only keeps what the file says: numpy arrays, dtypes and scalars, scipy sparse matrices, and the chumpy
arrays of old SMPL files, whose numbers lie under `x`. numpy itself reads no pickled state either: a forged dtype could
make it take raw bytes for object pointers. Arrays are built from plain number bytes after the file is closed.
"""

from __future__ import annotations

import math
import pickle
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from video2anim.errors import InputError

_AXES: dict[str, tuple[str | int, ...]] = {
    "v_template": ("vertices", 3),
    "shapedirs": ("vertices", 3, "shapes"),
    "weights": ("vertices", "joints"),
    "J_regressor": ("joints", "vertices"),
    "kintree_table": (2, "joints"),
    "f": ("faces", 3),
}
"""Arrays that are read, by the files' own names."""
_AS_SHIPPED = "use the model file as its makers ship it"
_MALFORMED = (ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError, RecursionError)
"""What a damaged or forged pickle leads to."""
_NUMBERS = re.compile(r"[fiub][1248]")


@dataclass(frozen=True, slots=True, eq=False)
class SmplFile:
    """What the loader takes from a model file. Metres, +Y up, facing +Z, in the model's own frame."""

    template_m: Float[np.ndarray, "vertices 3"]
    shape_basis_m: Float[np.ndarray, "vertices 3 shapes"]
    """Vertex offsets of each shape coefficient; SMPL-X has its expressions behind them."""
    weights: Float[np.ndarray, "vertices joints"]
    joint_regressor: Float[np.ndarray, "joints vertices"]
    parents: Int[np.ndarray, "joints"]
    """-1 for the root."""
    faces: Int[np.ndarray, "faces 3"]


def read_smpl_file(path: Path) -> SmplFile:
    """Read a `.npz` or `.pkl` model file. Nothing in it is executed.

    Raises:
        InputError: the file is missing, damaged, asks for anything but numbers, lacks an array, or has one of a wrong
            shape.
    """
    if not path.is_file():
        raise InputError(f"SMPL file: want a .npz or .pkl file at {path}, there is none; correct the path")
    if path.suffix not in (".npz", ".pkl"):
        raise InputError(f"SMPL file: want .npz or .pkl, got {path.suffix!r} at {path}; {_AS_SHIPPED}")
    found = _read_npz(path) if path.suffix == ".npz" else _read_pickle(path)
    _check_shapes(path, found)
    integers = {key: found.pop(key).astype(np.int64) for key in ("kintree_table", "f")}
    numbers = {key: value.astype(np.float64) for key, value in found.items()}
    for key, value in numbers.items():
        if not np.isfinite(value).all():
            raise InputError(f"SMPL file: {key}: want finite numbers, got NaN or infinity in {path}; {_AS_SHIPPED}")
    faces, vertices = integers["f"], len(numbers["v_template"])
    if faces.size and (faces.min() < 0 or faces.max() >= vertices):
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
        if len(got) != len(want) or any(isinstance(w, int) and w != g for w, g in zip(want, got, strict=True)):
            text = ", ".join(str(w) for w in want)
            raise InputError(f"SMPL file: {key}: want shape ({text}), got {got} in {path}; {_AS_SHIPPED}")
        lengths.update({axis: length for axis, length in zip(axes, got, strict=True) if isinstance(axis, str)})


def _absent(path: Path, keys: list[str]) -> InputError:
    missing = ", ".join(key for key in _AXES if key not in keys)
    there = ", ".join(sorted(keys)) or "nothing"
    return InputError(f"SMPL file: want arrays {missing}, got {there[:200]} in {path}; {_AS_SHIPPED}")


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        # Opened here: where the archive is damaged, `np.load` would leave its own handle open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            if not set(_AXES) <= set(archive.files):
                raise _absent(path, archive.files)
            found = {key: archive[key] for key in _AXES}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"SMPL file: want arrays of numbers, got {_line(error)} in {path}; {_AS_SHIPPED}") from error
    for key, value in found.items():
        if value.dtype.kind not in "fiub":
            raise InputError(f"SMPL file: {key}: want numbers, got {value.dtype} in {path}; {_AS_SHIPPED}")
    return found


def _read_pickle(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as stream:
            content = _Unpickler(stream, encoding="latin1").load()  # Python 2 wrote the bytes of arrays as text
    except _Refused as error:
        raise InputError(
            f"SMPL file: want arrays of numbers, the pickle asks for {error} in {path}; nothing was run, {_AS_SHIPPED}"
        ) from error
    except (pickle.UnpicklingError, OSError, EOFError, *_MALFORMED) as error:
        raise InputError(f"SMPL file: want a pickle, got {_line(error)} in {path}; {_AS_SHIPPED}") from error
    if not isinstance(content, dict) or not set(_AXES) <= set(content):
        raise _absent(path, [str(key) for key in content] if isinstance(content, dict) else [])
    found = {}
    for key in _AXES:
        try:
            found[key] = _numbers(content[key])
        except _MALFORMED as error:
            raise InputError(f"SMPL file: {key}: want numbers, got {_line(error)} in {path}; {_AS_SHIPPED}") from error
    return found


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


class _Refused(pickle.UnpicklingError):
    """The file names something that is not on the list."""


class _Held:
    """Stands in for an object the file describes: keeps arguments and state, does nothing."""

    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> Any:
        held = super().__new__(cls)
        held.args, held.state = args, None
        return held

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Name(_Held):
    """A class that only appears as an argument."""


class _Array(_Held):
    """State: version, shape, dtype, Fortran order, bytes."""


class _Buffer(_Held):
    """Arguments: bytes, dtype, shape, order (arrays of pickle protocol 5)."""


class _Scalar(_Held):
    """Arguments: dtype, bytes."""


class _Dtype(_Held):
    """Arguments: code, align, copy; the second entry of the state is the byte order."""


class _Csc(_Held):
    """State: shape, data, indices, indptr by columns."""


class _Csr(_Held):
    """State: shape, data, indices, indptr by rows."""


class _Coo(_Held):
    """State: shape, data, and either coords or row and col."""


class _Chumpy(_Held):
    """State: the array under `x`; expressions of other arrays have none."""


class _Reconstructed(_Held):
    """What `copyreg._reconstructor` does, for holders only."""

    def __new__(cls, kind: Any, *_: Any) -> Any:
        if not (isinstance(kind, type) and issubclass(kind, _Held)):
            raise _Refused(f"an object of {kind!r}")
        return _Held.__new__(kind)


class _Encoded(_Held):
    """What `_codecs.encode` does: bytes that Python 3 stored as text in an old protocol."""

    def __new__(cls, text: str, *_: Any) -> Any:
        return text.encode("latin1")


_SPARSE = {f"{kind}_{form}": held for kind, held in (("csc", _Csc), ("csr", _Csr), ("coo", _Coo))
           for form in ("matrix", "array")}  # fmt: skip
_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_ADMITTED: dict[tuple[str, str], type[_Held]] = {
    **{(module, "_reconstruct"): _Array for module in _MULTIARRAY},
    **{(module, "scalar"): _Scalar for module in _MULTIARRAY},
    **{(module, "_frombuffer"): _Buffer for module in ("numpy.core.numeric", "numpy._core.numeric")},
    **{(f"scipy.sparse.{prefix}{name[:3]}", name): held for name, held in _SPARSE.items() for prefix in ("", "_")},
    **{(module, "_reconstructor"): _Reconstructed for module in ("copy_reg", "copyreg")},
    **{(module, "object"): _Name for module in ("__builtin__", "builtins")},
    ("numpy", "ndarray"): _Name,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _Encoded,
}


class _Unpickler(pickle.Unpickler):
    """Gives holders for the admitted names and imports nothing."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if module_name.split(".")[0] == "chumpy":
            return _Chumpy
        try:
            return _ADMITTED[module_name, global_name]
        except KeyError:
            raise _Refused(f"{module_name}.{global_name}") from None


def _numbers(value: Any) -> np.ndarray:
    """The array that a holder describes."""
    match value:
        case _Array():
            _, shape, dtype, fortran, raw = value.state
            return _from_bytes(raw, dtype, shape, "F" if fortran else "C")
        case _Buffer():
            raw, dtype, shape, order = value.args
            return _from_bytes(raw, dtype, shape, order)
        case _Scalar():
            dtype, raw = value.args
            return _from_bytes(raw, dtype, (), "C")
        case _Chumpy():
            if "x" not in value.state:
                raise ValueError("a chumpy expression without its value")
            return _numbers(value.state["x"])
        case _Csc() | _Csr() | _Coo():
            return _dense(value)
    raise ValueError(f"a {type(value).__name__.lstrip('_').lower()}")


def _from_bytes(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    if not isinstance(dtype, _Dtype) or not _NUMBERS.fullmatch(str(dtype.args[0])):
        raise ValueError("an array of objects or records")
    byte_order = dtype.state[1] if dtype.state else "="
    kind = np.dtype((byte_order if byte_order in ("<", ">") else "=") + dtype.args[0])
    content = raw.encode("latin1") if isinstance(raw, str) else bytes(raw)
    if len(content) != math.prod(shape) * kind.itemsize:
        raise ValueError(f"{len(content)} bytes for shape {shape} of {kind}")
    return np.frombuffer(content, kind).reshape(shape, order="F" if order == "F" else "C")


def _dense(held: _Held) -> np.ndarray:
    """A sparse matrix written out; entries of one place add up, as in scipy."""
    state = held.state
    rows, columns = (int(n) for n in state.get("_shape", state.get("shape")))
    data = _numbers(state["data"])
    if isinstance(held, _Coo):
        row, column = state["coords"] if "coords" in state else (state["row"], state["col"])
        at = _numbers(row), _numbers(column)
    else:
        indices, starts = _numbers(state["indices"]), _numbers(state["indptr"])
        line = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        at = (indices, line) if isinstance(held, _Csc) else (line, indices)
    dense = np.zeros((rows, columns))
    np.add.at(dense, at, data)
    return dense
