"""Checks of values at construction: consistent shapes, finite numbers, units in range.

The annotation of a field defines its checks: shape, limits, and what it `Holds`. Readers of files check arrays against
the same annotations (`video2anim.artifacts.arrays`).
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from typing import Any, cast

import numpy as np
from pydantic import TypeAdapter, ValidationError

from video2anim.types.storage import Holds, IdsOf, OnePer

MAX_M = 1e4
"""Largest coordinate: positions beyond 10 km are in a wrong unit."""
ROTATION_TOLERANCE = 1e-3
"""Tolerance of the entries of R R^T - I: files hold rotations in single precision or as text."""


class Checked:
    """Base class of the values that stages pass to each other. It checks the fields at construction.

    Raises:
        ValueError: a field does not match its annotation; the message names the type and the field.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        expect_sound(self)


def expect_sound(value: object) -> None:
    """Check the fields of a dataclass against their annotations.

    Raises:
        ValueError: a field does not match.
    """
    axes: dict[str, int] = {}
    for name, expect in _checks(type(value)):
        fault = expect(value, getattr(value, name), axes)
        if fault is not None:
            raise ValueError(f"{type(value).__name__}.{name}: {fault}")


def expect_equal_lengths(value: Any, field: str, lengths: Sequence[int]) -> None:
    """Check that the items of a field have equal numbers of frames.

    Raises:
        ValueError: they do not.
    """
    if len(set(lengths)) > 1:
        raise ValueError(f"{type(value).__name__}.{field}: want equal numbers of frames, got {list(lengths)}")


