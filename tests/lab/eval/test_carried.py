"""Paths of objects that somebody moves: reading them from the truth, and the rows that judge estimated ones."""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reading import row, value
from tiny_truth import BOX_ID, FRAMES, TABLE_ID, TURN, Tiny, write_scene

from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.lab.eval.carried_rows import MovedObject, MovedObjects, carried_numbers
from video2anim.lab.eval.evaluate import evaluate
from video2anim.lab.eval.model import Evaluation
from video2anim.lab.eval.truth import read_truth
from video2anim.types import Hold, ObjectPath, PlacedObject, RefinedMotion

GRASP, RELEASE = 10, 30
"""First and last frame held; the box moves from the one to the other."""
BOX = 12
"""Number of the box in the estimate."""


def true_path() -> np.ndarray:
    """The box goes 1 m along +x and turns a little on the way."""
    share = np.clip((np.arange(FRAMES) - GRASP) / (RELEASE - GRASP), 0, 1)
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, :3, :3] = matrix_from_axis_angle(np.outer(0.5 * share, [0.0, 1.0, 0.0]))
    T[:, :3, 3] = np.array([-1.3, 0.0, -3.0]) + np.outer(share, [1.0, 0.0, 0.0])
    return T


def moving_truth(folder: Path, truth_dir: Path, *, old: bool = False, T: np.ndarray | None = None) -> Path:
    """The tiny clip in which the box is moved."""
    shutil.copytree(truth_dir, folder)
    meta = json.loads((folder / "meta.json").read_text())
    for entry in meta["objects"]:
        entry["is_moving"] = entry["object_id"] == BOX_ID
    (folder / "meta.json").write_text(json.dumps(meta))
    if old:
        return folder
    with np.load(folder / "truth.npz", allow_pickle=False) as archive:
        arrays = dict(archive)
    held = (np.arange(FRAMES) >= GRASP) & (np.arange(FRAMES) <= RELEASE)
    arrays |= {
        "moving_object_id": np.array([BOX_ID]), "T_world_moving": (true_path() if T is None else T)[None],
        "moving_held": held[None], "moving_hands": np.array([[True, False]]),
    }  # fmt: skip
    np.savez_compressed(folder / "truth.npz", allow_pickle=False, **arrays)
    return folder


def moved(obj: PlacedObject, T_true: np.ndarray, holds: tuple[Hold, ...] = ()) -> PlacedObject:
    """The estimated object with a path that is told in the true world."""
    return replace(obj, path=(ObjectPath(TURN @ T_true, holds),))


def judged(
    tmp_path: Path, tiny: Tiny, truth: Path, change: Callable[[PlacedObject], PlacedObject]
) -> Evaluation:  # fmt: skip
    """The evaluation of a scene whose objects are changed."""

    def edit(refined: RefinedMotion) -> RefinedMotion:
        objects = tuple(change(obj) for obj in refined.scene.objects)
        return replace(refined, scene=replace(refined.scene, objects=objects))

    return evaluate(write_scene(tmp_path / "scene", tiny, edits={RefinedMotion: edit}), truth)


def test_poses_are_read_as_written(tmp_path: Path, truth_dir: Path) -> None:
    truth = read_truth(moving_truth(tmp_path / "clip", truth_dir))
    objects = {item.object_id: item for item in truth.objects}
    box = objects[BOX_ID]
    assert box.T_world_object_frames is not None
    assert box.held is not None
    np.testing.assert_array_equal(box.T_world_object_frames, true_path())
    assert np.flatnonzero(box.held)[[0, -1]].tolist() == [GRASP, RELEASE]
    assert box.hands == (True, False)
    assert objects[TABLE_ID].T_world_object_frames is None
    assert objects[TABLE_ID].held is None


