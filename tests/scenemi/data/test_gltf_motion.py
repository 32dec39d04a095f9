"""Keyframes from GLB: files of this project, files of Blender, and what is refused."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
from synthetic import planted_walk

from scenemi.data.gltf_motion import read_gltf_motion
from scenemi.data.gltf_nodes import Channel
from scenemi.data.keyframe_file import read_keyframes
from video2anim.errors import InputError
from video2anim.export.character import character_of
from video2anim.export.fbx import blender_command
from video2anim.export.glb import write_scene_glb
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

_BLENDER = Path(sys.prefix, "blender", "bin", "python")
if _BLENDER.is_file():
    os.environ.setdefault("VIDEO2ANIM_BLENDER", str(_BLENDER))
needs_blender = pytest.mark.skipif(
    blender_command() is None,
    reason="no Blender: `make .venv/.programs`, or name a Blender or a Python that has bpy in VIDEO2ANIM_BLENDER",
)


@pytest.fixture
def walk_glb(tmp_path: Path) -> Path:
    """The walk as this project exports it."""
    write_scene_glb(tmp_path / "walk.glb", (character_of(planted_walk(31)),), None)
    return tmp_path / "walk.glb"


def changed(path: Path, change: Callable[[Any], None]) -> Path:
    document = pygltflib.GLTF2.load_from_bytes(path.read_bytes())
    change(document)
    path.write_bytes(b"".join(document.save_to_bytes()))  # type: ignore[union-attr]
    return path


def with_times(path: Path, time_s: list[float]) -> Path:
    """The file with other times of its keys."""

    def change(document: Any) -> None:
        blob = bytearray(document.binary_blob())
        for sampler in document.animations[0].samplers:
            accessor = document.accessors[sampler.input]
            start = document.bufferViews[accessor.bufferView].byteOffset + (accessor.byteOffset or 0)
            blob[start : start + 4 * accessor.count] = np.array(time_s, "<f4").tobytes()
        document.set_binary_blob(bytes(blob))

    return changed(path, change)


def test_a_file_of_this_project_gives_its_poses_on_its_own_body(walk_glb: Path) -> None:
    walk = planted_walk(31)
    found = read_keyframes(walk_glb, interval=10)
    assert found.frame_index.tolist() == [0, 10, 20, 30]
    assert found.shape.parameters == walk.shape.parameters
    joints_m, _ = forward_kinematics(found.R_parent_joint, found.translation_m, found.rest_joints_m)
    assert np.linalg.norm(joints_m - walk.joints_world_m[found.frame_index], axis=-1).max() < 0.005


def test_keys_that_somebody_set_are_the_keyframes(tmp_path: Path) -> None:
    write_scene_glb(tmp_path / "walk.glb", (character_of(planted_walk(3)),), None)
    path = with_times(tmp_path / "walk.glb", [0.5, 1.5, 3.0])
    assert read_keyframes(path, interval=10).frame_index.tolist() == [0, 30, 75]


def test_cubic_keys_pass_through_their_values() -> None:
    """Hermite: at u = 0.5 the mean of the values, and an eighth of the difference of the tangents times the step."""
    values = np.array([[[0.0], [1.0], [2.0]], [[-2.0], [3.0], [0.0]]])
    curve = Channel(0, "translation", np.array([0.0, 2.0]), values, "CUBICSPLINE")
    np.testing.assert_allclose(curve.at(np.array([-1.0, 0.0, 1.0, 2.0, 9.0]))[:, 0], [1.0, 1.0, 3.0, 3.0, 3.0])


def without_animation(document: Any) -> None:
    document.animations = []


def in_centimeters(document: Any) -> None:
    next(node for node in document.nodes if node.name == "person_1").scale = [100.0, 100.0, 100.0]


def on_its_side(document: Any) -> None:
    next(node for node in document.nodes if node.name == "person_1").rotation = [0.5**0.5, 0.0, 0.0, 0.5**0.5]


def without_legs(document: Any) -> None:
    for node in document.nodes:
        node.name = (node.name or "").replace("knee", "part")


def in_a_circle(document: Any) -> None:
    document.nodes[1].children = [0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without_animation, "no animation of the character"),
        (in_centimeters, "apply the scale, glTF is in meters"),
        (on_its_side, "export with [+]Y up"),
        (without_legs, "no joint found for left_knee, right_knee"),
        (in_a_circle, "cannot be read as a binary glTF"),
    ],
)
def test_what_cannot_be_used_is_refused(change: Callable[[Any], None], message: str, walk_glb: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_gltf_motion(changed(walk_glb, change))


def test_a_file_without_people_and_a_damaged_one_are_refused(tmp_path: Path, walk_glb: Path) -> None:
    write_scene_glb(tmp_path / "empty.glb", (), None)
    with pytest.raises(InputError, match="the file has no skin"):
        read_gltf_motion(tmp_path / "empty.glb")
    walk_glb.write_bytes(walk_glb.read_bytes()[:2000])
    with pytest.raises(InputError, match="cannot be read as a binary glTF"):
        read_gltf_motion(walk_glb)


def blender(*words: Path) -> None:
    command = blender_command()
    assert command is not None
    script = Path(__file__).with_name("blender_character.py")
    done = subprocess.run([*command, str(script), "--", *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@needs_blender
def test_poses_keyed_in_blender_are_keyframes_where_they_were_set(tmp_path: Path) -> None:
    """Frames 1, 31 and 76; the character walks to its front, -Y in Blender, and bends its left knee by 0.8 rad."""
    blender(tmp_path / "hero.glb")
    found = read_gltf_motion(tmp_path / "hero.glb")
    assert found.key_frames.tolist() == [0, 30, 75]
    np.testing.assert_allclose(found.clip.root_position_m[found.key_frames, 2], [0.0, 0.6, 1.4], atol=1e-3)
    keys = read_keyframes(tmp_path / "hero.glb")
    np.testing.assert_allclose(keys.translation_m[:, 2], [0.0, 0.6, 1.4], atol=0.03)
    bend = keys.R_parent_joint[:, JOINT_INDEX["left_knee"]]
    bent_rad = np.arccos(0.5 * (np.trace(bend, axis1=1, axis2=2) - 1))
    assert bent_rad[1] == pytest.approx(0.8, abs=0.1)
    assert max(bent_rad[0], bent_rad[2]) < 0.4, "standing on planted feet"


@needs_blender
def test_a_file_that_went_through_blender_gives_the_same_poses(tmp_path: Path, walk_glb: Path) -> None:
    blender(tmp_path / "again.glb", walk_glb)
    before, after = (read_keyframes(path, interval=15) for path in (walk_glb, tmp_path / "again.glb"))
    assert after.shape.parameters == pytest.approx(before.shape.parameters)
    joints_m = [forward_kinematics(k.R_parent_joint, k.translation_m, k.rest_joints_m)[0] for k in (before, after)]
    assert np.linalg.norm(joints_m[0] - joints_m[1], axis=-1).max() < 0.005
