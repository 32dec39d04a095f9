"""Whatever is given as configuration, it is taken or refused in one line; nothing else comes out."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from video2anim.cli.compose import pipeline_nodes
from video2anim.errors import InputError, UsageError
from video2anim.pipeline.config import PipelineConfig, expect_user_paths, load_preset, parse_set, resolve
from video2anim.pipeline.options import options_of

NODES = pipeline_nodes()
KEYS = [f"{node.name}.{name}" for node in NODES for name in options_of(node.config_type)]
SHORT = settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])

SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(SCALARS, inner, max_size=4), max_leaves=10
)
_SIGNS = "[]{}:,-?*&!|>%@`'\"#~<=. \n\t0123456789abcxeyno_+\\\0\ufeff\u2028\ud800"
SIGNS = st.text(st.sampled_from(list(_SIGNS)), max_size=60)
_WORDS = ("seed", ".", "=", ": ", "\n  ", "[", "{", "!!int ", "*a", "&a ", "2020-99-99", ".nan", "1e999", "~x/y",
          "none", "-1", "<<", "---\n", "? ", "'")  # fmt: skip
WORDS = st.lists(st.sampled_from([*KEYS, *(node.name for node in NODES), *_WORDS]), max_size=12).map("".join)
TEXTS = SIGNS | WORDS | st.text(max_size=60)


def taken_or_refused(sets: list[str], layers: list[Any], preset: str = "embedded") -> None:
    refusal = ""
    try:
        named = [("preset", load_preset(preset)), ("--set", parse_set(sets))]
        config = resolve(NODES, "p", [*named, *(("layer", layer) for layer in layers)])
        assert isinstance(config, PipelineConfig)
        assert resolve(NODES, "p", [("run.json", config.as_dict())]) == config
        expect_user_paths(config)
    except (UsageError, InputError) as error:
        refusal = str(error)
    assert refusal.isprintable()
    assert len(refusal) < 1000


@SHORT
@given(st.lists(TEXTS, max_size=3))
def test_any_set(sets: list[str]) -> None:
    taken_or_refused(sets, [])


@SHORT
@given(st.sampled_from(KEYS), TEXTS | SCALARS.map(repr) | VALUES.map(yaml.safe_dump))
def test_any_value_of_a_known_option(key: str, value: str) -> None:
    taken_or_refused([f"{key}={value}"], [])


@SHORT
@given(st.dictionaries(st.sampled_from([*(node.name for node in NODES), "seed"]) | SCALARS, VALUES, max_size=4))
def test_any_layer(layer: dict[Any, Any]) -> None:
    taken_or_refused([], [layer])


@SHORT
@given(st.sampled_from(KEYS), VALUES)
def test_any_python_value_of_a_known_option(key: str, value: Any) -> None:
    stage, name = key.split(".")
    taken_or_refused([], [{stage: {name: value}}])


@SHORT
@given(
    st.binary(max_size=200)
    | TEXTS.map(lambda text: text.encode(errors="surrogatepass"))
    | VALUES.map(yaml.safe_dump).map(str.encode)
)
def test_any_preset_file(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "mine.yaml")
        path.write_bytes(content)
        taken_or_refused([], [], str(path))


@SHORT
@given(TEXTS)
def test_any_preset_name(name: str) -> None:
    taken_or_refused([], [], name)
