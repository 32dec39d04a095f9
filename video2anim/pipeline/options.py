"""What an option of a stage takes, said in its type; checked before anything runs.

frames: Annotated[int, limits("frames", ge=1, le=100)] = 24
model: Annotated[str, model_of("object-mesh", also=("none",))] = "none"
model_resolution: Annotated[int, limits(ge=16), only_without("model", "none")] = 96
"""

from __future__ import annotations

import dataclasses
import functools
import os
import reprlib
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, cast, get_args, get_origin

import pydantic
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from video2anim.errors import UsageError

_RULES = pydantic.ConfigDict(allow_inf_nan=False, coerce_numbers_to_str=True)
"""YAML reads a name such as the person ID `1` as a number; options that want text get it as text."""
_PLAIN = {bool: "true or false", int: "a whole number", float: "a number", str: "text", NoneType: "none"}
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 80
_SHORT.maxlevel = 3


@dataclass(frozen=True, slots=True)
class OnlyWhere:
    """Note in an option's type: it means something only where another option has (or has not) one of some values."""

    option: str
    values: tuple[Any, ...]
    has: bool

    def holds(self, config: Any) -> bool:
        """Whether the option means something in this configuration of its stage."""
        return (getattr(config, self.option) in self.values) == self.has


@dataclass(frozen=True, slots=True)
class Option:
    """One option of a stage."""

    hint: Any
    """Its type with all notes."""
    default: Any
    adapter: pydantic.TypeAdapter[Any]

    @property
    def conditions(self) -> list[OnlyWhere]:
        return [note for note in get_args(self.hint)[1:] if isinstance(note, OnlyWhere)]

    def checked(self, value: Any, where: str) -> Any:
        """The value as the stage gets it.

        Raises:
            UsageError: of another type, out of range, or no known name.
        """
        try:
            return self.adapter.validate_python(value)
        except pydantic.ValidationError as error:
            told = error.errors(include_url=False, include_input=False)[0].get("ctx", {}).get("error")
            want = str(told) if isinstance(told, ValueError) else wanted(self.hint)
            raise UsageError(f"{where}: want {want}, got {short(value)}") from error


def limits(
    unit: str = "",
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
) -> Any:
    """Range of a number, in `unit`."""
    words = (("from", ge), ("above", gt), ("to", le), ("to below", lt))
    said = " ".join(f"{word} {round(bound, 4)}" for word, bound in words if bound is not None)
    return pydantic.Field(ge=ge, gt=gt, le=le, lt=lt, description=f"{said} {unit}".strip())


Height = Annotated[float, limits("m (--height-m)", ge=0.5, le=2.5)]
Heights = Height | dict[Annotated[int, limits("(ID)", ge=1, le=1_000_000)], Height]
"""Standing height of the main person, or of people by ID."""


def model_of(slot: str, *, also: tuple[str, ...] = ()) -> pydantic.AfterValidator:
    """Name of a model of the slot, NAME@PATH for weights of the user's own, or one of the names in `also`."""

    def known(name: str) -> str:
        from video2anim.networks import find_model, list_models

        try:
            if name in also or find_model(name).slot == slot:
                return name
        except (UsageError, RuntimeError):  # no such model, or a PATH in the home of nobody
            pass
        names = ", ".join(model.name for model in list_models() if model.slot == slot)
        besides = "".join(f" or {text!r}" for text in also)
        raise ValueError(f"a model of slot {slot} ({names}; NAME@PATH for weights of your own){besides}")

    return pydantic.AfterValidator(known)


def only_with(option: str, *values: Any) -> OnlyWhere:
    """Means something only where another option of the stage has one of these values."""
    return OnlyWhere(option, values, has=True)


def only_without(option: str, *values: Any) -> OnlyWhere:
    """Means something only where another option of the stage has none of these values."""
    return OnlyWhere(option, values, has=False)


@functools.cache
def options_of(kind: type) -> Mapping[str, Option]:
    """The options of a stage's config dataclass, by name."""
    hints = typing.get_type_hints(kind, include_extras=True)
    found: dict[str, Option] = {}
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        if field.metadata.get("user_path"):
            hint = Annotated[hint, pydantic.BeforeValidator(_absolute)]
        found[field.name] = option_of(hint, field.default)
    return found


def option_of(hint: Any, default: Any) -> Option:
    """An option by its type."""
    base = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    strict: Any = hint if base is bool else Annotated[hint, pydantic.BeforeValidator(_no_truth_value)]
    return Option(hint, default, pydantic.TypeAdapter(strict, config=_RULES))


def wanted(hint: Any) -> str:
    """What an option of this type takes, in words."""
    base, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    kind, parts = get_origin(base) or base, get_args(base)
    if kind is Literal:
        return " or ".join(repr(part) for part in parts)
    if kind in (typing.Union, UnionType):
        return " or ".join(wanted(part) for part in parts)
    if kind is dict:
        return f"a mapping of {wanted(parts[0])} to {wanted(parts[1])}"
    if kind is tuple:
        return f"{'a list' if Ellipsis in parts else f'a list of {len(parts)}'}, each {wanted(parts[0])}"
    said = [note.description for note in notes if isinstance(note, FieldInfo) and note.description]
    return " ".join([_PLAIN[kind], *said])


def short(value: Any) -> str:
    """A value in one line of bounded length, whatever it is."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python writes no whole number of thousands of digits
        return "a number of thousands of digits"


def _absolute(path: Any) -> Any:
    """A path that counts from the folder in which the command was given: a later one may be given from another."""
    if path is None or path == "":
        return ""
    if isinstance(path, str | int | float):  # YAML reads a folder's name such as `7` as a number
        return str(Path(os.path.expanduser(str(path))).absolute())
    return path


def _no_truth_value(value: Any) -> Any:
    """For Python `true` is the number 1; for a person it is a slip."""
    items: Any = value
    if not isinstance(items, list | tuple):
        items = [items]
    if any(isinstance(item, bool) for item in cast("Sequence[Any]", items)):
        raise PydanticCustomError("truth_value", "no truth value")
    return value
