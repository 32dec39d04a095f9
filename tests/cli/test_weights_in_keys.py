"""A stage's cache key holds the weights of every network that its configuration names."""

from __future__ import annotations

import hashlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

import scenemi
from stages.refine import STAGE as REFINE
from stages.refine import RefineConfig
from stages.segment import STAGE, SegmentConfig
from video2anim.cli.compose import TableModels, pipeline_nodes
from video2anim.networks.table import MODELS
from video2anim.pipeline.graph import Node
from video2anim.pipeline.stage import NO_MODEL

NAMES = {entry.name for entry in MODELS}


def networks(config: Any) -> set[str]:
    """Names of networks among the values of a configuration."""
    return {value for field in fields(config) if (value := getattr(config, field.name)) in NAMES}


@pytest.mark.parametrize("node", pipeline_nodes(), ids=lambda node: node.name)
def test_every_network_that_a_stage_names_is_in_its_key(node: Node) -> None:
    config = node.config_type()
    assert networks(config) <= TableModels().digests(node.spec.models, config).keys()


def test_the_priors_weights_are_in_the_key_of_refine(tmp_path: Path) -> None:
    """The shipped ones by default; a file of the user's has a key of its own, and another one when it changes."""

    def key(config: RefineConfig) -> dict[str, str]:
        return TableModels().digests(REFINE.models, config)

    shipped = Path(scenemi.__file__).parent / "weights" / "small.safetensors"
    assert list(key(RefineConfig()).values()) == [hashlib.sha256(shipped.read_bytes()).hexdigest()]
    assert key(RefineConfig(prior="interpolation")) == {}
    mine = tmp_path / "mine.safetensors"
    digests = []
    for content in (b"one", b"two"):
        mine.write_bytes(content)
        digests += key(RefineConfig(prior=str(mine))).values()
    assert digests == [hashlib.sha256(content).hexdigest() for content in (b"one", b"two")]


def test_the_detector_is_in_the_key_of_segment_unless_it_is_left_out() -> None:
    config = SegmentConfig()
    digests = TableModels().digests(STAGE.models, config)
    assert digests.keys() == {"room-segment", "objectron"}
    without = replace(config, finder=NO_MODEL)
    assert TableModels().digests(STAGE.models, without).keys() == {"room-segment"}
