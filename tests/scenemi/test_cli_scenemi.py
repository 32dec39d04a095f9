"""The command line of scenemi: what it writes, and one line for every bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scenemi_cases import KEYS, Answer, keyframe_arrays, scenemi, walk_archive
from synthetic import planted_walk

from scenemi.data.container import MotionArchive, write_archive
from video2anim.artifacts.motion_io import read_motion
from video2anim.geometry.rotations import axis_angle_from_matrix


def sample(keyframes: Path, out: Path, *words: str | Path) -> Answer:
    """`sample` with the prior that needs no weights."""
    return scenemi("sample", "--keyframes", keyframes, "--out", out, "--weights", "interpolation", *words)


@pytest.fixture
def keyframes(tmp_path: Path) -> Path:
    path = tmp_path / "keys.npz"
    np.savez(path, **keyframe_arrays())
    return path


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A floor slab and a table beside the path."""
    scene = trimesh.Scene()
    for size, place in (((6.0, 0.1, 6.0), (0.0, -0.05, 1.0)), ((0.8, 0.7, 0.6), (1.0, 0.35, 1.0))):
        scene.add_geometry(trimesh.creation.box(size, trimesh.transformations.translation_matrix(place)))
    path = tmp_path / "room.glb"
    scene.export(path)
    return path


