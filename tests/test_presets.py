"""Every shipped preset names options that exist and models the program has."""

from __future__ import annotations

from pathlib import Path

import pytest

from video2anim.cli.compose import pipeline_nodes, preset_models
from video2anim.networks import find_model
from video2anim.pipeline.config import load_preset, preset_names, presets_dir, resolve

REPOSITORY = Path(__file__).resolve().parents[1]


def test_the_shipped_presets() -> None:
    assert {"embedded", "standard"} <= set(preset_names())
    assert presets_dir() == REPOSITORY / "configs" / "presets"
    assert [path.name for path in presets_dir().iterdir()] == [path.name for path in presets_dir().glob("*.yaml")]


@pytest.mark.parametrize("name", preset_names())
def test_preset_resolves(name: str) -> None:
    data = load_preset(name)
    config = resolve(pipeline_nodes(), name, [(name, data)])
    for stage, options in data.items():
        for option, value in options.items():
            assert getattr(config.stages[stage], option) == value
    again = resolve(pipeline_nodes(), name, [("run.json", config.as_dict())])
    assert again == config
    assert all(find_model(model).license for model in preset_models(name))


def test_what_no_preset_names_is_as_in_the_default_preset() -> None:
    """So a preset of the user's own that names one option changes one option."""
    embedded = resolve(pipeline_nodes(), "embedded", [("embedded", load_preset("embedded"))])
    assert resolve(pipeline_nodes(), "embedded", []) == embedded


def test_default_needs_only_package_sources() -> None:
    """`embedded` works without a model hub."""
    for name in preset_models("embedded"):
        model = find_model(name)
        for part in (model, *(find_model(other) for other in model.requires)):
            assert part.source.text.startswith(("package:", "wheel:")), part.name
            assert part.license == "Apache-2.0"


def test_preset_file_of_the_users_own(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("refine:\n  object_across_ratio: 0.04\n")
    config = resolve(pipeline_nodes(), "mine", [("mine", load_preset(str(tmp_path / "mine.yaml")))])
    assert config.stages["refine"].object_across_ratio == 0.04
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert load_preset(str(tmp_path / "empty.yaml")) == {}
