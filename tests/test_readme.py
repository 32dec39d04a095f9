"""What the README tells people to type works."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from test_public_api import commands

REPOSITORY = Path(__file__).resolve().parents[1]
README = REPOSITORY / "README.md"
MAX_LINES = 150


def code_lines() -> list[str]:
    """Lines of code blocks, fenced or indented, without prompts."""
    if not README.is_file():
        return []
    lines, fenced = [], False
    for line in README.read_text().splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            lines.append(line.strip().removeprefix("$ "))
    return lines


def commands_told() -> list[str]:
    return [line for line in code_lines() if line.startswith("video2anim ")]


def test_readme_is_there_short_and_shows_a_command() -> None:
    assert README.is_file()
    assert len(README.read_text().splitlines()) <= MAX_LINES
    assert any(line.startswith("video2anim run ") for line in commands_told())
    assert any(line.startswith("make demo") for line in code_lines())


@pytest.mark.parametrize("line", commands_told())
def test_command_exists_with_its_options(line: str) -> None:
    """Optional parts in brackets are looked at as if written out."""
    words = shlex.split(re.sub(r"[\[\]]", " ", line), comments=True)[1:]
    known = commands()
    name = next((n for n in (" ".join(words[:2]), words[0]) if n in known), "")
    if name:
        words = words[len(name.split()) :]
    elif not words[0].startswith("--"):
        pytest.fail(f"no command {words[0]!r}")
    for word in words:
        if word.startswith("--"):
            assert word.split("=")[0] in known[name] | known[""] | {"--help"}, f"{name} has no option {word}"


def test_linked_files_exist() -> None:
    targets = re.findall(r"\]\(([^)#\s]+)", README.read_text()) + re.findall(r'src="([^"]+)"', README.read_text())
    for target in targets:
        assert "://" in target or (REPOSITORY / target).exists(), target


def test_make_targets_exist() -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    for line in code_lines():
        if line.startswith("make "):
            assert re.search(rf"^{re.escape(line.split()[1])}:", makefile, re.MULTILINE), line
