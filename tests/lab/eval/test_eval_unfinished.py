"""Scene folders with missing or damaged stages, and what an evaluation is made of."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
from reading import row, value
from tiny_truth import FRAMES, STAGES, Tiny, write_manifest, write_scene

from video2anim.artifacts.codec import read_value, write_value
from video2anim.cli.compose import pipeline_nodes
from video2anim.lab.eval.evaluate import evaluate
from video2anim.lab.eval.results import STAGE_OF
from video2anim.types import CameraEstimate, InstanceMasks, VideoClip
from video2anim.types.quality import Quality


@pytest.mark.parametrize("kind", [kind for kind in STAGES if kind is not VideoClip])
def test_a_missing_stage_gives_reasons_not_errors(tmp_path: Path, truth_dir: Path, tiny: Tiny, kind: type) -> None:
    found = evaluate(write_scene(tmp_path / "scene", tiny, leave_out=(kind,)), truth_dir)
    stage = STAGE_OF[kind]
    assert f"stage {stage} has not run" in found.notes
    lacking = [
        r for g in found.groups for r in g.rows for v, why in zip(r.values, r.reasons, strict=True)
        if v is None and f"stage {stage} has not run" in why
    ]  # fmt: skip
    assert lacking, f"nothing says that {stage} is missing"


def test_only_the_first_stage(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    others = tuple(kind for kind in STAGES if kind is not VideoClip)
    found = evaluate(write_scene(tmp_path / "scene", tiny, leave_out=others), truth_dir)
    assert value(found, "ingest", "frames") == FRAMES
    assert all(v is None for g in found.groups if g.key != "ingest" for r in g.rows for v in r.values)
    assert all(why for g in found.groups if g.key != "ingest" for r in g.rows for why in r.reasons)


def test_a_damaged_stage_is_named(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    scene = write_scene(tmp_path / "scene", tiny)
    (scene / "stages" / STAGES[CameraEstimate] / "value.json").write_text("{")
    found = evaluate(scene, truth_dir)
    assert any("stage camera is unreadable" in note for note in found.notes)
    assert value(found, "motion", "mpjpe") == pytest.approx(0, abs=1e-9)


def test_old_bodies_are_not_judged_with_a_new_camera(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """As after `video2anim stage camera`: what was made from the old camera, and what from that, is stale."""
    scene = write_scene(tmp_path / "scene", tiny)
    folder = scene / "stages" / STAGES[CameraEstimate]
    camera = read_value(CameraEstimate, folder)
    write_value(dataclasses.replace(camera, focal_sigma_ratio=0.3), folder)
    write_manifest(scene, CameraEstimate)
    found = evaluate(scene, truth_dir)
    assert value(found, "camera", "focal_error") == pytest.approx(0, abs=1e-9)
    for stage in ("humans", "background", "metric", "refine"):
        note = f"stage {stage} is stale, stage camera changed after it; run the pipeline again"
        assert note in found.notes
    assert row(found, "motion", "mpjpe").values == (None, None, None)
    assert not any("track" in note for note in found.notes), "no camera went into it"


def test_a_mask_edited_by_hand_makes_what_follows_stale(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    scene = write_scene(tmp_path / "scene", tiny)
    for path in (scene / "stages" / STAGES[InstanceMasks]).glob("*.png"):
        path.write_bytes(path.read_bytes() + b" ")
    notes = evaluate(scene, truth_dir).notes
    stale = {STAGE_OF[kind] for kind in STAGE_OF if any(f"stage {STAGE_OF[kind]} is stale" in note for note in notes)}
    assert {"metric", "complete", "reconstruct", "place", "scene", "keyframes", "refine"} <= stale
    assert not {"segment", "humans", "camera", "depth"} & stale


def test_every_value_is_plain(scene_dir: Path, truth_dir: Path) -> None:
    """No numpy in an evaluation, and NaN only as the value of a `Quality`."""

    def check(item: Any) -> None:
        if isinstance(item, Quality):
            assert type(item.value) is float
        elif dataclasses.is_dataclass(item):
            for field in dataclasses.fields(item):
                check(getattr(item, field.name))
        elif isinstance(item, dict):
            for inner in item.values():
                check(inner)
        elif isinstance(item, tuple):
            for inner in item:
                check(inner)
        else:
            assert type(item) in (str, int, float, type(None)), (type(item), item)
            assert not isinstance(item, float) or math.isfinite(item)

    check(evaluate(scene_dir, truth_dir))


def test_stages_are_those_of_the_pipeline() -> None:
    made = {node.output: node.name for node in pipeline_nodes()}
    assert {kind: made[kind] for kind in STAGE_OF} == STAGE_OF