def test_older_truth_has_no_poses_and_no_numbers(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    folder = moving_truth(tmp_path / "clip", truth_dir, old=True)
    assert all(item.T_world_object_frames is None for item in read_truth(folder).objects)
    found = row(judged(tmp_path, tiny, folder, lambda obj: obj), "carried", "carried_found")
    assert found.values == (None,)
    assert "make the clip again" in found.reasons[0]


def test_poses_that_are_none_are_refused(tmp_path: Path, truth_dir: Path) -> None:
    with pytest.raises(InputError, match="T_world_moving"):
        read_truth(moving_truth(tmp_path / "bent", truth_dir, T=1.1 * true_path()))
    with pytest.raises(InputError, match="T_world_moving"):
        read_truth(moving_truth(tmp_path / "short", truth_dir, T=true_path()[1:]))


def test_a_perfect_path_has_no_error(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    truth = moving_truth(tmp_path / "clip", truth_dir)
    found = judged(tmp_path, tiny, truth, lambda t: moved(t, true_path()) if t.object_id == BOX else t)
    assert value(found, "carried", "carried_found") == 1.0
    assert value(found, "carried", "carried_path_m") == pytest.approx(0.0, abs=1e-6)
    assert value(found, "carried", "carried_false") == 0.0


def test_error_counts_while_it_moves_only(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    T = true_path()
    T[GRASP : RELEASE + 1, :3, 3] += np.array([0.0, 0.2, 0.0])
    T[:GRASP, :3, 3] += np.array([0.0, 5.0, 0.0])
    truth = moving_truth(tmp_path / "clip", truth_dir)
    found = judged(tmp_path, tiny, truth, lambda t: moved(t, T) if t.object_id == BOX else t)
    assert value(found, "carried", "carried_path_m") == pytest.approx(0.2, abs=1e-6)


def test_the_center_is_that_of_the_box(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """An estimate of half the size whose origin is the same has its middle lower by a quarter of the height."""
    truth = moving_truth(tmp_path / "clip", truth_dir)
    found = judged(
        tmp_path, tiny, truth, lambda t: replace(moved(t, true_path()), scale=0.5) if t.object_id == BOX else t
    )
    assert value(found, "carried", "carried_path_m") == pytest.approx(0.25 * 0.9, abs=1e-6)


def test_nothing_found(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    truth = moving_truth(tmp_path / "clip", truth_dir)
    found = judged(tmp_path, tiny, truth, lambda obj: obj)
    assert value(found, "carried", "carried_found") == 0.0
    assert value(found, "carried", "carried_false") == 0.0
    assert row(found, "carried", "carried_path_m").values == (None,)


def test_paths_far_from_the_truth_are_false(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    """The table's path is 1.2 m off and belongs to nothing; the box's own stays matched."""
    far = true_path()
    far[:, :3, 3] += np.array([0.0, 0.0, 1.2])
    truth = moving_truth(tmp_path / "clip", truth_dir)
    both = judged(tmp_path, tiny, truth, lambda t: moved(t, true_path() if t.object_id == BOX else far))
    assert value(both, "carried", "carried_found") == 1.0
    assert value(both, "carried", "carried_path_m") == pytest.approx(0.0, abs=1e-6)
    assert value(both, "carried", "carried_false") == 1.0
    alone = judged(tmp_path / "far", tiny, truth, lambda t: t if t.object_id == BOX else moved(t, far))
    assert value(alone, "carried", "carried_found") == 0.0
    assert value(alone, "carried", "carried_false") == 1.0


def test_a_path_where_nothing_moves_is_false(tmp_path: Path, truth_dir: Path, tiny: Tiny) -> None:
    found = judged(tmp_path, tiny, truth_dir, lambda t: moved(t, true_path()) if t.object_id == BOX else t)
    assert value(found, "carried", "carried_false") == 1.0
    assert row(found, "carried", "carried_found").values == (None,)


def test_means_over_objects() -> None:
    near = MovedObject(1, "cup", 5, np.array([0.1, 0.3]), 2.0)
    lost = MovedObject(2, "box", None, np.zeros(0), np.nan)
    found = carried_numbers(MovedObjects((near, lost), 3))
    assert found == {"carried_found": 0.5, "carried_path_m": pytest.approx(0.2), "carried_false": 3.0}


def test_benchmark_rows(
    tmp_path: Path, truth_dir: Path, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[3] / "benchmarks"))
    script = importlib.import_module("carried")
    T = true_path()
    T[:, :3, 3] += np.array([0.0, 0.0, 0.1])
    holds = (Hold(1, "left hand", GRASP + 3, 20), Hold(1, "left hand", 21, RELEASE - 1))

    def edit(refined: RefinedMotion) -> RefinedMotion:
        objects = tuple(moved(t, T, holds) if t.object_id == BOX else t for t in refined.scene.objects)
        return replace(refined, scene=replace(refined.scene, objects=objects))

    truth = moving_truth(tmp_path / "clip", truth_dir)
    (one,) = script.of_clip(write_scene(tmp_path / "scene", tiny, edits={RefinedMotion: edit}), truth)
    assert (one.clip, one.label, one.found, one.false_paths) == ("clip", "box", True, 0)
    assert one.path_mean_m == pytest.approx(0.1)
    assert one.path_p95_m == pytest.approx(0.1)
    assert one.hold_error_frames == pytest.approx(2.0)
    assert one.wrist_mean_m is not None
    assert one.wrist_mean_m < 0.3
    lost = script.ClipRow("other", "cup", False, None, None, None, None, 2)
    mean = script.means([one, lost])
    assert mean["found"] == 0.5
    assert mean["path_mean_m"] == pytest.approx(0.1)
    assert mean["false_paths"] == 2
    assert "| other | cup | no | - | - | - | - | 2 |" in script.table([one, lost])
