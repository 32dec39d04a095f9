"""The stage graph, read from signatures and checked before anything runs."""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Sequence
from dataclasses import dataclass

from video2anim.pipeline.stage import StageContext, StageSpec


class GraphError(Exception):
    """The stages do not fit together; a mistake in the code, not of the user."""


@dataclass(frozen=True, slots=True)
class Node:
    """A stage with its inputs, output and configuration as its signature tells them."""

    spec: StageSpec
    number: int
    inputs: tuple[tuple[str, type], ...]
    """Parameter name and type of each value the stage takes."""
    output: type
    config_type: type

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def folder_name(self) -> str:
        return f"{self.number:02d}_{self.name}"


def build_graph(specs: Sequence[StageSpec], given: Sequence[type]) -> tuple[Node, ...]:
    """Nodes in order. Every input must be `given` or made by an earlier stage, every type by one stage only.

    Raises:
        GraphError: two makers of one type, a missing maker, or a malformed signature.
    """
    makers: dict[type, str] = {kind: "the input" for kind in given}
    nodes: list[Node] = []
    for number, spec in enumerate(specs, start=1):
        node = _node(spec, number)
        for parameter, kind in node.inputs:
            if kind not in makers:
                raise GraphError(
                    f"stage '{spec.name}' needs {kind.__name__} ({parameter}), but no earlier stage makes it"
                )
        if node.output in makers:
            raise GraphError(f"stages '{makers[node.output]}' and '{spec.name}' both make {node.output.__name__}")
        makers[node.output] = spec.name
        nodes.append(node)
    return tuple(nodes)


def _node(spec: StageSpec, number: int) -> Node:
    hints = typing.get_type_hints(spec.function)
    names = list(inspect.signature(spec.function).parameters)
    if names[-2:] != ["config", "ctx"] or hints.get("ctx") is not StageContext:
        raise GraphError(f"stage '{spec.name}': want (..., config, ctx: StageContext), got {names}")
    output, config_type = hints.get("return"), hints.get("config")
    if output is None or not dataclasses.is_dataclass(output) or not dataclasses.is_dataclass(config_type):
        raise GraphError(f"stage '{spec.name}': config and result must be annotated dataclasses")
    inputs = tuple((name, hints[name]) for name in names[:-2])
    return Node(spec, number, inputs, output, config_type)  # type: ignore[arg-type]
