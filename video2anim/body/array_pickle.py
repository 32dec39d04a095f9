"""Reads arrays from pickle files without executing anything in them.

A pickle is a program. This reader admits a short list of names, and each leads to an inert holder that only stores its
arguments: numpy arrays, dtypes and scalars, scipy sparse matrices, and the chumpy arrays of old SMPL files (numbers
under `x`). numpy reads no pickled state either, because a forged dtype could make it treat raw bytes as object
pointers. Arrays are built from plain number bytes after the file is closed.
"""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from video2anim.errors import InputError

MALFORMED = (ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError, RecursionError)
"""Exceptions that a damaged or forged pickle can raise."""
_NUMBERS = re.compile(r"[fiub][1248]")


def read_pickled_arrays(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The named arrays of a pickled dictionary. Nothing in the file is executed.

    Raises:
        InputError: the file is missing or damaged, contains anything but numbers, or lacks an array.
    """
    try:
        content = load_held(path)
    except ValueError as error:
        raise InputError(f"pickled arrays: {error}") from error
    try:
        return {name: numbers(content[name]) for name in names}
    except MALFORMED as error:
        raise InputError(f"{path}: want a pickled table with {', '.join(names)}, got {line(error)}") from error


def load_held(path: Path) -> Any:
    """The content of a pickle, with holders in place of its objects; `numbers` turns holders into arrays.

    Raises:
        ValueError: not a pickle, or it uses a name that is not admitted; the message says which.
    """
    try:
        with path.open("rb") as stream:
            return _Unpickler(stream, encoding="latin1").load()  # Python 2 wrote the bytes of arrays as text
    except _Refused as error:
        raise ValueError(f"want arrays of numbers, the pickle asks for {error} in {path}; nothing was run") from error
    except (pickle.UnpicklingError, OSError, EOFError, *MALFORMED) as error:
        raise ValueError(f"want a pickle, got {line(error)} in {path}") from error


def line(error: Exception) -> str:
    """The text of an error in one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


class _Refused(pickle.UnpicklingError):
    """The file uses a name that is not admitted."""


class _Held:
    """Placeholder for an object of the file: stores arguments and state, does nothing."""

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
    """Returns holders for the admitted names and imports nothing."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if module_name.split(".")[0] == "chumpy":
            return _Chumpy
        try:
            return _ADMITTED[module_name, global_name]
        except KeyError:
            raise _Refused(f"{module_name}.{global_name}") from None


def numbers(value: Any) -> np.ndarray:
    """The array that a holder describes.

    Raises:
        ValueError: not a holder of numbers. A damaged one can raise any of `MALFORMED`.
    """
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
            return numbers(value.state["x"])
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
    """A sparse matrix as a dense array; duplicate entries add up, as in scipy."""
    state = held.state
    rows, columns = (int(n) for n in state.get("_shape", state.get("shape")))
    data = numbers(state["data"])
    if isinstance(held, _Coo):
        row, column = state["coords"] if "coords" in state else (state["row"], state["col"])
        at = numbers(row), numbers(column)
    else:
        indices, starts = numbers(state["indices"]), numbers(state["indptr"])
        line = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        at = (indices, line) if isinstance(held, _Csc) else (line, indices)
    dense = np.zeros((rows, columns))
    np.add.at(dense, at, data)
    return dense
