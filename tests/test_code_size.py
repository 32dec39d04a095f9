"""What `tools/code_size.py` counts and the design forbids."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
TOOLS = REPOSITORY / "tools"


def test_nothing_imports_in_a_circle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))
    import code_size

    size = code_size.measure()
    assert size.file_circles == []
    assert size.package_circles == []


def test_a_circle_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Imports inside functions count: they are how circles hide."""
    monkeypatch.syspath_prepend(str(TOOLS))
    import code_size

    folder = tmp_path / "video2anim"
    folder.mkdir()
    (folder / "a.py").write_text("import video2anim.b\n")
    (folder / "b.py").write_text("def f():\n    from video2anim.a import g\n")
    found = code_size.import_graph(code_size.modules(tmp_path))
    assert code_size.circles(found) == [["video2anim.a", "video2anim.b"]]


def test_tests_that_are_left_out_of_make_fast_exist() -> None:
    listed = (REPOSITORY / "tests" / "slow_tests.txt").read_text(encoding="utf-8").splitlines()
    names = [line.split("::") for line in listed if not line.startswith("#")]
    assert [
        f"{path}::{name}"
        for path, *_, name in names
        if not re.search(rf"def {name}\(", (REPOSITORY / path).read_text(encoding="utf-8"))
    ] == []
