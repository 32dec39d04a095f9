"""Fixtures every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from filelock import FileLock
from jaxtyping import install_import_hook
from runtime_types import CHECKED, start_test

install_import_hook(CHECKED, "runtime_types.checked")  # before anything of ours is imported

from command import video2anim  # noqa: E402

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="leave out the tests of tests/slow_tests.txt")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files of tests of the whole pipeline come first, so that no worker is left alone with one at the end. With
    `--fast`: without the tests that take longer than a moment, by what they took in a whole run."""
    items.sort(key=lambda item: item.path.parent != REPOSITORY / "tests")
    if config.getoption("--fast"):
        slow = set((REPOSITORY / "tests" / "slow_tests.txt").read_text(encoding="utf-8").splitlines())
        left_out = [item for item in items if item.nodeid.split("[")[0] in slow]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item.nodeid.split("[")[0] not in slow]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Annotations are checked in every test, its fixtures included."""
    start_test()


@pytest.fixture(scope="session")
def shared_media() -> Path:
    """Test media beside the checkout: real clips, references and broken inputs."""
    media = REPOSITORY.parent / "shared" / "media"
    if not media.is_dir():
        pytest.skip(f"test media not found at {media}")
    return media


@pytest.fixture(scope="session")
def demo_video() -> Path:
    """The real clip of `video2anim demo`, fetched once from its package: also a clone without the media has it."""
    from video2anim.cli.results import demo_clip

    return demo_clip(print)


@pytest.fixture(scope="session")
def of_all_workers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the processes of pytest-xdist share."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def bench_clips(of_all_workers: Path) -> Path:
    """The first four clips of preset `bench` at 320 x 240, walking from the gait model; made by one worker."""
    out = of_all_workers / "bench_clips"
    words = ("synth", "--preset", "bench", "--count", "4", "--size", "320x240", "--longest", "5", "--out", out)
    with FileLock(f"{out}.lock"):
        done = video2anim(*words, "--workers", "2")
    assert done.code == 0, done.err
    return out
