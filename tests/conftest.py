"""Fixtures every test may use."""

from __future__ import annotations

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_media() -> Path:
    """Test media beside the checkout: real clips, references and broken inputs."""
    media = REPOSITORY.parent / "shared" / "media"
    if not media.is_dir():
        pytest.skip(f"test media not found at {media}")
    return media