def test_help_is_light_and_names_the_commands() -> None:
    code = (
        "import sys; sys.argv = ['scenemi', '--help']\nfrom scenemi.cli.main import run\ntry:\n    run()\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "bad = {'torch', 'trimesh', 'anny', 'rich.progress'} & set(sys.modules); sys.exit(','.join(bad) or 0)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert all(name in found.stdout for name in ("sample", "evaluate", "train", "data"))


def test_keyframes_and_room_become_a_motion_that_meets_them(keyframes: Path, room: Path, tmp_path: Path) -> None:
    out = tmp_path / "motion.npz"
    done = sample(keyframes, out, "--scene", room)
    assert (done.code, done.err) == (0, "")
    motion = read_motion(out)
    assert motion.frame_count == 61
    given = keyframe_arrays()
    np.testing.assert_allclose(motion.R_parent_joint[KEYS], given["R_parent_joint"], atol=1e-6)
    np.testing.assert_allclose(motion.T_world_root[KEYS, :3, 3], given["translation_m"], atol=1e-6)
    with np.load(out, allow_pickle=False) as archive:
        np.testing.assert_array_equal(np.flatnonzero(archive["is_keyframe"]), KEYS)
        assert archive["camera_is_nominal"]


def test_json_with_axis_angles_gives_the_same_motion(keyframes: Path, tmp_path: Path) -> None:
    given = keyframe_arrays()
    values = {
        "frame_index": KEYS.tolist(),
        "axis_angle": axis_angle_from_matrix(given["R_parent_joint"]).tolist(),
        "translation_m": given["translation_m"].tolist(),
    }
    path = tmp_path / "keys.json"
    path.write_text(json.dumps(values))
    assert sample(path, tmp_path / "a.npz").code == 0
    assert sample(keyframes, tmp_path / "b.npz").code == 0
    a, b = read_motion(tmp_path / "a.npz"), read_motion(tmp_path / "b.npz")
    np.testing.assert_allclose(a.joints_world_m, b.joints_world_m, atol=1e-6)


def test_a_motion_is_thinned_to_keyframes(keyframes: Path, tmp_path: Path) -> None:
    assert sample(keyframes, tmp_path / "first.npz").code == 0
    done = sample(tmp_path / "first.npz", tmp_path / "second.npz", "--interval", "20", "--length", "51")
    assert done.code == 0, done.err
    with np.load(tmp_path / "second.npz", allow_pickle=False) as archive:
        assert np.flatnonzero(archive["is_keyframe"]).tolist() == [0, 20, 40, 50]


def test_a_bvh_is_thinned_to_keyframes_and_keeps_its_place(tmp_path: Path) -> None:
    from video2anim.export.bvh import write_bvh
    from video2anim.export.character import character_of

    walk = planted_walk(61)
    write_bvh(tmp_path / "walk.bvh", character_of(walk))
    done = sample(tmp_path / "walk.bvh", tmp_path / "motion.npz", "--interval", "15")
    assert done.code == 0, done.err
    motion = read_motion(tmp_path / "motion.npz")
    # Retargeting onto the same body plants the feet anew, so it is not exact.
    np.testing.assert_allclose(
        motion.T_world_root[[0, 30, 60], :3, 3], walk.T_world_root[[0, 30, 60], :3, 3], atol=0.04
    )


def test_poses_without_frames_are_an_interval_apart(tmp_path: Path) -> None:
    given = keyframe_arrays()
    given.pop("frame_index")
    np.savez(tmp_path / "keys.npz", **given)
    assert sample(tmp_path / "keys.npz", tmp_path / "motion.npz", "--interval", "10").code == 0
    assert read_motion(tmp_path / "motion.npz").frame_count == 31


def test_a_longer_motion_holds_its_last_pose_and_says_so(keyframes: Path, tmp_path: Path) -> None:
    done = sample(keyframes, tmp_path / "motion.npz", "--length", "90")
    assert done.code == 0
    assert "frames 61 to 89 hold the last keyframe's pose" in done.err
    assert read_motion(tmp_path / "motion.npz").frame_count == 90


def test_several_samples_are_several_files(keyframes: Path, tmp_path: Path) -> None:
    done = sample(keyframes, tmp_path / "m.npz", "--samples", "3")
    assert [Path(line).name for line in done.out.split()] == ["m.npz", "m_2.npz", "m_3.npz"]
    assert all(Path(line).is_file() for line in done.out.split())


def with_nan(v: dict[str, Any]) -> None:
    v["translation_m"] = v["translation_m"].copy()
    v["translation_m"][2, 1] = np.nan


def with_23_joints(v: dict[str, Any]) -> None:
    v["R_parent_joint"] = np.tile(np.eye(3), (4, 23, 1, 1))


def with_scaled_rotation(v: dict[str, Any]) -> None:
    v["R_parent_joint"] = v["R_parent_joint"].copy()
    v["R_parent_joint"][1, 4] *= 1.2


def with_mirrored_rotation(v: dict[str, Any]) -> None:
    v["R_parent_joint"] = v["R_parent_joint"].copy()
    v["R_parent_joint"][0, 0] = np.diag([1.0, 1.0, -1.0])


def with_one_keyframe(v: dict[str, Any]) -> None:
    v.update({name: value[:1] for name, value in v.items()})


def with_frame_twice(v: dict[str, Any]) -> None:
    v["frame_index"] = np.array([0, 15, 15, 60])


def with_negative_frame(v: dict[str, Any]) -> None:
    v["frame_index"] = np.array([-3, 15, 40, 60])


def with_half_frames(v: dict[str, Any]) -> None:
    v["frame_index"] = np.array([0.0, 15.5, 40.0, 60.0])


def with_fewer_translations(v: dict[str, Any]) -> None:
    v["translation_m"] = v["translation_m"][:3]


def in_centimetres(v: dict[str, Any]) -> None:
    v["rest_joints_m"] = 100 * planted_walk(2).rest_joints_m


def at_60_fps(v: dict[str, Any]) -> None:
    v["fps"] = 60.0


def without_rotations(v: dict[str, Any]) -> None:
    v.pop("R_parent_joint")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (with_nan, "keyframe 40 holds NaN"),
        (with_23_joints, "want rotations of the 22 SMPL joints, got 23 joints"),
        (with_scaled_rotation, "keyframe 15, joint left_knee: no rotation matrix"),
        (with_mirrored_rotation, "keyframe 0, joint pelvis: no rotation matrix"),
        (with_one_keyframe, "want at least 2 keyframes, got 1"),
        (with_frame_twice, "frame 15 is given twice"),
        (with_negative_frame, "whole numbers from 0"),
        (with_half_frames, "whole numbers from 0"),
        (with_fewer_translations, r"translation_m wants shape (4, 3), got (3, 3)"),
        (in_centimetres, "want meters and +Y up"),
        (at_60_fps, "counted at 30 fps, got 60"),
        (without_rotations, "want R_parent_joint"),
    ],
)
def test_bad_keyframes_are_refused_in_one_line(
    spoil: Callable[[dict[str, Any]], None], message: str, tmp_path: Path
) -> None:
    values = keyframe_arrays()
    spoil(values)
    np.savez(tmp_path / "keys.npz", **values)
    done = sample(tmp_path / "keys.npz", tmp_path / "motion.npz")
    assert done.code == 3
    assert message in done.err
    assert len(done.err.splitlines()) == 1
    assert not (tmp_path / "motion.npz").exists()


