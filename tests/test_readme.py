"""What the README tells people to type works; what README and docs name exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from test_public_api import commands

from video2anim.cli.compose import pipeline_nodes
from video2anim.pipeline.options import options_of

REPOSITORY = Path(__file__).resolve().parents[1]
README = REPOSITORY / "README.md"
MAX_LINES = 150
PAGES = (README, *sorted((REPOSITORY / "docs").glob("*.md")))
FOLDERS = ("video2anim", "scenemi", "stages", "configs", "tests", "training", "benchmarks", "tools")


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


def anchors(page: Path) -> set[str]:
    """Names by which a page's headings are linked."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_linked_files_and_headings_exist(page: Path) -> None:
    for target in re.findall(r'(?:\]\(|src=")([^)\s"]+)', page.read_text()):
        if "://" not in target:
            name, _, heading = target.partition("#")
            linked = page.parent / name if name else page
            assert linked.exists(), target
            assert not heading or heading in anchors(linked), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_and_modules_named_exist(page: Path) -> None:
    options = {f"{node.name}.{option}" for node in pipeline_nodes() for option in options_of(node.config_type)}
    stages = "|".join(node.name for node in pipeline_nodes())
    for code in re.findall(r"`([^`\n]+)`|^    (.*)$", page.read_text(), re.MULTILINE):
        text = "".join(code)
        for option in re.findall(rf"(?<![\w./-])(?:{stages})\.[a-z][a-z_]+\b(?![\w./-])", text):
            assert option in options or option.endswith((".md", ".json", ".npz", ".glb", ".usdc")), option
        for path in re.findall(rf"(?<![\w./-])(?:{'|'.join(FOLDERS)})/[\w/]+\.py\b", text):
            assert (REPOSITORY / path).is_file(), path


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_the_table_of_stages_lists_all_in_order(name: str) -> None:
    table = (REPOSITORY / name).read_text().split("| stage | takes", 1)[1].split("\n\n", 1)[0]
    assert re.findall(r"^\| (\w+) \|", table, re.MULTILINE) == [node.name for node in pipeline_nodes()]


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_folders_of_stages_are_named_without_number(page: Path) -> None:
    """Numbers shift when a stage is added: `stages/*_refine`."""
    names = "|".join(node.name for node in pipeline_nodes())
    assert re.findall(rf"\b\d\d_(?:{names})\b", page.read_text()) == []


def test_make_targets_exist() -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    for line in code_lines():
        if line.startswith("make "):
            assert re.search(rf"^{re.escape(line.split()[1])}:", makefile, re.MULTILINE), line
