"""Configuration: one frozen dataclass per stage, presets in YAML, overrides from the command line."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pydantic
import yaml

from video2anim.artifacts.user_files import content_digest
from video2anim.errors import UsageError
from video2anim.pipeline.graph import Node

RUN_KEYS = ("seed",)


@dataclass(frozen=True, slots=True)
class PipelineConfig:
    """Resolved configuration of a run."""

    preset: str
    seed: int
    stages: Mapping[str, Any]
    """Stage name -> its config dataclass."""

    def as_dict(self) -> dict[str, Any]:
        """Plain data that `resolve` takes back."""
        return {"seed": self.seed} | {name: dataclasses.asdict(value) for name, value in self.stages.items()}


def result_config(config: Any) -> dict[str, Any]:
    """The fields of a stage config that can change its result; speed knobs (`in_key` False) are left out.

    Of the user's files and folders (`user_path`) it is the content that counts; one that is gone counts as changed. Of
    fields with `counts_as` it is what that makes of them.
    """
    found = {f.name: getattr(config, f.name) for f in dataclasses.fields(config) if f.metadata.get("in_key", True)}
    for field in dataclasses.fields(config):
        if field.metadata.get("user_path") and found.get(field.name):
            path = Path(found[field.name])
            found[field.name] = content_digest(path) if path.exists() else "missing"
        if (counted := field.metadata.get("counts_as")) and found.get(field.name):
            found[field.name] = counted(found[field.name])
    return found


def expect_user_paths(config: PipelineConfig) -> None:
    """Find missing files before anything is run.

    Raises:
        UsageError: one is missing.
    """
    for name, stage in config.stages.items():
        for field in dataclasses.fields(stage):
            path = getattr(stage, field.name)
            if field.metadata.get("user_path") and path and not Path(path).exists():
                raise UsageError(f"{name}.{field.name}: want a file or folder, found nothing at {path}")


def user_path() -> Any:
    """Field of a stage config: a file or folder of the user, empty for none."""
    return dataclasses.field(default="", metadata={"user_path": True})


def counts_as(counted: Callable[[str], Any]) -> Any:
    """Field of a stage config: text, empty by default, that stands for something outside, such as a program.

    Args:
        counted: what of it decides the result, as plain data for the cache key.
    """
    return dataclasses.field(default="", metadata={"counts_as": counted})


def presets_dir() -> Path:
    """Folder of the shipped presets: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "configs" / "presets"
    return installed if installed.is_dir() else package.parent / "configs" / "presets"


def preset_names() -> list[str]:
    """Names for `--preset`."""
    return sorted(path.stem for path in presets_dir().glob("*.yaml"))


def load_preset(name: str) -> dict[str, Any]:
    """Overrides of a shipped preset, or of a YAML file given by path.

    Raises:
        UsageError: no such preset, or the file is not a YAML mapping.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else presets_dir() / f"{name}.yaml"
    if not path.is_file():
        raise UsageError(f"--preset: want one of {preset_names()} or a YAML file, got {name!r}")
    try:
        data = yaml.safe_load(path.read_text()) or {}
    except yaml.YAMLError as error:
        raise UsageError(f"{path}: not valid YAML ({str(error).splitlines()[0]})") from error
    if not isinstance(data, dict):
        raise UsageError(f"{path}: want a mapping of stages to options, got {type(data).__name__}")
    return data


def parse_set(assignments: Iterable[str]) -> dict[str, Any]:
    """`["depth.samples=4"]` to nested overrides; values are YAML scalars.

    Raises:
        UsageError: not of the form a.b=value.
    """
    overrides: dict[str, Any] = {}
    for text in assignments:
        key, sign, value = text.partition("=")
        parts = key.split(".")
        if not sign or len(parts) > 2 or not all(parts):
            raise UsageError(f"--set: want STAGE.OPTION=VALUE, got {text!r}")
        try:
            parsed = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise UsageError(f"--set: want STAGE.OPTION=VALUE with a YAML value, got {text!r}") from error
        if len(parts) == 1:
            overrides[parts[0]] = parsed
        else:
            overrides.setdefault(parts[0], {})[parts[1]] = parsed
    return overrides


def resolve(nodes: Sequence[Node], preset: str, layers: Sequence[tuple[str, Mapping[str, Any]]]) -> PipelineConfig:
    """Merge layers (source name, overrides), later ones winning, into typed stage configs.

    Raises:
        UsageError: unknown key (with the nearest known one) or a value of the wrong type.
    """
    types = {node.name: node.config_type for node in nodes}
    merged: dict[str, dict[str, Any]] = {name: {} for name in types}
    seed = 0
    for source, overrides in layers:
        for key, value in overrides.items():
            if key == "seed":
                seed = _checked(int, value, f"{source}: seed")
                continue
            if key not in types:
                raise UsageError(f"{source}: unknown key '{key}'{_suggest(key, [*types, *RUN_KEYS])}")
            if not isinstance(value, Mapping):
                raise UsageError(f"{source}: '{key}' wants a mapping of options, got {value!r}")
            known = [f.name for f in dataclasses.fields(types[key])]
            for option in value:
                if option not in known:
                    near = _suggest(option, known, prefix=f"{key}.")
                    raise UsageError(f"{source}: unknown key '{key}.{option}'{near}")
            merged[key].update(_names_as_text(types[key], value))
    for name, options in merged.items():
        for field in dataclasses.fields(types[name]):
            if field.metadata.get("user_path") and field.name in options and options[field.name] is None:
                options[field.name] = ""
            if field.metadata.get("user_path") and options.get(field.name):
                # A later command may be given from another folder.
                options[field.name] = str(Path(str(options[field.name])).expanduser().absolute())
    stages = {name: _checked(types[name], options, name) for name, options in merged.items()}
    return PipelineConfig(preset, seed, stages)


def _checked(kind: type, value: Any, where: str) -> Any:
    try:
        return pydantic.TypeAdapter(kind).validate_python(value)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        location = ".".join([where, *(str(part) for part in first["loc"])])
        raise UsageError(f"{location}: {first['msg'].lower()}, got {first['input']!r}") from error


def _names_as_text(kind: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """YAML reads a name such as the person ID `1` as a number; options that want text get it as text."""
    hints = typing.get_type_hints(kind)
    return {
        name: str(value) if hints[name] is str and type(value) in (int, float) else value
        for name, value in options.items()
    }


def _suggest(key: str, known: Sequence[str], prefix: str = "") -> str:
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    return f" (did you mean '{prefix}{near[0]}'?)" if near else f" (known: {', '.join(known)})"
