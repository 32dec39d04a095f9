"""Clips with their scenes: people and objects in one world, each where it was."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from captured_files import FRAMES, TABLE, WALL, WRITERS, box_distance, room_distance, scan, walk, write_prox

from scenemi.data.prox import read_prox
from scenemi.data.readers import read_clips
from scenemi.data.retarget import retarget
from scenemi.data.scene_clips import fit_scene, read_scene_clips, scene_folders
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.voxel_sdf import scan_sdf, voxel_sdf
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError, UsageError
from video2anim.geometry.rotations import matrix_from_quaternion
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

TOLERANCE_M = {"trumans": 0.02, "gimo": 0.02, "prox": 0.02}
"""0.4 voxels of these tests, half a voxel of a scan and its corners, the corners of a coarse grid."""


@pytest.mark.parametrize("source", WRITERS)
def test_the_walk_is_where_it_was(source: str, written: dict[str, Path]) -> None:
    found = list(read_scene_clips(source, written[source]))
    assert {one.scene_name.split("_")[0]: one.part for one in found} == {
        "trumans": {"kitchen": "train", "study": "test"},
        "gimo": {"bedroom": "train", "office": "test"},
        "prox": {"N3Office": "train", "MPH16": "test"},
    }[source]
    for one in found:
        assert one.clip.source == source
        assert one.clip.floor_shift_m == 0
        np.testing.assert_allclose(one.clip.root_position_m, walk().root_position_m, atol=0.01)
        turned = matrix_from_quaternion(one.clip.rotation_wxyz)
        np.testing.assert_allclose(turned, matrix_from_quaternion(walk().rotation_wxyz), atol=1e-5)
    assert len(read_clips(written[source])) == len(found)


@pytest.mark.parametrize("source", WRITERS)
def test_wall_and_table_are_where_they_were(source: str, written: dict[str, Path]) -> None:
    solids = next(read_scene_clips(source, written[source])).solids()
    places_m = np.array([
        [0.0, 1.0, 2.0], [0.0, 0.5, 2.7], [0.2, 0.5, 0.0], [0.75, 1.1, 0.0], [0.0, 1.2, -0.9], [0.0, 0.03, 1.9],
        [0.55, 0.5, 0.0], [0.75, 0.76, 0.1], [0.0, 1.0, 3.04],
    ])  # fmt: skip
    exact_m = room_distance(places_m)
    assert (exact_m[-3:] < -0.03).all()
    np.testing.assert_allclose(solids.sample(places_m), exact_m, atol=TOLERANCE_M[source])


@pytest.mark.parametrize("source", WRITERS)
def test_the_person_meets_wall_table_and_floor_where_it_should(source: str, written: dict[str, Path]) -> None:
    found = next(read_scene_clips(source, written[source]))
    wrist = JOINT_INDEX["left_wrist"]
    joints_m = found.clip.smpl_joints_m()[[70, -1]]
    wall_m, table_m = box_distance(joints_m[1], WALL).min(), box_distance(joints_m[0, wrist], TABLE)
    tolerance_m = TOLERANCE_M[source] + 0.01
    assert found.solids().sample(joints_m[1]).min() == pytest.approx(wall_m, abs=tolerance_m)
    assert found.solids().sample(joints_m[0, wrist]) == pytest.approx(table_m, abs=tolerance_m)
    geometry = SceneGeometry.from_sdf(found.solids())
    _, gap_m = geometry.nearest_within(np.array([[0.2, 1.0, 0.0]]), 1.0)
    np.testing.assert_allclose(gap_m, [np.hypot(0.3, 0.2)], atol=tolerance_m)


def test_the_floor_is_found_at_any_height(tmp_path: Path) -> None:
    write_prox(tmp_path, floor_z_m=0.31, dim=64)
    found = next(read_scene_clips("prox", tmp_path))
    np.testing.assert_allclose(found.clip.root_position_m, walk().root_position_m, atol=0.02)
    assert found.solids().sample(np.array([[0.0, 1.0, 2.0]]))[0] == pytest.approx(1.0, abs=0.05)


def test_missing_and_failed_fits_cut_a_recording(written: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "prox"
    shutil.copytree(written["prox"], folder)
    results = folder / "PROXD" / "MPH16_00034_01" / "results"
    shutil.rmtree(next(results.glob("s001_frame_00040__*")))
    lost = next(results.glob("s001_frame_00100__*")) / "000.pkl"
    arrays = pickle.loads(lost.read_bytes())
    lost.write_bytes(pickle.dumps(arrays | {"transl": np.array([[4e5, 0.0, 1.0]], np.float32)}, protocol=4))
    pieces = [piece.clip for piece in read_prox(folder) if piece.scene_name == "MPH16"]
    assert [clip.name for clip in pieces] == [f"prox_MPH16_00034_01_{first}" for first in (1, 41, 101)]
    assert [len(clip.root_position_m) for clip in pieces] == [39, 59, FRAMES - 100]
    np.testing.assert_allclose(pieces[1].root_position_m, walk().root_position_m[40:99], atol=0.01)


def test_pickles_of_prox_run_nothing(written: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "prox"
    shutil.copytree(written["prox"], folder)
    path = next((folder / "PROXD" / "N3Office_00034_01" / "results").glob("s001_frame_00005__*")) / "000.pkl"
    path.write_bytes(b"cos\nsystem\n(S'touch " + str(tmp_path / "ran").encode() + b"'\ntR.")
    with pytest.raises(InputError, match=r"asks for os\.system .* nothing was run"):
        list(read_scene_clips("prox", folder))
    assert not (tmp_path / "ran").exists()
    path.write_bytes(pickle.dumps({"transl": np.zeros((1, 3))}))
    with pytest.raises(InputError, match="want a pickled table with global_orient, body_pose, transl"):
        list(read_prox(folder))


def spoiled_sdf(folder: Path) -> None:
    np.save(folder / "sdf" / "MPH16_sdf.npy", np.ones(7, np.float32))


def floorless_sdf(folder: Path) -> None:
    np.save(folder / "sdf" / "MPH16_sdf.npy", np.ones(96**3, np.float32))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: shutil.rmtree(folder / "PROXD"), "want PROXD"),
        (lambda folder: (folder / "cam2world" / "MPH16.json").unlink(), r"MPH16\.json: cannot read"),
        (lambda folder: (folder / "cam2world" / "MPH16.json").write_text("[1]"), "want a 4 x 4 matrix"),
        (spoiled_sdf, r"want dim\^3 distances"),
        (floorless_sdf, "no floor"),
    ],
)
def test_prox_of_another_layout_says_what_is_wrong(
    spoil: object, message: str, written: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "prox"
    shutil.copytree(written["prox"], folder)
    spoil(folder)  # pyright: ignore[reportCallIssue]
    with pytest.raises(InputError, match=message):
        list(read_scene_clips("prox", folder))


def test_a_scene_follows_its_motion_on_another_body(written: dict[str, Path]) -> None:
    """A taller person walks farther beside a larger table: in its own size nothing has moved."""
    found = next(read_scene_clips("trumans", written["trumans"]))
    tall = shaped_body(BodyShape("anny", {**ADULT, "height": 0.9}))
    motion = retarget(found.clip, tall)
    rows = np.arange(0, FRAMES, 7)
    fit = fit_scene(found.clip, tall, rows, motion.R_parent_joint[rows, 0], motion.translation_m[rows])
    assert fit.scale > 1.05
    assert abs(fit.lift_m) < 0.05
    joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, tall.rest_joints_m)
    hips = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]
    captured_m = found.clip.smpl_joints_m()[:, hips].mean(1)
    np.testing.assert_allclose(fit.scene_points(joints_m[:, hips].mean(1)), captured_m, atol=0.03)


def test_scans_turned_inside_out_are_turned_back() -> None:
    mesh = scan()
    front, back = (scan_sdf(np.asarray(mesh.vertices)[faces], 0.05, 0.1) for faces in (mesh.faces, mesh.faces[:, ::-1]))
    np.testing.assert_array_equal(front.sdf_m, back.sdf_m)
    assert front.sample(np.array([[0.0, 1.0, 3.07]]))[0] < 0


def test_a_bare_floor_is_no_scene() -> None:
    floor = np.zeros((20, 10, 20), bool)
    floor[:, :1] = True
    with pytest.raises(InputError, match="nothing stands on the floor"):
        voxel_sdf(floor, np.zeros(3), 0.05)


def test_sources_are_named_with_their_folder() -> None:
    assert scene_folders(["gimo=a/b", "prox=c=d"]) == (("gimo", Path("a/b")), ("prox", Path("c=d")))
    for word in ("gimo", "gimo=", "amass=x"):
        with pytest.raises(UsageError, match="want SOURCE=FOLDER"):
            scene_folders([word])
    with pytest.raises(UsageError, match="want one of"):
        next(read_scene_clips("amass", "x"))
