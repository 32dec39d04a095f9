"""The three data sets in small files."""

from __future__ import annotations

from pathlib import Path

import pytest
from captured_files import GRID, VOXEL_M, WRITERS

from scenemi.data import trumans


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folder of each data set."""
    folders = {source: tmp_path_factory.mktemp(source) for source in WRITERS}
    for source, folder in folders.items():
        WRITERS[source](folder)
    return folders


@pytest.fixture(autouse=True)
def coarse_voxels(monkeypatch: pytest.MonkeyPatch) -> None:
    """TRUMANS at 5 cm: its own grids of 12 million voxels take seconds."""
    monkeypatch.setattr(trumans, "_VOXEL_M", VOXEL_M)
    monkeypatch.setattr(trumans, "_GRID", GRID)
