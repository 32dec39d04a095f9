"""Reads YAML that a person wrote: text, numbers, truth values, lists and mappings by name, and nothing else.

Tags, aliases, dates, keys given twice and deep nesting have no use in a configuration, and each is a way to run code,
to fill the memory, or to lose an option without a word.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, cast

import yaml

MAX_CHARACTERS = 32_768
"""The longest preset that ships has a few hundred."""
MAX_LEVELS = 12
"""A list of an option of a stage is the third."""
_TAG = "tag:yaml.org,2002:"
_KNOWN = tuple(_TAG + name for name in ("null", "bool", "int", "float"))
"""What is no text although it is not quoted. Dates, merge keys and `=` are not among it, so they are text."""


class PlainYamlError(ValueError):
    """The text is not YAML, or holds more than plain data; the message is one short line without the text itself."""


def read_yaml(text: str) -> Any:
    """Plain data of one YAML document; None for an empty one.

    Raises:
        PlainYamlError: not YAML, or more than plain data.
    """
    if len(text) > MAX_CHARACTERS:
        raise PlainYamlError(f"more than {MAX_CHARACTERS} characters")
    try:
        loader = _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()  # pyright: ignore[reportUnknownMemberType] - untyped
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise PlainYamlError(f"{place}{str(error.problem)[:120]}") from error
    except yaml.YAMLError as error:
        raise PlainYamlError("a character that YAML text cannot hold") from error
    except (ValueError, OverflowError) as error:
        raise PlainYamlError("a number that cannot be read") from error


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers = {  # noqa: RUF012 - PyYAML copies it on change
        first: [(tag, pattern) for tag, pattern in found if tag in _KNOWN]
        for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._level = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = cast("yaml.Event", self.peek_event())  # pyright: ignore[reportUnknownMemberType] - untyped
        if isinstance(event, yaml.AliasEvent):
            raise _refused("aliases (*name) are not read, write the value out", event)
        if getattr(event, "tag", None) is not None:
            raise _refused("tags (!name) are not read", event)
        self._level += 1
        if self._level > MAX_LEVELS:
            raise _refused(f"nested more than {MAX_LEVELS} levels deep", event)
        node = super().compose_node(parent, index)
        self._level -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != _TAG + "str":
                raise _refused("want a name as key; put it in quotes if it is one", key)
            if key.value in seen:
                raise _refused("this key is there twice", key)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _refused(problem: str, at: yaml.Event | yaml.Node) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=at.start_mark)
