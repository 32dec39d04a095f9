"""Configuration: one frozen dataclass per stage, presets in YAML, overrides from the command line."""

from __future__ import annotations

import dataclasses
import difflib
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

from video2anim.artifacts.user_files import content_digest
from video2anim.errors import UsageError
from video2anim.pipeline.graph import Node
from video2anim.pipeline.options import Option, limits, option_of, options_of, short
from video2anim.pipeline.plain_yaml import MAX_CHARACTERS, PlainYamlError, read_yaml

RUN_KEYS = ("seed",)
_SEED = option_of(Annotated[int, limits(ge=0, le=2**32 - 1)], 0)
"""What every library takes as a seed."""


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
    """The fields of a stage config that can change its result.

    Of the user's files and folders (`user_path`) it is the content that counts; one that is gone counts as changed. Of
    fields with `counts_as` it is what that makes of them.
    """
    found = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    for field in dataclasses.fields(config):
        if field.metadata.get("user_path") and found.get(field.name):
            path = found[field.name]
            found[field.name] = content_digest(Path(path)) if os.path.exists(path) else "missing"
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
            if field.metadata.get("user_path") and path and not os.path.exists(path):
                raise UsageError(f"{name}.{field.name}: want a file or folder, found nothing at {path!r:.300}")


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
    """Overrides of a shipped preset, or of a YAML file given by path; what it does not name stays as it is.

    Raises:
        UsageError: no such preset, or the file is no YAML mapping of plain data in UTF-8.
    """
    own = name.endswith((".yaml", ".yml"))
    path = Path(name) if own else presets_dir() / f"{name}.yaml"
    if not (os.path.isfile(path) if own else name in preset_names()):
        raise UsageError(f"--preset: want one of {preset_names()} or a YAML file, got {short(name)}")
    where = f"--preset {str(path)!r:.300}"
    try:
        with path.open("rb") as stream:
            content = stream.read(4 * MAX_CHARACTERS + 1)
        if len(content) > 4 * MAX_CHARACTERS:  # bytes of as many of the longest characters
            raise UsageError(f"{where}: want a small text, got more than {4 * MAX_CHARACTERS} bytes")
        data = read_yaml(content.decode("utf-8-sig"))
    except OSError as error:
        raise UsageError(f"{where}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{where}: want text in UTF-8, got another encoding; save it as UTF-8") from error
    except PlainYamlError as error:
        raise UsageError(f"{where}: want YAML, got {error}") from error
    if not isinstance(data, dict | None):
        raise UsageError(f"{where}: want a mapping of stages to options, got {short(data)}")
    return cast("dict[str, Any] | None", data) or {}


def parse_set(assignments: Iterable[str]) -> dict[str, Any]:
    """`["depth.far_m=40"]` to nested overrides, later ones winning; values are plain YAML.

    Raises:
        UsageError: not of the form a.b=value.
    """
    overrides: dict[str, Any] = {}
    for text in assignments:
        key, sign, value = text.partition("=")
        parts = key.split(".")
        if not sign or len(parts) > 2 or not all(parts):
            raise UsageError(f"--set: want STAGE.OPTION=VALUE, got {short(text)}")
        try:
            parsed = read_yaml(value)
        except PlainYamlError as error:
            raise UsageError(f"--set: want STAGE.OPTION=VALUE in YAML, got {short(text)} ({error})") from error
        options: Any = {parts[1]: parsed} if len(parts) == 2 else parsed
        before = overrides.get(parts[0])
        if isinstance(before, dict) and isinstance(options, dict):
            options = cast("dict[str, Any]", before) | cast("dict[str, Any]", options)
        overrides[parts[0]] = options
    return overrides


def resolve(nodes: Sequence[Node], preset: str, layers: Sequence[tuple[str, Any]]) -> PipelineConfig:
    """Merge layers (source name, overrides), later ones winning, into typed stage configs.

    Raises:
        UsageError: unknown key (with the nearest known one), a value of the wrong type or out of range, the name of no
            model, or an option that means nothing beside another one.
    """
    types = {node.name: node.config_type for node in nodes}
    values: dict[str, dict[str, Any]] = {name: {} for name in types}
    chosen: dict[str, dict[str, int]] = {name: {} for name in types}
    """The last layer that names an option; whole records of a stage are no choices."""
    seed = 0
    for number, (source, overrides) in enumerate(layers):
        if not isinstance(overrides, Mapping):
            raise UsageError(f"{source}: want a mapping of stages to options, got {short(overrides)}")
        for key, given in cast("Mapping[Any, Any]", overrides).items():
            if key == "seed":
                seed = _SEED.checked(given, f"{source}: seed")
                continue
            _expect_known(key, [*types, *RUN_KEYS], source)
            if not isinstance(given, Mapping):
                raise UsageError(f"{source}: '{key}' wants a mapping of options, got {short(given)}")
            options, given = options_of(types[key]), cast("Mapping[Any, Any]", given)
            for name, value in given.items():
                _expect_known(name, options, source, prefix=f"{key}.")
                values[key][name] = options[name].checked(value, f"{source}: {key}.{name}")
            chosen[key] |= dict.fromkeys(given, -1 if given.keys() >= options.keys() else number)
    stages = {name: kind(**values[name]) for name, kind in types.items()}
    for name, config in stages.items():
        _expect_applicable(name, config, chosen[name])
    return PipelineConfig(preset, seed, stages)


def known_part(nodes: Sequence[Node], config: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Split a recorded configuration into what this version accepts and the names of the other options."""
    types = {node.name: options_of(node.config_type) for node in nodes}
    known: dict[str, Any] = {}
    other: list[str] = []
    for key, value in config.items():
        if key not in types and key not in RUN_KEYS:
            other.append(key)
        elif key in types and isinstance(value, Mapping):
            options = cast("Mapping[str, Any]", value)
            known[key] = {name: one for name, one in options.items() if _is_accepted(types[key].get(name), one)}
            other += [f"{key}.{name}" for name in options if name not in known[key]]
        else:
            known[key] = value
    return known, other


def _is_accepted(option: Option | None, value: Any) -> bool:
    try:
        if option is not None:
            option.checked(value, "")
    except UsageError:
        return False
    return option is not None


def _expect_known(key: Any, known: Collection[str], source: str, prefix: str = "") -> None:
    if isinstance(key, str) and key in known:
        return
    name = short(f"{prefix}{key}" if isinstance(key, str) else key)
    near = difflib.get_close_matches(key[:80], known, n=1, cutoff=0.5) if isinstance(key, str) else []
    advice = f"did you mean '{prefix}{near[0]}'?" if near else f"known: {', '.join(known)}"
    raise UsageError(f"{source}: unknown key {name} ({advice})")


def _expect_applicable(stage: str, config: object, chosen: Mapping[str, int]) -> None:
    """An option that another one makes meaningless is a mistake, unless that other one was chosen over it later."""
    for name, option in options_of(type(config)).items():
        for condition in option.conditions:
            layer = chosen.get(name, -1)
            if layer < 0 or layer < chosen.get(condition.option, -1) or condition.holds(config):
                continue
            if getattr(config, name) != option.default:
                other = getattr(config, condition.option)
                raise UsageError(
                    f"{stage}.{name}: means nothing with {stage}.{condition.option}={short(other)}; leave it out, or "
                    f"set {stage}.{condition.option} too"
                )
