"""Fixtures every test may use."""

from __future__ import annotations

from pathlib import Path

import pytest
from jaxtyping import install_import_hook
from runtime_types import CHECKED

install_import_hook(CHECKED, "runtime_types.checked")  # before anything of ours is imported

from command import video2anim  # noqa: E402

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_media() -> Path:
    """Test media beside the checkout: real clips, references and broken inputs."""
    media = REPOSITORY.parent / "shared" / "media"
    if not media.is_dir():
        pytest.skip(f"test media not found at {media}")
    return media


@pytest.fixture(scope="session")
def bench_clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first four clips of preset `bench` at 320 x 240, walking from the gait model."""
    out = tmp_path_factory.mktemp("synth") / "set"
    words = ("synth", "--preset", "bench", "--count", "4", "--size", "320x240", "--longest", "5", "--out", out)
    done = video2anim(*words, "--workers", "2")
    assert done.code == 0, done.err
    return out
