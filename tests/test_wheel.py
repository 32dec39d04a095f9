"""The wheel holds what it should, and works away from the checkout."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from video2anim.cli.compose import pipeline_nodes

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCES = ("video2anim", "scenemi", "stages", "configs", "pyproject.toml", "README.md", "LICENSE", "NOTICE")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that nothing is left in the checkout."""
    work = tmp_path_factory.mktemp("wheel")
    (work / "source").mkdir()
    for name in SOURCES:
        path = REPOSITORY / name
        assert path.exists(), f"{name} is missing; the wheel needs it"
        if path.is_dir():
            shutil.copytree(path, work / "source" / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(path, work / "source" / name)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(work), str(work / "source")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(work.glob("*.whl"))


def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_all_modules_and_data_are_in(wheel: Path) -> None:
    expected = {
        path.relative_to(REPOSITORY).as_posix()
        for package in ("video2anim", "scenemi", "stages")
        for path in (REPOSITORY / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert expected <= names(wheel)
    assert {"video2anim/py.typed", "scenemi/py.typed", "stages/py.typed"} <= expected
    assert any(name.startswith("video2anim/export/templates/") for name in expected)
    presets = {
        f"video2anim/configs/presets/{path.name}" for path in (REPOSITORY / "configs" / "presets").glob("*.yaml")
    }
    assert presets
    assert presets <= names(wheel)
    runs = {f"scenemi/configs/{path.name}" for path in (REPOSITORY / "configs" / "scenemi").glob("*.json")}
    assert runs
    assert runs <= names(wheel)


def test_nothing_else_is_in(wheel: Path) -> None:
    tops = {name.split("/")[0] for name in names(wheel)}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"video2anim", "scenemi", "stages"}
    wrong = (".mp4", ".tflite", ".pkl", ".pyc", ".ipynb")
    assert not [name for name in names(wheel) if name.endswith(wrong) or "test" in name.split("/")[-1]]
    assert wheel.stat().st_size < 95e6, "package indexes refuse files over 100 MB"


def test_weights_in_it_may_be_used_for_anything(wheel: Path, tmp_path: Path) -> None:
    """The wheel says Apache-2.0: weights trained on what forbids commercial use are not in it."""
    from scenemi.data.sources import is_free, license_of
    from scenemi.model.weights import load_weights

    weights = [name for name in names(wheel) if re.fullmatch(r"scenemi/weights/[^/]+\.safetensors", name)]
    assert weights == ["scenemi/weights/small.safetensors"]
    with zipfile.ZipFile(wheel) as archive:
        card = load_weights(archive.extract(weights[0], tmp_path)).card
    assert card["sources"]
    assert all(is_free(card.get("licenses", {}).get(source, license_of(source))) for source in card["sources"])


def test_metadata(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        info = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        text = archive.read(info).decode()
        scripts = archive.read(info.replace("METADATA", "entry_points.txt")).decode()
    assert "License-Expression: Apache-2.0" in text
    assert "Requires-Python: <3.14,>=3.11" in text
    assert "video2anim = video2anim.cli.main:run" in scripts
    required = [line for line in text.splitlines() if line.startswith("Requires-Dist:") and "extra" not in line]
    assert any("open3d" in line for line in required), "the window of `view` works without another install"


def test_installed_wheel_works_elsewhere(wheel: Path, tmp_path: Path) -> None:
    target = tmp_path / "site"
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--target",
        str(target),
        str(wheel),
    ]
    done = subprocess.run(install, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    environment = os.environ | {"PYTHONPATH": str(target)}

    def run(*words: str) -> str:
        answer = subprocess.run(
            [sys.executable, *words],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert answer.returncode == 0, answer.stderr
        return answer.stdout

    assert "Exit codes: 0 success" in " ".join(run("-m", "video2anim.cli.main", "--help").split())
    probe = (
        "from video2anim.pipeline.config import preset_names, presets_dir; import stages, scenemi\n"
        "from video2anim.cli.compose import pipeline_nodes\n"
        "print(presets_dir()); print(*preset_names()); print(len(pipeline_nodes()), stages.__file__)"
    )
    where, presets, nodes = run("-c", probe).splitlines()
    assert where == str(target / "video2anim" / "configs" / "presets")
    assert "embedded" in presets.split()
    assert nodes == f"{len(pipeline_nodes())} {target / 'stages' / '__init__.py'}"