def test_rounded_rotations_are_repaired(tmp_path: Path) -> None:
    values = keyframe_arrays()
    values["R_parent_joint"] = np.round(values["R_parent_joint"], 3)
    np.savez(tmp_path / "keys.npz", **values)
    assert sample(tmp_path / "keys.npz", tmp_path / "motion.npz").code == 0
    R = read_motion(tmp_path / "motion.npz").R_parent_joint
    np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-9)


def test_keyframes_outside_the_length_are_refused(keyframes: Path, tmp_path: Path) -> None:
    done = sample(keyframes, tmp_path / "motion.npz", "--length", "50")
    assert done.code == 3
    assert "the last one is at frame 60, outside the 50 frames" in done.err


def test_keyframes_far_outside_the_scene_are_noted(keyframes: Path, tmp_path: Path) -> None:
    box = trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix((50.0, 0.5, 0.0)))
    box.export(tmp_path / "far.ply")
    done = sample(keyframes, tmp_path / "motion.npz", "--scene", tmp_path / "far.ply")
    assert done.code == 0
    assert "4 of 4 keyframes are more than 2.4 m outside the scene" in done.err


def test_a_scene_without_a_floor_gets_one_and_says_so(keyframes: Path, tmp_path: Path) -> None:
    shelf = trimesh.creation.box((1, 0.1, 1), trimesh.transformations.translation_matrix((1.0, 1.5, 0.5)))
    shelf.export(tmp_path / "shelf.obj")
    done = sample(keyframes, tmp_path / "motion.npz", "--scene", tmp_path / "shelf.obj")
    assert done.code == 0
    assert "the scene has no floor (lowest at y = 1.45 m); the plane y = 0 is taken for it" in done.err


@pytest.mark.parametrize("name", ["points.npz", "points.ply"])
def test_points_are_a_scene_too(name: str, keyframes: Path, tmp_path: Path) -> None:
    points_m = np.random.default_rng(0).uniform((-2, 0, -2), (2, 0.02, 3), (500, 3))
    if name.endswith(".npz"):
        np.savez(tmp_path / name, points_m=points_m)
    else:
        trimesh.PointCloud(points_m).export(tmp_path / name)
    done = sample(keyframes, tmp_path / "motion.npz", "--scene", tmp_path / name)
    assert (done.code, done.err) == (0, "")


def empty_npz(path: Path) -> Path:
    np.savez(path / "scene.npz", points_m=np.zeros((0, 3)))
    return path / "scene.npz"


def nan_npz(path: Path) -> Path:
    np.savez(path / "scene.npz", points_m=np.full((5, 3), np.nan))
    return path / "scene.npz"


def millimetres_npz(path: Path) -> Path:
    np.savez(path / "scene.npz", points_m=np.array([[0.0, 0.0, 0.0], [6000.0, 2500.0, 4000.0]]))
    return path / "scene.npz"


def broken_faces_npz(path: Path) -> Path:
    np.savez(path / "scene.npz", vertices_m=np.eye(3), faces=np.array([[0, 1, 7]]))
    return path / "scene.npz"


def broken_glb(path: Path) -> Path:
    (path / "scene.glb").write_bytes(b"glTF and then nothing")
    return path / "scene.glb"


