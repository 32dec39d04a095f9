"""Training windows: what is drawn, how short clips, glitches, splits and licenses are treated, the cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenemi.data.adults import draw_adults
from scenemi.data.container import write_archive
from scenemi.data.motion_store import StoreConfig, load_store
from scenemi.data.source_clip import SourceClip
from scenemi.data.split import Split
from scenemi.data.windows import ARMS_AND_HEAD, MotionSet, MotionSetConfig
from video2anim.body.anny_body import shaped_body
from video2anim.errors import InputError
from video2anim.types.skeleton import MIRROR_JOINT, forward_kinematics

PLAIN = MotionSetConfig(mirror=0.0, warp=0.0, store=StoreConfig(bodies_per_clip=2))


def archive(path: Path, clips: Sequence[SourceClip]) -> Path:
    write_archive(path, clips)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, smpl_walk: SourceClip) -> Path:
    """A long walk (four in a row), a short one, one of a non-commercial source."""
    out = tmp_path_factory.mktemp("motion")
    forth = smpl_walk.root_position_m
    step = (forth[-1] - forth[0]) * [1, 0, 1]
    long = replace(
        smpl_walk,
        name="long",
        root_position_m=np.concatenate([forth + i * step for i in range(4)]),
        rotation_wxyz=np.concatenate([smpl_walk.rotation_wxyz] * 4),
    )
    short = replace(
        smpl_walk, name="short", root_position_m=forth[:50], rotation_wxyz=smpl_walk.rotation_wxyz[:50], kind="turn"
    )
    archive(out / "a.npz", [long, short])
    archive(out / "b.npz", [replace(smpl_walk, name="theirs", source="bandai1")])
    return out


@pytest.fixture(scope="module")
def clips(folder: Path) -> MotionSet:
    return MotionSet.build([folder], Split({"long": "train", "short": "train"}), "train", 3, PLAIN)


def test_windows_are_stretches_of_clips(clips: MotionSet) -> None:
    store = clips.store
    batch = clips.sample_batch(np.random.default_rng(0), 32)
    assert batch.R_parent_joint.shape == (32, 121, 22, 3, 3)
    assert batch.R_parent_joint.dtype == batch.translation_m.dtype == np.float32
    for row in range(32):
        window = clips.one(batch, row)
        pieces = np.flatnonzero((store.piece_clip == batch.clip[row]) & (store.piece_body == window.body_index))
        assert len(pieces) == 1
        begin, length = int(store.piece_start[pieces[0]]), int(store.piece_frames[pieces[0]])
        path = store.translation_m[begin : begin + length]
        start = int(np.abs(path - window.translation_m[0]).sum(1).argmin())
        count = int(window.valid.sum())
        np.testing.assert_array_equal(window.translation_m[:count], path[start : start + count])
        assert count == min(121, length)
        assert (window.translation_m[count:] == path[-1]).all()


def test_short_clips_are_held_and_marked(clips: MotionSet) -> None:
    rng = np.random.default_rng(1)
    windows = [clips.sample(rng) for _ in range(40)]
    short = [window for window in windows if window.name == "short"]
    assert short
    assert {int(window.valid.sum()) for window in short} == {50}
    held = short[0].R_parent_joint[50:]
    np.testing.assert_array_equal(held, np.broadcast_to(held[0], held.shape))
    assert short[0].kind == "turn"
    assert all(window.valid.all() for window in windows if window.name == "long")


def test_draws_repeat_with_their_seed(clips: MotionSet) -> None:
    varied = MotionSet(clips.store, clips.shapes, replace(PLAIN, mirror=0.5, warp=0.5))
    one, two = (varied.sample_batch(np.random.default_rng(5), 8) for _ in range(2))
    np.testing.assert_array_equal(one.R_parent_joint, two.R_parent_joint)
    other = varied.sample_batch(np.random.default_rng(6), 8)
    assert not np.array_equal(one.translation_m, other.translation_m)


def test_mirrored_windows_are_reflections(clips: MotionSet) -> None:
    mirrored = MotionSet(clips.store, clips.shapes, replace(PLAIN, mirror=1.0))
    a, b = (s.sample_batch(np.random.default_rng(2), 6) for s in (clips, mirrored))
    np.testing.assert_array_equal(a.translation_m * np.float32([-1, 1, 1]), b.translation_m)
    np.testing.assert_array_equal(a.contact[:, :, MIRROR_JOINT], b.contact)
    flip = np.float32([-1, 1, 1])
    reflected = a.R_parent_joint[:, :, MIRROR_JOINT] * flip[:, None] * flip
    np.testing.assert_allclose(b.R_parent_joint, reflected, atol=1e-6)


def test_warped_windows_are_rotations_of_other_speed(clips: MotionSet) -> None:
    warped = MotionSet(clips.store, clips.shapes, replace(PLAIN, warp=1.0))
    batch = warped.sample_batch(np.random.default_rng(3), 64)
    R = batch.R_parent_joint
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-5)
    full = batch.valid.all(1)
    speed = np.linalg.norm(np.diff(batch.translation_m[:, :, [0, 2]], axis=1), axis=-1).mean(1)[full]
    plain = clips.sample_batch(np.random.default_rng(3), 64)
    usual = np.linalg.norm(np.diff(plain.translation_m[:, :, [0, 2]], axis=1), axis=-1).mean(1)[plain.valid.all(1)]
    assert speed.max() > 1.1 * np.median(usual)
    assert speed.min() < 0.9 * np.median(usual)


def test_reversed_windows_are_clips_run_backward(clips: MotionSet) -> None:
    one = MotionSet(clips.store, clips.shapes, replace(clips.config, mirror=0.0, warp=0.0))
    back = MotionSet(clips.store, clips.shapes, replace(one.config, reverse=1.0))
    a, b = (motions.sample_batch(np.random.default_rng(3), 16) for motions in (one, back))
    whole = a.valid.all(1)
    assert whole.any()
    np.testing.assert_array_equal(b.R_parent_joint[whole], a.R_parent_joint[whole, ::-1])
    np.testing.assert_array_equal(b.translation_m[whole], a.translation_m[whole, ::-1])
    np.testing.assert_array_equal(b.translation_m[~whole], a.translation_m[~whole])


def test_mixed_windows_have_the_arms_of_another_and_their_own_legs(clips: MotionSet) -> None:
    one = MotionSet(clips.store, clips.shapes, replace(clips.config, mirror=0.0, warp=0.0))
    mixing = MotionSet(clips.store, clips.shapes, replace(one.config, mix=1.0))
    a, b = (motions.sample_batch(np.random.default_rng(4), 16) for motions in (one, mixing))
    legs = np.setdiff1d(np.arange(22), ARMS_AND_HEAD)
    assert len(ARMS_AND_HEAD) == 10
    np.testing.assert_array_equal(b.translation_m, a.translation_m)
    np.testing.assert_array_equal(b.R_parent_joint[:, :, legs], a.R_parent_joint[:, :, legs])
    changed = 0
    for row in range(16):
        arms = b.R_parent_joint[row][:, ARMS_AND_HEAD]
        sources = [i for i in range(16) if np.array_equal(arms, a.R_parent_joint[i][:, ARMS_AND_HEAD])]
        assert sources
        changed += row not in sources
        np.testing.assert_array_equal(b.contact[row][:, ARMS_AND_HEAD], a.contact[sources[0]][:, ARMS_AND_HEAD])
    assert changed > 4


def test_feet_stay_on_the_ground_of_their_body(clips: MotionSet) -> None:
    batch = clips.sample_batch(np.random.default_rng(4), 16)
    rest = clips.rest_joints_m[batch.body_index][:, None]
    joints_m, _ = forward_kinematics(batch.R_parent_joint, batch.translation_m, rest)
    height = joints_m[..., [10, 11], 1].min(-1)
    assert height.min() > -0.02
    assert np.median(height) < 0.06
    assert set(batch.body_index.tolist()) <= {0, 1, 2}


def test_fixed_windows_cover_the_data_once(clips: MotionSet) -> None:
    windows = list(clips.fixed_windows(batch=4))
    valid = sum(int(batch.valid.sum()) for batch in windows)
    per_piece = clips.store.piece_frames
    rest = per_piece % 121
    assert valid == int((per_piece - np.where(rest < 30, rest, 0)).sum())
    full = list(clips.fixed_windows(full_only=True, body=0))
    assert all(batch.valid.all() for batch in full)
    assert all((batch.body_index == 0).all() for batch in full)


def test_licences_splits_and_kinds_choose(folder: Path, clips: MotionSet) -> None:
    assert "theirs" not in set(clips.store.clip_name)
    split = Split({"long": "train", "short": "val", "theirs": "train"})
    everything = MotionSet.build([folder], split, "train", 1, replace(PLAIN, noncommercial=True))
    assert set(everything.store.clip_name) == {"long", "theirs"}
    assert set(MotionSet.build([folder], split, "val", 1, PLAIN).store.clip_name) == {"short"}
    with pytest.raises(InputError, match="no clip of part 'test'"):
        MotionSet.build([folder], split, "test", 1, PLAIN)
    only = MotionSet.build([folder], None, None, 1, replace(PLAIN, sources=("bandai1",)))
    assert set(only.store.clip_name) == {"theirs"}
    with pytest.raises(InputError, match="passes the choice"):
        MotionSet.build([folder], None, None, 1, replace(PLAIN, kinds=("swim",)))


def test_unnamed_clips_are_split_by_their_name_alone() -> None:
    split = Split({"x": "val"})
    parts = [split.part_of(f"synthetic_{i:05d}") for i in range(2000)]
    assert split.part_of("x") == "val"
    assert parts == [Split().part_of(f"synthetic_{i:05d}") for i in range(2000)]
    assert 0.03 < parts.count("val") / 2000 < 0.07
    assert 0.03 < parts.count("test") / 2000 < 0.07


def test_glitches_are_cut_out(tmp_path: Path, smpl_walk: SourceClip) -> None:
    jump = smpl_walk.root_position_m.copy()
    jump[60:] += [0.0, 0.0, 1.0]
    path = archive(tmp_path / "j.npz", [replace(smpl_walk, root_position_m=jump, uneven=True)])
    clips = MotionSet.build([path], None, None, 1, PLAIN)
    assert len(clips.store.piece_frames) == 2
    assert clips.store.piece_frames.sum() < 120
    steps = [np.diff(clips.store.translation_m[a : a + n], axis=0) for a, n in zip(*pieces(clips), strict=True)]
    assert max(np.abs(step).max() for step in steps) < 0.2


def pieces(clips: MotionSet) -> tuple[np.ndarray, np.ndarray]:
    return clips.store.piece_start, clips.store.piece_frames


def test_the_cache_gives_the_same_windows(tmp_path: Path, folder: Path) -> None:
    calls: list[int] = []
    built = [
        MotionSet.build([folder], None, None, 2, PLAIN, cache=tmp_path, progress=lambda done, _: calls.append(done))
        for _ in range(2)
    ]
    assert len(calls) == 4
    batches = [clips.sample_batch(np.random.default_rng(0), 4) for clips in built]
    np.testing.assert_array_equal(batches[0].R_parent_joint, batches[1].R_parent_joint)
    assert len(list(tmp_path.iterdir())) == 1
    MotionSet.build([folder], None, None, 3, PLAIN, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    broken = next(tmp_path.iterdir())
    (broken / "translation_m.npy").unlink()
    with pytest.raises(InputError, match="delete the folder"):
        load_store(broken)


def test_drawn_bodies_are_adults_and_a_longer_draw_begins_alike() -> None:
    shapes = draw_adults(7)
    assert shapes[:3] == draw_adults(3)
    statures = [float(np.ptp(shaped_body(shape).rest_vertices_m[:, 1])) for shape in shapes]
    assert 1.45 < min(statures) < 1.7
    assert 1.75 < max(statures) < 2.0
    assert draw_adults(3, seed=1)[1:] != shapes[1:3]


def test_captured_clips_make_windows(shared_motion: Path) -> None:
    config = replace(PLAIN, kinds=("sport", "acrobatics"), mirror=0.5, warp=0.5)
    split = Split.read(shared_motion / "split.json")
    clips = MotionSet.build([shared_motion], split, "train", 2, config)
    assert set(clips.store.clip_source) <= {"cmu_cc60", "cmu_daz", "cmu_expmap38", "cmu_humanoid44", "deepmimic"}
    assert clips.minutes > 2
    batch = clips.sample_batch(np.random.default_rng(0), 32)
    rest = clips.rest_joints_m[batch.body_index][:, None]
    joints_m, _ = forward_kinematics(batch.R_parent_joint, batch.translation_m, rest)
    speed_up = np.linalg.norm(np.diff(joints_m, n=2, axis=1), axis=-1) * 900
    assert speed_up[:, :-2].max() < 700
    assert {clips.one(batch, i).kind for i in range(32)} == {"sport", "acrobatics"}
