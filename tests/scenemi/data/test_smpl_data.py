"""Data sets of SMPL parameters, in small files of the published layouts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scenemi.data.amass import read_amass
from scenemi.data.container import MotionArchive, write_archive
from scenemi.data.gimo import read_gimo
from scenemi.data.readers import read_clips
from scenemi.data.retarget import retarget
from scenemi.data.smpl_clip import SmplModel
from scenemi.data.source_clip import SourceClip
from scenemi.data.trumans import read_trumans
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.errors import InputError
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_quaternion
from video2anim.types import BodyShape
from video2anim.types.skeleton import forward_kinematics

PELVIS_M = {
    "smpl": np.array([-0.002, -0.223, 0.028]),
    "smplh": np.array([-0.002, -0.23, 0.028]),
    "smplx": np.array([0.003, -0.351, 0.012]),
}
"""Of the models' mean shapes."""
R_Y_UP_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Z of the data is Y here."""


def parameters(clip: SourceClip, model: SmplModel, R_data_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 66) poses and (T, 3) translations of a clip of 22 joints, in a data set's axes."""
    R = matrix_from_quaternion(clip.rotation_wxyz)
    R[:, 0] = R_data_world @ R[:, 0]
    return axis_angle_from_matrix(R).reshape(-1, 66), clip.root_position_m @ R_data_world.T - PELVIS_M[model]


def expect_walk(clip: SourceClip, walk: SourceClip, step: int = 1) -> None:
    assert clip.fps == 30.0
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    motion = retarget(clip, body)
    joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    error_m = np.linalg.norm(joints_m - walk.joints_m()[::step][: len(joints_m)], axis=-1)
    assert error_m.mean() < 0.03
    assert motion.contact.any(1).mean() > 0.8


@pytest.mark.parametrize(("width", "model"), [(156, "smplh"), (165, "smplx"), (72, "smpl")])
def test_amass_files(tmp_path: Path, smpl_walk: SourceClip, width: int, model: SmplModel) -> None:
    poses, trans = parameters(smpl_walk, model, R_Y_UP_Z_UP.T)
    folder = tmp_path / "Subject"
    folder.mkdir()
    path = folder / "walk_poses.npz"
    rate = "mocap_frame_rate" if model == "smplx" else "mocap_framerate"
    full = np.concatenate([poses, np.zeros((len(poses), width - 66))], axis=1)
    np.savez(path, poses=full, trans=trans, betas=np.zeros(16), gender="female", **{rate: 30.0})
    clip = read_amass(path, kind="walk")
    assert (clip.name, clip.source, clip.kind) == ("amass_Subject_walk_poses", "amass", "walk")
    assert "middle adult" in clip.description
    expect_walk(clip, smpl_walk)
    assert read_clips(path)[0].name == clip.name
    write_archive(tmp_path / "out.npz", [clip])
    assert MotionArchive.read(tmp_path / "out.npz").names == (clip.name,)


def test_amass_at_other_rates_and_in_parts(tmp_path: Path, smpl_walk: SourceClip) -> None:
    poses, trans = parameters(smpl_walk, "smplx", R_Y_UP_Z_UP.T)
    path = tmp_path / "x.npz"
    np.savez(path, root_orient=poses[:, :3], pose_body=poses[:, 3:], trans=trans, mocap_frame_rate=60.0)
    clip = read_amass(path)
    assert (len(clip.root_position_m), clip.source_fps) == (60, 60.0)
    np.testing.assert_allclose(np.diff(clip.root_position_m, axis=0), np.diff(smpl_walk.root_position_m[::2], axis=0))


def test_a_smaller_person_is_scaled_to_the_floor(tmp_path: Path, smpl_walk: SourceClip) -> None:
    poses, trans = parameters(smpl_walk, "smplh", R_Y_UP_Z_UP.T)
    trans[:, 2] -= 0.08
    np.savez(tmp_path / "x.npz", poses=poses_of(poses), trans=trans, mocap_framerate=30.0)
    clip = read_amass(tmp_path / "x.npz")
    assert 0.88 < np.linalg.norm(clip.skeleton.offsets_m[4]) / np.linalg.norm(smpl_walk.skeleton.offsets_m[4]) < 0.95
    trans[:, 2] += 3.0
    np.savez(tmp_path / "y.npz", poses=poses_of(poses), trans=trans, mocap_framerate=30.0)
    high = read_amass(tmp_path / "y.npz")
    assert "moved to the floor" in high.description
    assert high.root_position_m[:, 1].max() < 1.1


def poses_of(poses: np.ndarray) -> np.ndarray:
    return np.concatenate([poses, np.zeros((len(poses), 90))], axis=1)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"betas": np.zeros(16)}, "no AMASS motion"),
        ({"poses": np.zeros((4, 60)), "trans": np.zeros((4, 3)), "mocap_framerate": 30.0}, r"got \(4, 60\)"),
        ({"poses": np.zeros((4, 156)), "trans": np.zeros((3, 3)), "mocap_framerate": 30.0}, r"want poses \(T, 66\)"),
        ({"poses": np.full((4, 156), np.nan), "trans": np.zeros((4, 3)), "mocap_framerate": 30.0}, "NaN"),
        ({"poses": np.array([{}], object), "trans": np.zeros((4, 3)), "mocap_framerate": 30.0}, "plain .npz"),
    ],
)
def test_amass_files_of_other_layouts(tmp_path: Path, arrays: dict[str, np.ndarray], message: str) -> None:
    np.savez(tmp_path / "x.npz", **arrays)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=message):
        read_amass(tmp_path / "x.npz")


