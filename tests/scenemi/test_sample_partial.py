"""`scenemi sample` with partial keyframes and postures at objects, from the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scenemi_cases import Answer, scenemi, walk_bvh
from synthetic import planted_walk

from video2anim.artifacts.motion_io import read_motion
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.types.skeleton import JOINT_INDEX

WRIST = JOINT_INDEX["right_wrist"]


def sample(folder: Path, values: dict[str, Any], *words: str | Path, weights: str = "interpolation") -> Answer:
    (folder / "keys.json").write_text(json.dumps(values))
    given = ("--keyframes", folder / "keys.json", "--out", folder / "motion.npz", "--weights", weights)
    return scenemi("sample", *given, *words)


@pytest.fixture
def crate(tmp_path: Path) -> Path:
    """A folder with a crate of 40 cm 2 m before the origin."""
    scene = trimesh.Scene()
    move = trimesh.transformations.translation_matrix((0.0, 0.2, 2.0))
    scene.add_geometry(trimesh.creation.box((0.5, 0.4, 0.5), move), node_name="crate", geom_name="crate")
    scene.export(tmp_path / "scene.glb")
    return tmp_path


def test_somebody_walks_a_path_and_sits_down(crate: Path) -> None:
    asked = {
        "root_path": {"points_xz_m": [[0, 0], [0.15, 0.8]], "frames": [0, 30]},
        "postures": [{"sit_on": "crate", "time_s": 2, "heading_deg": 180}],
    }
    done = sample(crate, asked, "--scene", crate)
    assert (done.code, done.err) == (0, ""), done.err
    motion = read_motion(crate / "motion.npz")
    assert motion.frame_count == 61
    pelvis_m = motion.joints_world_m[:, 0]
    assert np.linalg.norm(pelvis_m[30, [0, 2]] - [0.15, 0.8]) < 0.05
    assert np.linalg.norm(pelvis_m[60, [0, 2]] - [0.0, 2.0]) < 0.3
    assert 0.45 < pelvis_m[60, 1] < 0.6


def test_another_file_gives_the_whole_poses(tmp_path: Path) -> None:
    walk_bvh(tmp_path / "walk.bvh")
    place_m = [-0.3, 1.2, 1.2]
    asked = {"poses_from": "walk.bvh", "joint_targets": [{"joint": "right_wrist", "frame": 37, "position_m": place_m}]}
    assert sample(tmp_path, asked).code == 0
    assert np.linalg.norm(read_motion(tmp_path / "motion.npz").joints_world_m[37, WRIST] - place_m) < 0.02


def test_the_network_meets_hands_path_and_feet(tmp_path: Path) -> None:
    """The shipped weights, two rounds: all is within what the docs say, or it would be told."""
    walk = planted_walk(61)
    joints_m = walk.joints_world_m
    rows = [0, 60]
    target_m = (joints_m[30, WRIST] + [-0.05, 0.2, 0.1]).tolist()
    asked = {
        "frame_index": rows,
        "axis_angle": axis_angle_from_matrix(walk.R_parent_joint[rows]).tolist(),
        "translation_m": walk.T_world_root[rows, :3, 3].tolist(),
        "joint_targets": [{"joint": "right_wrist", "frame": 30, "position_m": target_m}],
        "root_path": {"points_xz_m": joints_m[::15, 0][:, [0, 2]].tolist(), "frames": [0, 15, 30, 45, 60]},
        "pinned": [{"foot": "left", "frames": [0, 8]}],
    }
    done = sample(tmp_path, asked, weights="small")
    assert (done.code, done.err) == (0, ""), done.err
    found_m = read_motion(tmp_path / "motion.npz").joints_world_m
    assert np.linalg.norm(found_m[30, WRIST] - target_m) < 0.02
    assert np.linalg.norm((found_m - joints_m)[:, 0][:, [0, 2]], axis=1).max() < 0.05
    ankle = JOINT_INDEX["left_ankle"]
    assert np.linalg.norm(np.ptp(found_m[:9, ankle][:, [0, 2]], axis=0)) < 0.01


@pytest.mark.parametrize(
    ("asked", "words", "message"),
    [
        ({"postures": [{"sit_on": "throne", "frame": 9}]}, ("scene",), "no object 'throne' in the scene; it has crate"),
        ({"postures": [{"sit_on": "crate", "frame": 9}]}, (), "want --scene, which has the objects"),
        ({"pinned": [{"foot": "left", "frames": [0, 8]}]}, (), "want whole poses, postures or a root_path"),
        ({"postures": [{"stand_at": [0, 0], "frame": 9}]}, (), "want at least 2 keyframes"),
        ({"postures": [{"stand_at": [0, 0], "frame": 9}] * 2}, (), "frame 9 is given two postures"),
        ({"root_path": {"points_xz_m": [[0, 0], [0, 0.1]], "speed_m_s": 2}}, (), "root_path is too short"),
    ],
)
def test_what_cannot_be_met_is_told_in_one_line(
    asked: dict[str, Any], words: tuple[str, ...], message: str, crate: Path
) -> None:
    done = sample(crate, asked, *(("--scene", crate / "scene.glb") if words else ()))
    assert done.code == 3
    assert message in done.err
    assert len(done.err.splitlines()) == 1
    assert not (crate / "motion.npz").exists()


def test_a_folder_without_a_scene_is_refused(tmp_path: Path) -> None:
    done = sample(tmp_path, {"postures": [{"stand_at": [0, 0], "frame": 9}]}, "--scene", tmp_path)
    assert done.code == 3
    assert "want a scene folder with scene.glb" in done.err