def annotation(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type and its `Annotated` metadata."""
    return (hint.__origin__, hint.__metadata__) if typing.get_origin(hint) is typing.Annotated else (hint, ())


def is_array(hint: Any) -> bool:
    """Whether a type is an array, plain or with dtype and shape by jaxtyping."""
    kind = annotation(hint)[0]
    return kind is np.ndarray or getattr(kind, "array_type", None) is np.ndarray


def shape_fault(shape: tuple[int, ...], kind: Any, axes: MutableMapping[str, int]) -> str | None:
    """What is wrong with a shape according to a jaxtyping type, or None. Lengths of new axes are added to `axes`."""
    words = [int(word) if word.isdigit() else word for word in kind.dim_str.split()]
    wanted = [axes.get(word, word) if isinstance(word, str) else word for word in words]
    pairs = list(zip(wanted, shape, strict=False))
    if len(wanted) != len(shape) or any(length != want for want, length in pairs if isinstance(want, int)):
        return f"want shape ({', '.join(map(str, wanted))}{',' if len(wanted) == 1 else ''}), got {shape}"
    axes.update({word: length for word, length in pairs if isinstance(word, str)})
    return None


def content_fault(array: np.ndarray, marks: tuple[Any, ...], axes: Mapping[str, int]) -> str | None:
    """What is wrong with the values of an array according to its annotation, with the first bad row; or None."""
    if array.dtype.kind in "fc" and Holds.GAPS not in marks and not np.isfinite(array).all():
        return "want finite numbers, got NaN or infinity"
    for mark in marks:
        bad = np.atleast_1d(_FAULTS[mark](array, axes)) if mark in _FAULTS else np.zeros(1, bool)
        if bad.any():
            row = ", ".join(str(index) for index in np.unravel_index(int(bad.argmax()), bad.shape))
            return f"want {mark.value}, got something else at [{row}]"
    return None


def count_fault(kind: type, name: str, mark: OnePer, count: int, wanted: int) -> str | None:
    """What is wrong with the length of a tuple that needs one item for each item of another field, or None."""
    optional = next(f for f in dataclasses.fields(kind) if f.name == name).default is not dataclasses.MISSING
    if count == wanted or (optional and count == 0):
        return None
    return f"want one of each of the {wanted} {mark.field}, got {count}"


def ids_fault(items: Sequence[Any], ids: Sequence[int]) -> str | None:
    """What is wrong with IDs that must be IDs of other items, or None."""
    there = [item.person_id for item in items]
    return None if set(ids) <= set(there) else f"want numbers among {there}, got {tuple(ids)}"


_Rows = np.ndarray | np.bool
"""Whether each row is wrong; for single items one value."""
_Check = Callable[[Any, Any, MutableMapping[str, int]], str | None]


@functools.cache
def _checks(kind: type) -> tuple[tuple[str, _Check], ...]:
    hints = typing.get_type_hints(kind, include_extras=True)
    found: list[tuple[str, _Check]] = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        plain, marks = annotation(hint)
        item = typing.get_args(plain)[0] if typing.get_origin(plain) is tuple else None
        if is_array(hint):
            found.append((field.name, functools.partial(_array, hint)))
        elif item is not None and is_array(item):
            found.append((field.name, functools.partial(_arrays, item)))
        elif Holds.SOMETHING in marks:
            found.append((field.name, _some_faces))
        elif _has_limits(hint):
            found.append((field.name, functools.partial(_scalar, TypeAdapter(hint).validate_python)))
        for mark in marks:
            if isinstance(mark, OnePer):
                found.append((field.name, functools.partial(_one_per, field.name, mark)))
            elif isinstance(mark, IdsOf):
                found.append((field.name, functools.partial(_ids_of, mark)))
    return tuple(found)


def _has_limits(hint: Any) -> bool:
    """Whether a type of numbers or text contains limits."""
    plain, marks = annotation(hint)
    if typing.get_origin(plain) in (tuple, dict, typing.Union, types.UnionType):
        return any(_has_limits(part) for part in typing.get_args(plain))
    return plain in (int, float, str) and bool(marks)


def _array(hint: Any, _: Any, array: Any, axes: MutableMapping[str, int]) -> str | None:
    kind, marks = annotation(hint)
    if not isinstance(array, np.ndarray):
        return f"want an array, got {type(array).__name__}"
    values = cast("np.ndarray[tuple[int, ...], Any]", array)
    fault = None if kind is np.ndarray else shape_fault(values.shape, kind, axes)
    return fault or content_fault(values, marks, axes)


def _arrays(hint: Any, value: Any, arrays: Any, _: MutableMapping[str, int]) -> str | None:
    faults = (_array(hint, value, array, {}) for array in arrays)
    return next((fault for fault in faults if fault is not None), None)


def _some_faces(_: Any, mesh: Any, axes: MutableMapping[str, int]) -> str | None:
    return None if len(mesh.faces) else f"want {Holds.SOMETHING.value}, got none"


def _scalar(validated: Callable[[Any], Any], _: Any, value: Any, axes: MutableMapping[str, int]) -> str | None:
    try:
        validated(value.item() if isinstance(value, np.generic) else value)
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"[{part!r}]" for part in first["loc"] if not str(part).startswith(("float", "int", "none")))
        wanted = first["msg"].removeprefix("Input should be ").removeprefix("a ")
        return f"want {wanted}, got {first['input']!r}{' at ' * bool(where)}{where}"
    return None


def _one_per(name: str, mark: OnePer, value: object, items: Any, _: MutableMapping[str, int]) -> str | None:
    return count_fault(type(value), name, mark, len(items), len(getattr(value, mark.field)))


def _ids_of(mark: IdsOf, value: Any, ids: Any, _: MutableMapping[str, int]) -> str | None:
    return ids_fault(getattr(value, mark.field), ids)


def _no_rotation(given: np.ndarray, _: Mapping[str, int]) -> _Rows:
    R = np.clip(given, -2.0, 2.0)  # products of huge numbers would overflow
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max((-1, -2))
    return (off > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)


def _not_rigid(T: np.ndarray, axes: Mapping[str, int]) -> _Rows:
    last = np.abs(T[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(-1)
    return _no_rotation(T[..., :3, :3], axes) | (np.abs(T[..., :3, 3]).max(-1) > MAX_M) | (last > 1e-6)


def _not_rising(rows: np.ndarray, _: Mapping[str, int]) -> np.ndarray:
    return np.append(False, ~(rows[1:] > rows[:-1]))


def _no_frames(rows: np.ndarray, axes: Mapping[str, int]) -> _Rows:
    return _not_rising(rows, axes)[: len(rows)] | (rows < 0) | (rows >= axes.get("frames", np.inf))


_FAULTS: dict[Any, Callable[[np.ndarray, Mapping[str, int]], _Rows]] = {
    Holds.ROTATION: _no_rotation,
    Holds.RIGID: _not_rigid,
    Holds.DIRECTION: lambda vector, _: np.abs(np.square(np.clip(vector, -2, 2)).sum(-1) - 1.0) > ROTATION_TOLERANCE,
    Holds.RISING: _not_rising,
    Holds.FRAMES: _no_frames,
    Holds.SHARES: lambda share, _: (share < -1e-6) | (share > 1 + 1e-6),
    Holds.FROM_ORIGIN: lambda points, _: np.abs(points) > np.append(1e-6, np.full(len(points) - 1, MAX_M))[:, None],
    Holds.SOMETHING: lambda picture, _: np.asarray(not picture.any()),
}
"""Tests for each mark: which rows violate it."""
