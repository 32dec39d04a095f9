"""Which models a configuration really uses: those are in the cache key, and no others."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stages.refine import RefineConfig
from video2anim.cli.compose import TableModels, pipeline_nodes, preset_models
from video2anim.networks import weight_digests, weight_licenses
from video2anim.pipeline.config import resolve
from video2anim.pipeline.graph import Node


def used(stage: str, **options: Any) -> dict[str, str]:
    """Digests in the key of a stage."""
    node: Node = next(node for node in pipeline_nodes() if node.name == stage)
    config = resolve(pipeline_nodes(), "p", [("test", {stage: options})]).stages[stage]
    return TableModels().digests(node.spec.models, config)


@pytest.fixture
def own(tmp_path: Path) -> Callable[[str], str]:
    """NAME@FILE with a file of the user's own."""

    def name(model: str) -> str:
        path = tmp_path / f"{model}.onnx"
        path.write_bytes(model.encode())
        return f"{model}@{path}"

    return name


def test_the_lifter_is_in_the_key_where_it_is_used(own: Callable[[str], str]) -> None:
    assert list(used("humans")) == ["lifter"]
    assert used("humans", model=own("lifter"))["lifter"] != used("humans")["lifter"]


def test_a_stage_that_names_the_prior_has_it_in_its_key(tmp_path: Path) -> None:
    """Slot `prior` is filled by a field of that name."""
    own = tmp_path / "mine.safetensors"
    own.write_bytes(b"weights")
    shipped = weight_digests("scenemi")
    digests = functools.partial(TableModels().digests, ("prior",))
    assert digests(SimpleNamespace(prior="auto")) == digests(SimpleNamespace(prior="scenemi")) == shipped
    assert digests(RefineConfig()) == shipped
    assert digests(SimpleNamespace(prior="interpolation")) == {}
    assert digests(SimpleNamespace(prior=str(own)))["scenemi"] != shipped["scenemi"]


def test_presets_fetch_what_they_use() -> None:
    assert {"blazepose-heavy", "lifter", "room-camera", "room-depth", "room-segment"} <= set(preset_models("embedded"))


def test_licenses_of_what_was_used(own: Callable[[str], str]) -> None:
    """A file of the user's own has no license that the table could name."""
    told = weight_licenses(used("humans") | used("refine"))
    assert told == {"lifter": "Apache-2.0", "scenemi": "Apache-2.0"}
    assert weight_licenses(used("humans", model=own("lifter"))) == {"lifter": "of the user's own file"}
