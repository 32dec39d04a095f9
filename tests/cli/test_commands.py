"""Commands that need no scene: help, version, models, and how settings reach the stages."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

import pytest
from command import command_line, video2anim
from test_public_api import COMMANDS

from video2anim import __version__
from video2anim.cli.compose import TableModels, pipeline_nodes
from video2anim.errors import UsageError
from video2anim.pipeline.config import resolve


@pytest.mark.parametrize("name", COMMANDS)
def test_help(name: str) -> None:
    answer = video2anim(*name.split(), "--help")
    assert answer.code == 0
    assert "Usage" in answer.out


def test_root_help_shows_commands_and_exit_codes() -> None:
    text = " ".join(video2anim("--help").out.split())
    for name in COMMANDS:
        assert name.split(" ")[0] in text
    assert "2 usage or configuration, 3 bad input, 4 model missing, 5 stage failed" in text


def test_version() -> None:
    assert video2anim("--version").out.strip() == f"video2anim {__version__}"


def test_models_list_shows_licenses_and_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIDEO2ANIM_CACHE", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "300")
    answer = video2anim("models", "list")
    assert answer.code == 0
    for word in ("blazepose-heavy", "moge-2-small", "Apache-2.0", "absent", "triposr", "CC-BY-4.0"):
        assert word in answer.out
    assert video2anim("models", "verify").code == 0, "what is absent is not damaged"
    assert list(tmp_path.iterdir()) == [], "looking fetches nothing"


def test_weights_in_the_key_follow_the_chosen_model() -> None:
    def digests(**options: str) -> dict[str, str]:
        config = resolve(pipeline_nodes(), "p", [("test", {"track": options})]).stages["track"]
        return TableModels().digests(("pose",), config)

    assert set(digests(model="blazepose-heavy")) == {"blazepose-heavy", "blazepose-detector"}
    with pytest.raises(UsageError, match="nopose"):
        digests(model="nopose")


def test_geometric_segmentation_needs_no_weights_of_a_network() -> None:
    node = next(node for node in pipeline_nodes() if node.name == "segment")
    layers = [("test", {"segment": {"provider": "geometric", "finder": "none"}})]
    config = resolve(pipeline_nodes(), "p", layers).stages["segment"]
    assert TableModels().digests(node.spec.models, config) == {}


@pytest.mark.parametrize(("redirect", "code"), [(">&-", 0), ("> /dev/full", 3)])
def test_output_that_cannot_be_written_is_no_traceback(redirect: str, code: int) -> None:
    command, environment = command_line("models", "list")
    line = f"{shlex.join(command)} {redirect}"
    done = subprocess.run(["sh", "-c", line], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 1
