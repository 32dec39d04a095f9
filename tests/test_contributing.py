"""The two examples of CONTRIBUTING.md do what the page says, with its code as it stands there."""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from command import video2anim

from video2anim import types
from video2anim.cli import compose
from video2anim.networks import table
from video2anim.pipeline.scene_folder import read_record

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = (REPOSITORY / "CONTRIBUTING.md").read_text()


def code_by_file() -> dict[str, str]:
    """Code block of each numbered step by the first file that the step names."""
    found = {}
    for step in re.split(r"^\d+\. ", PAGE, flags=re.MULTILINE):
        if block := re.search(r"^ +```python\n(.*?)^ +```", step, re.MULTILINE | re.DOTALL):
            named = re.search(r"`([\w/]+\.py)`", step)
            assert named, step
            found[named[1]] = textwrap.dedent(block[1])
    return found


CODE = code_by_file()


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Import a file of the page as if it lay in the repository."""

    def go(path: str) -> ModuleType:
        name = Path(path).stem if path.startswith("tests/") else path.removesuffix(".py").replace("/", ".")
        module = ModuleType(name)
        monkeypatch.setitem(sys.modules, name, module)
        exec(compile(CODE[path], f"CONTRIBUTING.md, {path}", "exec"), module.__dict__)
        return module

    return go


def test_the_stage(load: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    kind = load("video2anim/types/sharpness.py").FrameSharpness
    monkeypatch.setattr(types, "FrameSharpness", kind, raising=False)
    stage = load("stages/sharpness.py")
    load("tests/stages/test_sharpness.py").test_the_blurred_frame_is_found(tmp_path)
    ingest, *others = compose.MODULES
    monkeypatch.setattr(compose, "MODULES", (ingest, stage, *others))
    words = ("--out", tmp_path / "scene", "--until", "sharpness")
    answer = video2anim("run", tmp_path / "in.mp4", *words)
    assert answer.states == {"ingest": "ran", "sharpness": "ran"}, answer.err
    assert "sharp frames 0.9 ratio" in answer.out
    assert "warning sharpness: 1 of 10 frames are blurred" in answer.err
    shown = video2anim("show", tmp_path / "scene", "sharpness").out
    assert "1 of 10 frames are blurred" in shown
    assert "sharp frames: 0.9 ratio" in shown
    monkeypatch.setattr(compose, "MODULES", (ingest, *others))
    again = video2anim("run", tmp_path / "in.mp4", "--out", tmp_path / "scene", "--until", "ingest", "--from", "ingest")
    assert again.states == {"ingest": "ran"}, "a version without the stage goes on with the folder"
    assert [row.stage for row in read_record(tmp_path / "scene").stages] == ["ingest", "sharpness"], "and keeps its row"


def test_the_provider(load: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    load("video2anim/networks/my_depth.py")
    row = eval(CODE["video2anim/networks/table.py"], vars(table))
    monkeypatch.setattr(table, "MODELS", (*table.MODELS, row))
    monkeypatch.syspath_prepend(str(REPOSITORY / "tests" / "networks"))
    load("tests/networks/test_my_depth.py").test_depth_is_that_of_the_network(tmp_path)
    assert re.search(r"my-depth .* MIT ", video2anim("models", "list").out)
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((24, 32, 3), 51, np.uint8))
    (tmp_path / "bad.onnx").write_bytes(b"no network")
    for weights, code in (("tiny", 0), ("bad", 4), ("absent", 4)):
        model = f"my-depth@{tmp_path / weights}.onnx"
        out = tmp_path / f"{weights}.npz"
        answer = video2anim("models", "run", "depth", tmp_path / "photo.png", "--model", model, "--out", out)
        assert (answer.code, len(answer.errors), out.is_file()) == (code, int(code > 0), code == 0), answer


def test_files_and_tests_that_the_page_names_exist() -> None:
    sources = "".join(path.read_text() for path in (REPOSITORY / "tests").rglob("test_*.py"))
    for code in re.findall(r"`([^`\n]+)`", PAGE):
        for name in re.findall(r"\btest_\w+\b(?!\.py)", code):
            assert f"def {name}(" in sources, name
        for path in re.findall(r"\b(?:video2anim|stages|tests|tools|docs)/[\w/]+\.\w+\b", code):
            assert path in CODE or (REPOSITORY / path).is_file(), path
