"""A tiny clip with its truth, shared by the tests that only read it."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_truth import Tiny, walk, write_scene, write_truth

from video2anim.geometry.sdf import SdfGrid
from video2anim.lab.eval.true_scene import true_field
from video2anim.lab.eval.truth import Truth

_FIELDS: dict[Path, SdfGrid] = {}


@pytest.fixture(autouse=True)
def fields_once(monkeypatch: pytest.MonkeyPatch, truth_dir: Path) -> None:
    """The true distance field of the shared truth folder is built once; that of any other folder as ever."""

    def field(truth: Truth) -> SdfGrid:
        if truth.folder != truth_dir:
            return true_field(truth)
        if truth_dir not in _FIELDS:
            _FIELDS[truth_dir] = true_field(truth)
        return _FIELDS[truth_dir]

    monkeypatch.setattr("video2anim.lab.eval.evaluate.true_field", field)


@pytest.fixture(scope="session")
def tiny() -> Tiny:
    return Tiny()


@pytest.fixture(scope="session")
def truth_dir(tiny: Tiny, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Truth folder with one person. Read only."""
    return write_truth(tmp_path_factory.mktemp("truth") / "clip", tiny)


@pytest.fixture(scope="session")
def scene_dir(tiny: Tiny, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene folder without error. Read only."""
    return write_scene(tmp_path_factory.mktemp("scene") / "clip", tiny)


@pytest.fixture(scope="session")
def two() -> Tiny:
    """Two persons who walk behind each other."""
    return Tiny((walk(0), walk(1, x_m=0.2, z_m=-1.4, speed_m_s=0.2)))
