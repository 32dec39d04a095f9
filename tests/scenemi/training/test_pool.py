"""Windows made once: whole shards or none, the same for the same seed, true to the motion, with scenes that tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_run import PLAIN, SHARD, write_procedural

from scenemi.data.windows import MotionSet, WindowBatch
from scenemi.features import JOINTS, encode
from scenemi.model.base import join_keyframes
from scenemi.scene.body_spheres import adult_spheres
from scenemi.scene.boxes import Boxes
from scenemi.training import pool
from scenemi.training.pool import Shard, grow_pool, open_pool, scene_boxes, telling_share
from video2anim.errors import InputError
from video2anim.types.skeleton import JOINT_INDEX

UNITS_PER_METER = 8192.0
"""Of a stored pool's integers."""

FEW = 6


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "SHARD_WINDOWS", FEW)


def same(a: Shard, b: Shard) -> bool:
    return all(np.array_equal(getattr(a, item.name), getattr(b, item.name)) for item in fields(Shard))


def boxes_of(row: np.ndarray) -> Boxes:
    rows = row[row[:, 3] > 0].astype(float)
    return Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6])


def masks_of(shard: Shard) -> np.ndarray:
    return np.unpackbits(shard.mask, axis=1)[:, :121].astype(bool)


def joints_m(shard: Shard) -> np.ndarray:
    return (shard.features[..., JOINTS] / UNITS_PER_METER).reshape(len(shard), 121, 22, 3)


def blind_m(shard: Shard) -> np.ndarray:
    import torch

    true = torch.from_numpy(joints_m(shard).reshape(len(shard), 121, 66)).float()
    return join_keyframes(true, torch.from_numpy(masks_of(shard)).float()).unflatten(-1, (22, 3)).numpy()


