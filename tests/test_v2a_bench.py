"""A small part of V2A-Bench: clips are made, the pipeline runs on one, and its result is compared with the truth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command import video2anim

pytestmark = pytest.mark.slow


def test_pipeline_on_a_synthetic_clip(bench_clips: Path, tmp_path: Path) -> None:
    name = "00_walk"
    scene_dir, report = tmp_path / "results" / name, tmp_path / "set.json"
    answer = video2anim("run", bench_clips / name / "video.mp4", "--out", scene_dir)
    assert answer.code == 0, answer.err
    words = (
        "eval-set",
        tmp_path / "results",
        "--truth",
        bench_clips,
        "--json",
        report,
        "--html",
        tmp_path / "set.html",
    )
    answer = video2anim(*words)
    assert answer.code == 0, answer.err
    found = json.loads(report.read_text())
    assert found["clips"] == [name]
    assert [clip for clip, _ in found["failures"]] == ["01_sit", "02_step_up", "03_pick_up"]
    groups = {group["key"]: {row["key"]: row for row in group["rows"]} for group in found["groups"]}

    def mean(group: str, key: str, column: int = -1) -> float:
        return groups[group][key]["statistics"][column]["mean"]

    assert mean("track", "main_recall") > 0.9
    assert mean("track", "id_switches") == 0
    assert mean("camera", "gravity_error") < 10
    for column in (0, 1, 2):
        assert mean("motion", "pa_mpjpe", column) < 0.12
        assert mean("motion", "mpjpe", column) < 0.2
    assert mean("motion", "contact_f1") > 0.5
    for column in (0, -1):
        assert 0.3 < mean("motion", "jerk", column) / groups["motion"]["jerk"]["truth_mean"] < 2
    assert mean("background", "mask_iou") > 0.6
    assert (tmp_path / "set.html").stat().st_size > 10_000