def empty_glb(path: Path) -> Path:
    (path / "scene.glb").write_bytes(b"")
    return path / "scene.glb"


def other_file(path: Path) -> Path:
    (path / "scene.blend").write_bytes(b"x")
    return path / "scene.blend"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (empty_npz, "an empty scene"),
        (nan_npz, "holds NaN"),
        (millimetres_npz, "want a scene in meters"),
        (broken_faces_npz, "vertices that are not there"),
        (broken_glb, "cannot be read as a scene"),
        (empty_glb, "cannot be read as a scene"),
        (other_file, "want a scene as .glb"),
        (lambda path: path / "none.glb", "no such scene file"),
    ],
)
def test_bad_scenes_are_refused_in_one_line(
    make: Callable[[Path], Path], message: str, keyframes: Path, tmp_path: Path
) -> None:
    done = sample(keyframes, tmp_path / "motion.npz", "--scene", make(tmp_path))
    assert done.code == 3
    assert message in done.err
    assert len(done.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("--keyframes", "none.npz", "--out", "m.npz"), 3, "no such keyframe file"),
        (("--keyframes", "KEYS", "--out", "m.bvh"), 2, "--out: want a .npz file"),
        (("--keyframes", "KEYS", "--out", "no_folder/m.npz"), 3, "existing folder"),
        (("--keyframes", "KEYS", "--out", "m.npz", "--weights", "none_such"), 4, "found no none_such.safetensors"),
        (("--keyframes", "KEYS", "--out", "m.npz", "--device", "tpu"), 2, "want auto, cpu or cuda"),
        (("--keyframes", "KEYS", "--out", "m.npz", "--noise", "nan"), 2, "noise: want"),
        (("--keyframes", "KEYS", "--out", "m.npz", "--steps", "0"), 2, "--steps"),
    ],
)
def test_impossible_requests_have_their_exit_code(
    words: tuple[str, ...], code: int, message: str, keyframes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    weights = () if "--weights" in words else ("--weights", "interpolation")
    done = scenemi("sample", *(str(keyframes) if word == "KEYS" else word for word in words), *weights)
    assert done.code == code, done.err
    assert message in done.err


@pytest.mark.parametrize("frames", [121, 122])
def test_evaluate_writes_exactly_the_published_numbers(frames: int, tmp_path: Path) -> None:
    archive, out = walk_archive(tmp_path / "clips.npz", frames), tmp_path / "numbers.json"
    words = ("--clips", archive, "--interval", "30", "--weights", "interpolation", "--json", out)
    done = scenemi("evaluate", *words)
    assert done.code == 0, done.err
    numbers = json.loads(out.read_text())
    assert list(numbers) == [
        "windows", "mjpe_all_m", "mjpe_key_m", "jerk_m_s3", "jerk_truth_m_s3", "skating_gmd", "skating_gmd_truth",
        "collision_frame_ratio", "penetration_max_m", "seconds_per_window", "baseline_mjpe_all_m",
        "baseline_jerk_m_s3",
    ]  # fmt: skip
    assert numbers["windows"] == 1
    assert numbers["mjpe_all_m"] == numbers["baseline_mjpe_all_m"] > 0
    assert 0 <= numbers["collision_frame_ratio"] <= 1


def test_evaluate_refuses_clips_that_are_too_short(tmp_path: Path) -> None:
    done = scenemi("evaluate", "--clips", walk_archive(tmp_path / "clips.npz", 120), "--weights", "interpolation")
    assert done.code == 3
    assert "want a clip of at least 121 frames" in done.err
    assert len(done.err.splitlines()) == 1


def test_data_shows_and_converts(tmp_path: Path) -> None:
    from video2anim.export.bvh import write_bvh
    from video2anim.export.character import character_of

    write_bvh(tmp_path / "walk_b.bvh", character_of(planted_walk(130)))
    archive = walk_archive(tmp_path / "clips.npz", 150)
    done = scenemi(
        "data", archive, tmp_path / "walk_b.bvh", "--out", tmp_path / "both.npz", "--kind", "walk",
        "--source", "mine", "--license", "own",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert "synthetic walk" in done.out
    both = MotionArchive.read(tmp_path / "both.npz")
    assert both.names == ("walk", "walk_b")
    assert both.kinds == ("walk", "walk")
    assert (both.sources, both.licenses) == (("synthetic", "mine"), ("own", "own"))
    assert (
        scenemi("evaluate", "--clips", tmp_path / "both.npz", "--interval", "60", "--weights", "interpolation").code
        == 0
    )


def test_furniture_is_solid_and_the_shell_of_a_room_is_not() -> None:
    from scenemi.scene.scene_parts import ScenePart, geometry_of

    table = trimesh.creation.box((1.0, 0.8, 1.0), trimesh.transformations.translation_matrix((1.5, 0.4, 0.0)))
    shell = trimesh.creation.box((6.0, 3.0, 6.0), trimesh.transformations.translation_matrix((0.0, 1.5, 0.0)))
    parts = tuple(ScenePart(np.array(mesh.vertices), np.array(mesh.faces)) for mesh in (table, shell))
    geometry = geometry_of(parts, np.array([[0.0, 0.9, 0.0], [0.0, 0.9, 1.0]]))
    points_m = np.array([[1.5, 0.4, 0.0], [0.0, 1.5, 0.0], [0.0, 0.3, 0.0]])
    gap_m = np.linalg.norm(geometry.nearest(points_m) - points_m, axis=1)
    # Inside the table; in the middle of the room, 1 m from the table's edge and 1.22 m from its top; above the floor.
    np.testing.assert_allclose(gap_m, [0.0, np.hypot(1.0, 0.7), 0.3], atol=1e-6)


def test_train_writes_weights_that_sample_and_can_go_on(
    keyframes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from scenemi.model.weights import load_weights
    from scenemi.training import loop, pool

    for module in (loop, pool):
        monkeypatch.setattr(module, "SHARD_WINDOWS", 16)
    archive = walk_archive(tmp_path / "clips.npz", 150)
    split = tmp_path / "split.json"
    split.write_text(json.dumps({"train": ["walk"], "val": ["walk_val"], "test": []}))
    config = tmp_path / "run.json"
    small = {"model": "tiny", "batch": 2, "bodies": 1, "bends": 0, "log_every": 2, "workers": 0, "pool_windows": 16}
    config.write_text(json.dumps(small))
    val = MotionArchive.read(archive).clip("walk")
    write_archive(tmp_path / "val.npz", [replace(val, name="walk_val")])
    words = ("train", "--motion", archive, "--motion", tmp_path / "val.npz", "--split", split, "--config", config)
    weights = tmp_path / "run" / "weights.safetensors"
    steps = []
    for _ in range(2):
        done = scenemi(*words, "--out", tmp_path / "run", "--minutes", "0.02", "--device", "cpu")
        assert done.code == 0, done.err
        steps.append(load_weights(weights).card["steps"])
        assert f"weights of {steps[-1]} steps are not usable yet" in done.err
        assert load_weights(weights).card["licenses"] == {"synthetic": "own"}
    assert 0 < steps[0] < steps[1], "the second call goes on from the first"
    for more, frames in (((), 61), (("--noisy", "--temperature", "0.5"), 61), (("--length", "690"), 690)):
        made = scenemi(
            "sample", "--keyframes", keyframes, "--out", tmp_path / "m.npz", "--weights", weights, "--steps", "2",
            "--device", "cpu", *more,
        )  # fmt: skip
        assert made.code == 0, made.err
        motion = read_motion(tmp_path / "m.npz")
        assert motion.frame_count == frames
        assert np.isfinite(motion.joints_world_m).all()


def test_unknown_training_options_are_refused(tmp_path: Path) -> None:
    config = tmp_path / "run.json"
    config.write_text(json.dumps({"step": 4}))
    words = ("--motion", tmp_path / "none.npz", "--out", tmp_path / "run", "--config", config)
    done = scenemi("train", *words)
    assert done.code == 3
    assert "unknown step" in done.err
