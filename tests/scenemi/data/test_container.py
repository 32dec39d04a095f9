"""The motion archive: what is written comes back, equal content gives equal bytes, broken files are named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenemi.data.container import MotionArchive, SourceClip, read_split, write_archive
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_quaternion
from video2anim.types.skeleton import forward_kinematics


def test_clips_come_back_as_written(tmp_path: Path, smpl_walk: SourceClip) -> None:
    other = replace(smpl_walk, name="climb", kind="climb", uneven=True, fps=25.0, floor_shift_m=0.5, glitch_frames=3)
    other = replace(other, root_position_m=other.root_position_m[:7], rotation_wxyz=other.rotation_wxyz[:7])
    write_archive(tmp_path / "a.npz", [smpl_walk, other])
    archive = MotionArchive.read(tmp_path / "a.npz")
    assert archive.names == ("walk_a", "climb")
    assert archive.kinds == ("walk", "climb")
    assert archive.sources == ("synthetic", "synthetic")
    assert archive.frame_counts == (120, 7)
    for clip in (smpl_walk, other):
        read = archive.clip(clip.name)
        for name in ("name", "source", "kind", "description", "origin", "uneven", "fps", "floor_shift_m"):
            assert getattr(read, name) == getattr(clip, name)
        assert read.glitch_frames == clip.glitch_frames
        assert read.skeleton.names == clip.skeleton.names
        np.testing.assert_array_equal(read.skeleton.parents, clip.skeleton.parents)
        np.testing.assert_allclose(read.root_position_m, clip.root_position_m, atol=1e-6)
        # 16 bits: steps of 1/32767, rounded once or twice.
        assert np.abs(read.rotation_wxyz - clip.rotation_wxyz).max() < 1.5 / 32767
        np.testing.assert_allclose(np.linalg.norm(read.rotation_wxyz, axis=-1), 1.0, atol=1e-12)
        assert np.linalg.norm(read.joints_m() - clip.joints_m(), axis=-1).max() < 5e-4


def test_equal_content_gives_equal_bytes_and_survives_a_second_trip(tmp_path: Path, smpl_walk: SourceClip) -> None:
    paths = [tmp_path / name for name in ("a.npz", "b.npz", "c.npz")]
    write_archive(paths[0], [smpl_walk])
    write_archive(paths[1], [replace(smpl_walk)])
    write_archive(paths[2], [MotionArchive.read(paths[0]).clip("walk_a")])
    assert paths[0].read_bytes() == paths[1].read_bytes() == paths[2].read_bytes()
    assert sorted(tmp_path.iterdir()) == paths


def test_forward_kinematics_agrees_with_the_body(smpl_walk: SourceClip) -> None:
    rest = np.zeros((22, 3))
    for joint in range(1, 22):
        rest[joint] = rest[smpl_walk.skeleton.parents[joint]] + smpl_walk.skeleton.offsets_m[joint]
    R_parent_joint = matrix_from_quaternion(smpl_walk.rotation_wxyz)
    joints_m, R_world = forward_kinematics(R_parent_joint, smpl_walk.root_position_m, rest)
    np.testing.assert_allclose(smpl_walk.smpl_joints_m(), joints_m, atol=1e-12)
    np.testing.assert_allclose(smpl_walk.world_rotations(), R_world, atol=1e-12)


def test_joints_that_a_source_lacks_are_nan(smpl_walk: SourceClip) -> None:
    table = smpl_walk.skeleton.smpl_position.copy()
    table[15] = -1
    clip = replace(smpl_walk, skeleton=replace(smpl_walk.skeleton, smpl_position=table))
    joints_m = clip.smpl_joints_m()
    assert np.isnan(joints_m[:, 15]).all()
    assert np.isfinite(np.delete(joints_m, 15, axis=1)).all()


def _changed(path: Path, **arrays: np.ndarray) -> Path:
    with np.load(path) as members:
        tables = dict(members)
    np.savez(path, **{**tables, **arrays})
    return path


def _npz(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize(
    ("breaking", "message"),
    [
        (lambda p: p.with_name("absent.npz"), "no such motion archive"),
        (lambda p: p.parent, "no such motion archive"),
        (lambda p: (p.write_bytes(b"hello"), p)[1], "cannot be read as a motion archive"),
        (lambda p: (p.write_bytes(b""), p)[1], "cannot be read as a motion archive"),
        (lambda p: (p.write_bytes(p.read_bytes()[:500]), p)[1], "cannot be read as a motion archive"),
        (lambda p: (np.save(p.with_suffix(".npy"), np.zeros(3)), p.with_suffix(".npy"))[1], "a single array"),
        (lambda p: _npz(p, poses=np.zeros((4, 3))), "not a motion archive, it lacks format_version"),
        (lambda p: _changed(p, format_version=np.array(2, np.int32)), "version 2, want 1"),
        (lambda p: _changed(p, clip_name=np.array([], "<U4")), "without clips"),
        (lambda p: _changed(p, clip_frames=np.array([5], np.int32)), "contradict each other"),
        (lambda p: _changed(p, skel_parent=np.zeros(22, np.int32)), "contradict each other"),
        (lambda p: _changed(p, clip_fps=np.zeros((2,), np.float32)), "clip_fps wants shape"),
        (lambda p: _changed(p, smpl_names=np.array(["a"])), "22 SMPL joints"),
    ],
)
def test_unusable_archives_are_refused_in_one_line(
    tmp_path: Path, smpl_walk: SourceClip, breaking: Callable[[Path], Path], message: str
) -> None:
    path = tmp_path / "a.npz"
    write_archive(path, [smpl_walk])
    with pytest.raises(InputError, match=message) as caught:
        MotionArchive.read(breaking(path))
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_pickled_objects_are_not_loaded(tmp_path: Path, smpl_walk: SourceClip) -> None:
    path = tmp_path / "a.npz"
    write_archive(path, [smpl_walk])
    with pytest.raises(InputError, match="cannot be read"):
        MotionArchive.read(_changed(path, clip_kind=np.array([{"walk"}], object)))


def test_broken_clips_are_refused_when_asked_for(tmp_path: Path, smpl_walk: SourceClip) -> None:
    path = tmp_path / "a.npz"
    write_archive(path, [smpl_walk])
    with pytest.raises(InputError, match="no clip 'run' among 1"):
        MotionArchive.read(path).clip("run")
    root_m = smpl_walk.root_position_m.astype(np.float32)
    root_m[3, 1] = np.nan
    with pytest.raises(InputError, match="'walk_a' holds NaN"):
        MotionArchive.read(_changed(path, root_pos=root_m)).clip("walk_a")
    with pytest.raises(InputError, match="'walk_a' is cut off"):
        MotionArchive.read(_changed(path, root_pos=root_m[:50])).clip("walk_a")


def test_unwritable_clips_are_refused_and_nothing_is_left(tmp_path: Path, smpl_walk: SourceClip) -> None:
    path = tmp_path / "a.npz"
    broken = replace(smpl_walk, root_position_m=np.full_like(smpl_walk.root_position_m, np.nan))
    short = replace(smpl_walk, rotation_wxyz=smpl_walk.rotation_wxyz[:5])
    for clips, message in (
        ([], "at least one clip"),
        ([smpl_walk, smpl_walk], "comes twice"),
        ([broken], "holds NaN"),
        ([short], "wants"),
    ):
        with pytest.raises(InputError, match=message):
            write_archive(path, clips)
    with pytest.raises(InputError, match="cannot write"):
        write_archive(tmp_path / "nowhere" / "a.npz", [smpl_walk])
    assert not list(tmp_path.iterdir())


def test_splits_are_read_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "split.json"
    path.write_text(json.dumps({"train": ["a", "b"], "val": [], "test": ["c"]}))
    assert read_split(path) == {"train": ("a", "b"), "val": (), "test": ("c",)}
    for text, message in (
        ("{", "cannot be read as JSON"),
        ("[]", "exactly the lists"),
        ('{"train": [], "val": []}', "exactly the lists"),
        ('{"train": [1], "val": [], "test": []}', "'train' wants a list"),
        ('{"train": ["a"], "val": ["a"], "test": []}', "'a' comes twice"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_split(path)
    with pytest.raises(InputError, match="no such split"):
        read_split(tmp_path / "absent.json")


def test_the_shared_archives_are_complete(shared_motion: Path) -> None:
    split = read_split(shared_motion / "split.json")
    names: list[str] = []
    for file in ("cmu.npz", "deepmimic.npz", "bandai.npz", "more.npz", "mhad.npz"):
        archive = MotionArchive.read(shared_motion / file)
        names += archive.names
        clip = archive.clip(archive.names[-1])
        assert clip.fps == 30.0
        joints_m = clip.smpl_joints_m()
        assert joints_m.shape == (len(clip.root_position_m), 22, 3)
        assert 0.6 < np.median(joints_m[:, 0, 1]) < 1.2
    assert sorted(names) == sorted(split["train"] + split["val"] + split["test"])
