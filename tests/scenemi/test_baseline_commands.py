"""`scenemi train --method` and `scenemi evaluate` on what it writes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from scenemi_cases import scenemi, walk_archive

from scenemi.training import loop, pool


def test_a_baseline_is_trained_resumed_and_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (loop, pool):
        monkeypatch.setattr(module, "SHARD_WINDOWS", 16)
    archive, config, out = walk_archive(tmp_path / "clips.npz", 150), tmp_path / "run.json", tmp_path / "run"
    small = {"model": "tiny", "batch": 2, "parts": 1, "bodies": 1, "bends": 0, "workers": 0, "pool_windows": 16}
    config.write_text(json.dumps(small))
    words = ("train", "--motion", archive, "--config", config, "--out", out, "--minutes", "0.01", "--device", "cpu")
    for _ in range(2):
        done = scenemi(*words, "--method", "condmdi")
        assert done.code == 0, done.err
    done = scenemi(*words)
    assert done.code == 3, "another method does not go on from it"
    assert "trained with other model" in done.err
    done = scenemi(*words, "--method", "gan")
    assert done.code == 2
    assert "want mdm" in done.err
    found = tmp_path / "details.json"
    done = scenemi(
        "evaluate", "--clips", archive, "--no-scenes", "--steps", "2", "--device", "cpu", "--weights",
        out / "weights.safetensors", "--details", found,
    )  # fmt: skip
    assert done.code == 0, done.err
    assert json.loads(found.read_text())["prior_name"] == "condmdi"
