"""Four acted clips on one body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_run import CONFIG, PLAIN

from scenemi.data.container import write_archive
from scenemi.data.windows import MotionSet
from scenemi.features import Statistics
from scenemi.training.batches import statistics_of
from video2anim.synth.acting import act, to_source_clip


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four acted clips."""
    from video2anim.body.anny_body import ADULT, shaped_body
    from video2anim.types import BodyShape

    body = shaped_body(BodyShape("anny", dict(ADULT)))
    clips = [
        to_source_clip(act(kind, body, np.random.default_rng(i), duration_s=(4.5, 5.5)), body, f"{kind}_{i}")
        for i, kind in enumerate(("walk", "sit", "reach", "pick_up"))
    ]
    path = tmp_path_factory.mktemp("acted") / "acted.npz"
    write_archive(path, clips)
    return path


@pytest.fixture(scope="session")
def motions(archive: Path) -> MotionSet:
    return MotionSet.build([archive], None, None, bodies=1, config=PLAIN)


@pytest.fixture(scope="session")
def statistics(motions: MotionSet) -> Statistics:
    return statistics_of(motions, CONFIG.seed)