def write_trumans(folder: Path, walk: SourceClip) -> None:
    """Three takes of one walk in two rooms; one has a bad frame in its middle."""
    poses, shift = parameters(walk, "smplx", np.eye(3))
    frames = len(poses)
    np.save(folder / "human_pose.npy", np.tile(poses[:, 3:], (3, 1)))
    np.save(folder / "human_orient.npy", np.tile(poses[:, :3], (3, 1)))
    np.save(folder / "human_transl.npy", np.tile(shift, (3, 1)))
    np.save(folder / "seg_name.npy", np.repeat(["take_a", "take_b", "take_c"], frames))
    np.save(folder / "scene_flag.npy", np.repeat([1, 0, 1], frames))
    np.save(folder / "scene_list.npy", np.array(["kitchen", "bedroom"]))
    np.save(folder / "bad_frames.npy", np.array([frames + 60]))
    (folder / "Scene").mkdir()
    grid = np.zeros((300, 100, 400), bool)
    grid[150, 0, 200] = grid[0, 99, 399] = True
    np.save(folder / "Scene" / "kitchen.npy", grid)


def test_trumans_takes_and_scenes(tmp_path: Path, smpl_walk: SourceClip) -> None:
    write_trumans(tmp_path, smpl_walk)
    takes = list(read_trumans(tmp_path))
    assert [take.clip.name for take in takes] == [
        "trumans_take_a_0", "trumans_take_b_120", "trumans_take_b_181", "trumans_take_c_240"
    ]  # fmt: skip
    assert [take.scene_name for take in takes] == ["bedroom", "kitchen", "kitchen", "bedroom"]
    assert [len(take.clip.root_position_m) for take in takes] == [120, 60, 59, 120]
    expect_walk(takes[0].clip, smpl_walk)
    assert len(read_clips(tmp_path)) == 4


def test_trumans_without_pickles(tmp_path: Path, smpl_walk: SourceClip) -> None:
    write_trumans(tmp_path, smpl_walk)
    np.save(tmp_path / "seg_name.npy", np.repeat(["a"], 360).astype(object))
    with pytest.raises(InputError, match=r"astype\(str\)"):
        next(read_trumans(tmp_path))
    (tmp_path / "seg_name.npy").unlink()
    with pytest.raises(InputError, match=r"seg_name\.npy: missing"):
        next(read_trumans(tmp_path))


def write_gimo(folder: Path, walk: SourceClip) -> None:
    """One sequence whose body frame is turned and scaled against the scan."""
    (folder / "dataset.csv").write_text(
        "sequence_path,start_frame,end_frame,scene,transformation,training\n"
        "2022-01-23-080759,300,420,bedroom0123,transform_info.json,0\n"
    )
    room, sequence = folder / "bedroom0123", folder / "bedroom0123" / "2022-01-23-080759"
    (room / "scene_obj").mkdir(parents=True)
    sequence.mkdir()
    scale, turn = 1.25, np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, [0.5, -1.5, 2.0]
    norm = np.eye(4)
    norm[:3, 3] = [0.1, 1.5, 0.2]
    (sequence / "transform_info.json").write_text(json.dumps({"scale": scale, "transformation": T.tolist()}))
    np.savetxt(room / "scene_obj" / "transform_norm.txt", norm)
    T_world_body = np.eye(4)
    T_world_body[:3, :3], T_world_body[:3, 3] = turn, (T[:3, 3] + norm[:3, 3]) / scale
    poses, _ = parameters(walk, "smplx", turn.T)
    shift = (walk.root_position_m - T_world_body[:3, 3]) @ turn - PELVIS_M["smplx"]
    frame = np.arange(290, 410)
    np.savez(sequence / "smplx_local.npz", frame=frame, orient=poses[:, :3], trans=shift, pose_body=poses[:, 3:])


def test_gimo_sequences(tmp_path: Path, smpl_walk: SourceClip) -> None:
    write_gimo(tmp_path, smpl_walk)
    (sequence,) = read_gimo(tmp_path)
    assert sequence.clip.name == "gimo_bedroom0123_2022-01-23-080759_300"
    assert not sequence.training
    np.testing.assert_allclose(sequence.clip.root_position_m, smpl_walk.root_position_m[10:], atol=1e-6)
    turned = matrix_from_quaternion(sequence.clip.rotation_wxyz)
    np.testing.assert_allclose(turned, matrix_from_quaternion(smpl_walk.rotation_wxyz)[10:], atol=1e-6)
    np.testing.assert_allclose(sequence.T_world_mesh @ [1.25, 0, 0, 1], [1.08, 1.2, 0.16, 1])
    assert sequence.scene_mesh.name == "textured_output.obj"
    assert len(read_clips(tmp_path)) == 1


def test_gimo_wants_its_pickles_converted(tmp_path: Path, smpl_walk: SourceClip) -> None:
    write_gimo(tmp_path, smpl_walk)
    next(tmp_path.glob("*/*/smplx_local.npz")).unlink()
    with pytest.raises(InputError, match="have to be converted"):
        list(read_gimo(tmp_path))
    (tmp_path / "dataset.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="want the columns"):
        list(read_gimo(tmp_path))
    with pytest.raises(InputError, match="found none"):
        read_clips(tmp_path / "bedroom0123" / "scene_obj")
