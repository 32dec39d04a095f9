"""A motion on the user's SMPL body: as large, at the same place, in files and pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import video2anim
from smpl_files import write_human
from walk_scene import walk

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.smpl_fit import on_smpl_body
from video2anim.body.smplx_body import DIR_VARIABLE
from video2anim.errors import InputError, UsageError
from video2anim.export import ExportScene, write_format
from video2anim.types import BodyMotion, BodyShape
from video2anim.types.skeleton import JOINT_INDEX


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    place = tmp_path / "smpl"
    place.mkdir()
    monkeypatch.setenv(DIR_VARIABLE, str(place))
    return place


def tall_walk() -> BodyMotion:
    """A walk of somebody 6 % taller than the files' mean body, with the same proportions of the limbs."""
    motion = walk(12)
    rest_m = 1.06 * motion.rest_joints_m
    return replace(motion, rest_joints_m=rest_m).with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3], R_parent_joint=motion.R_parent_joint
    )


@pytest.mark.parametrize("model", ["smpl", "smplh", "smplx"])
def test_bones_get_the_length_of_the_motion(folder: Path, model: str) -> None:
    write_human(folder, model)
    motion = tall_walk()
    found = on_smpl_body(motion, model)
    assert found.shape.model == model
    np.testing.assert_array_equal(found.R_parent_joint, motion.R_parent_joint)
    np.testing.assert_allclose(found.joints_world_m[:, 0], motion.joints_world_m[:, 0], atol=1e-9)
    # The prior of 0 +- 1 on beta 0, which would have to be 1.2, keeps a little of the mean body.
    assert np.linalg.norm(found.joints_world_m - motion.joints_world_m, axis=-1).max() < 0.01
    skin_m = shaped_body(found.shape).rest_vertices_m[:-1]
    mean_m = shaped_body(BodyShape("anny", dict(ADULT))).rest_joints_m
    grown = np.ptp(found.rest_joints_m[:, 1]) / np.ptp(mean_m[:, 1])
    assert grown == pytest.approx(1.06, abs=0.005)
    assert skin_m[:, 1].max() > found.rest_joints_m[JOINT_INDEX["head"], 1]
    assert on_smpl_body(found, model) is found


def test_a_glb_holds_the_skin_of_the_file(folder: Path, tmp_path: Path) -> None:
    import pygltflib as gltf

    write_human(folder, "smplx")
    people = tuple(on_smpl_body(motion, "smplx") for motion in (walk(12), walk(12, 2)))
    (path, *_) = write_format("glb", ExportScene(people, None), tmp_path / "out.glb")
    document = gltf.GLTF2().load(str(path))
    assert document is not None
    used = len(np.unique(shaped_body(people[0].shape).faces))
    counts = {document.accessors[p.attributes.POSITION].count for mesh in document.meshes for p in mesh.primitives}
    assert counts == {used}


def test_errors_say_what_is_missing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="want smpl, smplh or smplx"):
        on_smpl_body(walk(4), "anny2")
    with pytest.raises(InputError, match=r"SMPLX_MALE\.npz or .* there is none"):
        on_smpl_body(walk(4), "smplx-male")
    (folder / "SMPLX_MALE.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="SMPL file: want arrays"):
        on_smpl_body(walk(4), "smplx-male")
    monkeypatch.setenv(DIR_VARIABLE, str(folder / "absent"))
    with pytest.raises(InputError, match="want a folder of SMPL files, found none at"):
        on_smpl_body(walk(4), "smplx")
    monkeypatch.delenv(DIR_VARIABLE)
    with pytest.raises(UsageError, match=f"--smpl-dir or in {DIR_VARIABLE}, got neither"):
        on_smpl_body(walk(4), "smplx")


@pytest.mark.parametrize("command", [("export", "--format", "amass"), ("view", "--screenshot", "a.png")])
def test_a_folder_that_is_not_there_ends_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.setenv(DIR_VARIABLE, "elsewhere")
    name, *rest = command
    answer = video2anim(name, tmp_path, *rest, "--smpl-dir", tmp_path / "absent")
    assert answer.code == 3
    assert answer.errors == [
        f"video2anim: SMPL body: want a folder of SMPL files, found none at {tmp_path / 'absent'}; correct the path"
    ]
