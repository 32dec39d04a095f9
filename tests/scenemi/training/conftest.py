"""Four procedural clips on one body, and a pool of their windows."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from small_run import CONFIG, PLAIN, shrink, write_procedural

from scenemi.data.windows import MotionSet
from scenemi.features import Statistics
from scenemi.training import loop
from scenemi.training.batches import PoolBatches, statistics_of
from scenemi.training.pool import Shard, grow_pool, open_pool


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink(monkeypatch)


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four procedural clips."""
    return write_procedural(tmp_path_factory.mktemp("acted") / "acted.npz", ("walk", "sit", "reach", "pick_up"))


@pytest.fixture(scope="session")
def motions(archive: Path) -> MotionSet:
    return MotionSet.build([archive], None, None, bodies=1, config=PLAIN)


@pytest.fixture(scope="session")
def pool_folder(motions: MotionSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pool of `CONFIG`."""
    folder = tmp_path_factory.mktemp("pool")
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        grow_pool(folder, motions, CONFIG.pool_windows, seed=CONFIG.seed)
    return folder


@pytest.fixture
def run_folder(pool_folder: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Makes folders in which a run finds its pool."""

    def folder(name: str) -> Path:
        shutil.copytree(pool_folder, tmp_path / name / loop.POOL)
        return tmp_path / name

    return folder


@pytest.fixture(scope="session")
def shards(pool_folder: Path) -> list[Shard]:
    return open_pool(pool_folder)


@pytest.fixture(scope="session")
def data(shards: list[Shard]) -> PoolBatches:
    return PoolBatches(shards, CONFIG)


@pytest.fixture(scope="session")
def statistics(shards: list[Shard], motions: MotionSet) -> Statistics:
    return statistics_of(shards, [motions.body(0)])