@pytest.mark.usefixtures("few")
def test_shards_are_whole_or_absent(motions: MotionSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole: Callable[..., None] = np.save
    written: list[Any] = []

    def breaks(path: Any, *words: Any, **options: Any) -> None:
        written.append(path)
        if len(written) == 3:
            raise OSError("no space left")
        whole(path, *words, **options)

    monkeypatch.setattr(np, "save", breaks)
    with pytest.raises(OSError, match="no space"):
        grow_pool(tmp_path, motions, 1)
    assert list(tmp_path.iterdir()) == [], "neither a shard nor the rest of one"
    grow_pool(tmp_path, motions, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["shard_0000"]
    assert len(open_pool(tmp_path)[0]) == FEW


@pytest.mark.usefixtures("few")
def test_a_shard_is_the_same_for_the_same_seed_whenever_it_is_made(motions: MotionSet, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    grow_pool(tmp_path / "a", motions, 2 * FEW, on_shard=lambda *done: told.append(done))
    assert told == [(1, 2), (2, 2)]
    grow_pool(tmp_path / "b", motions, 1)
    made_at = (tmp_path / "b" / "shard_0000" / "features.npy").stat().st_mtime_ns
    grow_pool(tmp_path / "b", motions, 2 * FEW)
    assert (tmp_path / "b" / "shard_0000" / "features.npy").stat().st_mtime_ns == made_at
    first, second = open_pool(tmp_path / "a"), open_pool(tmp_path / "b")
    assert all(same(x, y) for x, y in zip(first, second, strict=True))
    assert not same(*first)
    grow_pool(tmp_path / "c", motions, 1, seed=1)
    assert not same(first[0], open_pool(tmp_path / "c")[0])


@pytest.mark.usefixtures("few")
def test_shards_of_other_motion_are_not_added_to(motions: MotionSet, tmp_path: Path) -> None:
    grow_pool(tmp_path / "pool", motions, 1)
    other = MotionSet.build([write_procedural(tmp_path / "a.npz", ("walk",))], None, None, bodies=1, config=PLAIN)
    for changed, seed in ((other, 0), (motions, 1)):
        with pytest.raises(InputError, match="other motion or of an older version; delete"):
            grow_pool(tmp_path / "pool", changed, 2 * FEW, seed=seed)
    (tmp_path / "pool" / "shard_0000" / "meta.json").unlink()
    with pytest.raises(InputError, match="delete the folder"):
        grow_pool(tmp_path / "pool", motions, 1)


@pytest.mark.usefixtures("few")
def test_stored_features_are_those_of_the_motion(
    motions: MotionSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[WindowBatch] = []
    plain = MotionSet.sample_batch

    def seen(self: MotionSet, rng: np.random.Generator, count: int) -> WindowBatch:
        drawn.append(plain(self, rng, count))
        return drawn[-1]

    monkeypatch.setattr(MotionSet, "sample_batch", seen)
    grow_pool(tmp_path, motions, 1)
    (shard,), (windows,) = open_pool(tmp_path), drawn
    true = encode(windows.R_parent_joint, windows.translation_m, motions.rest_joints_m[windows.body_index])
    assert np.abs(shard.features / UNITS_PER_METER - true).max() < 1 / 8192
    assert shard.features.dtype == np.int16
    np.testing.assert_array_equal(shard.valid_frames, windows.valid.sum(1))
    np.testing.assert_array_equal(shard.body, windows.body_index)


def test_held_frames_and_both_ends_are_keyframes(archive: Path, tmp_path: Path) -> None:
    """Windows of clips that are shorter than a window hold their last pose."""
    motions = MotionSet.build([archive], None, None, bodies=1, config=PLAIN)
    motions.store.piece_frames[:] = 70
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "SHARD_WINDOWS", FEW)
        grow_pool(tmp_path, motions, 1)
    (shard,) = open_pool(tmp_path)
    mask = masks_of(shard)
    assert (shard.valid_frames == 70).all()
    assert mask[:, 70:].all()
    assert mask[:, 0].all()
    assert not mask[:, 1:14].any(), "keyframes that a scene tells of are 15 frames apart or more"
    held = shard.features[:, 69:]
    np.testing.assert_array_equal(held, np.broadcast_to(held[:, :1], held.shape))


def test_no_box_has_the_true_body_in_it(shards: list[Shard]) -> None:
    for shard in shards:
        for row, joints in zip(shard.boxes, joints_m(shard), strict=True):
            if row[0, 3] > 0:
                assert boxes_of(row).signed_distance(joints).min() > -0.01


def test_collisions_are_those_of_the_joined_keyframes(shards: list[Shard]) -> None:
    found = []
    for shard in shards:
        for row, joints, collides in zip(shard.boxes, blind_m(shard), shard.collides, strict=True):
            depth_m = boxes_of(row).signed_distance(joints).min() if row[0, 3] > 0 else np.inf
            if abs(depth_m + 0.01) > 1e-3:
                assert (depth_m < -0.01) == bool(collides)
                found.append(collides)
    assert 0 < np.mean(found) < 1
    filled = np.concatenate([shard.boxes[:, 0, 3] > 0 for shard in shards])
    every = np.concatenate([shard.collides for shard in shards])
    assert telling_share(shards) == pytest.approx(every[filled].mean())


def test_rows_of_boxes_come_before_rows_of_zeros(shards: list[Shard]) -> None:
    for shard in shards:
        filled = shard.boxes[..., 3] > 0
        assert (filled[:, :-1] >= filled[:, 1:]).all()
        assert not shard.boxes[~filled].any()
        assert shard.boxes.shape == (SHARD, 16, 7)


def test_scenes_block_the_interpolation_of_a_third_of_procedural_walks(tmp_path: Path) -> None:
    path = write_procedural(tmp_path / "walks.npz", ("walk",) * 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "SHARD_WINDOWS", 64)
        grow_pool(tmp_path / "pool", MotionSet.build([path], None, None, bodies=1, config=PLAIN), 64)
    (shard,) = open_pool(tmp_path / "pool")
    assert telling_share([shard]) > 1 / 3
    sparse = masks_of(shard).sum(1) <= 4
    assert shard.collides[sparse].mean() > 0.5


class Furnished:
    """Scenes with always the same boxes."""

    def __init__(self, center_m: np.ndarray, half_m: float) -> None:
        self.boxes = Boxes(center_m, np.full_like(center_m, half_m), np.zeros(len(center_m)))

    def solids(self, *_: Any, **__: Any) -> list[tuple[str, Boxes]]:
        return [("box", self.boxes)]


@pytest.mark.parametrize("joint", ["pelvis", "head", "left_wrist", "right_wrist", "right_knee"])
def test_the_nearest_boxes_are_kept_whichever_joint_they_are_near(motions: MotionSet, joint: str) -> None:
    """One box touches a joint; more than are kept stand a hand away from the feet."""
    rest_m = motions.rest_joints_m[0].astype(float) + np.array([0.0, 1.0, 0.0])
    still_m = np.repeat(rest_m[None], 121, 0)
    others = [rest_m[JOINT_INDEX[f"{side}_foot"]] + [0.0, -0.12 - 0.001 * k, 0.0] for side in ("left", "right")
              for k in range(10)]  # fmt: skip
    touching = rest_m[JOINT_INDEX[joint]] + [0.0, 0.0, 0.02]
    made = scene_boxes(
        Furnished(np.array([*others, touching]), 0.01), np.random.default_rng(0), still_m,  # type: ignore[arg-type]
        np.broadcast_to(np.eye(3), (121, 22, 3, 3)), np.zeros((121, 22), bool), adult_spheres(), still_m,
    )  # fmt: skip
    assert made.shape == (16, 7)
    assert (made[:, 3] > 0).all()
    assert np.linalg.norm(made[:, :3] - touching, axis=1).min() < 1e-6


def test_boxes_out_of_reach_are_left_out(motions: MotionSet) -> None:
    rest_m = motions.rest_joints_m[0].astype(float)
    still_m = np.repeat(rest_m[None], 121, 0)
    far = Furnished(np.array([[2.5, 0.0, 0.0], [1.2, rest_m[20, 1], 0.0]]), 0.1)
    made = scene_boxes(
        far, np.random.default_rng(0), still_m, np.broadcast_to(np.eye(3), (121, 22, 3, 3)),  # type: ignore[arg-type]
        np.zeros((121, 22), bool), adult_spheres(), still_m,
    )  # fmt: skip
    np.testing.assert_allclose(made[0, :3], [1.2, rest_m[20, 1], 0.0], atol=1e-6)
    assert not made[1:].any()


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("harm", ["missing", "short", "empty"])
def test_a_missing_or_broken_pool_says_so(motions: MotionSet, tmp_path: Path, harm: str) -> None:
    with pytest.raises(InputError, match="no training windows there"):
        open_pool(tmp_path)
    grow_pool(tmp_path, motions, 1)
    path = tmp_path / "shard_0000" / "features.npy"
    if harm == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:1000] if harm == "short" else b"")
    with pytest.raises(InputError, match="broken training windows"):
        open_pool(tmp_path)
