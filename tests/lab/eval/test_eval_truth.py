"""Reading truth folders, and refusing what is none."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tiny_truth import BOX_ID, FLOOR_ID, FRAMES, MAP, STRIDE, TABLE_ID, Tiny, write_scene, write_truth

from video2anim.errors import InputError
from video2anim.lab.eval.evaluate import evaluate
from video2anim.lab.eval.truth import read_truth


def test_truth_as_written(truth_dir: Path, tiny: Tiny) -> None:
    truth = read_truth(truth_dir)
    assert truth.name == "clip"
    assert [person.person_id for person in truth.people] == [0]
    np.testing.assert_array_equal(truth.main.joints_world_m, tiny.people[0].joints_world_m)
    assert truth.label_frame_index.tolist() == list(range(0, FRAMES, STRIDE))
    assert truth.depth_mm.shape == (FRAMES // STRIDE, MAP[1], MAP[0])
    depth, instance = tiny.maps(None)
    np.testing.assert_allclose(truth.background_depth_m, depth, atol=6e-4)
    np.testing.assert_array_equal(truth.floor_mask, instance == FLOOR_ID)
    assert truth.is_static
    assert truth.duration_s == pytest.approx(FRAMES / 30)
    assert set(truth.amodal) == {TABLE_ID, BOX_ID}
    assert truth.person_pixels.any(axis=(1, 2)).all()


def test_furniture_counts_from_its_visible_pixels(truth_dir: Path) -> None:
    truth = read_truth(truth_dir)
    seen = {item.object_id: item.visible_px for item in truth.objects}
    # Maps have a quarter of the clip's width and height.
    assert [i.object_id for i in truth.furniture(16 * seen[TABLE_ID])] == [TABLE_ID]
    assert {i.object_id for i in truth.furniture(16 * seen[BOX_ID])} == {TABLE_ID, BOX_ID}
    assert truth.furniture(1e9) == ()


def test_carried_objects_and_clutter_do_not_count(tmp_path: Path, truth_dir: Path) -> None:
    folder = tmp_path / "clip"
    shutil.copytree(truth_dir, folder)
    meta = json.loads((folder / "meta.json").read_text())
    for entry in meta["objects"]:
        entry["is_moving"] = entry["object_id"] == TABLE_ID
        entry["is_furniture"] &= entry["object_id"] != BOX_ID
    (folder / "meta.json").write_text(json.dumps(meta))
    assert read_truth(folder).furniture(1) == ()


def test_two_persons_in_the_order_of_their_boxes(tmp_path: Path, two: Tiny) -> None:
    truth = read_truth(write_truth(tmp_path / "clip", two))
    assert [person.person_id for person in truth.people] == [0, 1]
    np.testing.assert_array_equal(truth.people[1].joints_world_m, two.people[1].joints_world_m)
    assert truth.person_box_px.shape == (2, FRAMES, 4)


def test_not_a_scene_folder(tmp_path: Path, truth_dir: Path) -> None:
    with pytest.raises(InputError, match=r"found no run\.json"):
        evaluate(tmp_path, truth_dir)


def test_scene_folder_without_a_finished_stage(tmp_path: Path, truth_dir: Path, scene_dir: Path) -> None:
    (tmp_path / "run.json").write_text((scene_dir / "run.json").read_text())
    with pytest.raises(InputError, match="at least its first stage, but stage ingest has not run"):
        evaluate(tmp_path, truth_dir)


def test_truth_of_another_clip_by_duration(tmp_path: Path, truth_dir: Path, scene_dir: Path) -> None:
    folder = tmp_path / "clip"
    shutil.copytree(truth_dir, folder)
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"fps": 24}))
    with pytest.raises(InputError, match=r"truth of another clip: duration is 1\.33 s in .* and 1\.67 s") as caught:
        evaluate(scene_dir, folder)
    assert caught.value.exit_code == 3


def test_truth_of_another_clip_by_picture(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    from dataclasses import replace

    from video2anim.types import VideoClip

    upright = write_scene(tmp_path, tiny, edits={VideoClip: lambda clip: replace(clip, width_px=288, height_px=384)})
    with pytest.raises(InputError, match="truth of another clip: width / height"):
        evaluate(upright, truth_dir)


def test_missing_files_of_the_truth(tmp_path: Path, truth_dir: Path, scene_dir: Path) -> None:
    folder = tmp_path / "clip"
    shutil.copytree(truth_dir, folder)
    (folder / "plate.png").unlink()
    found = evaluate(scene_dir, folder)
    background = next(group for group in found.groups if group.key == "background")
    assert background.rows[0].values == (None,)
    assert "plate.png" in background.rows[0].reasons[0]
    (folder / "objects" / f"{TABLE_ID}.glb").unlink()
    with pytest.raises(InputError, match=rf"{TABLE_ID}\.glb"):
        evaluate(scene_dir, folder)
