"""Training windows made once and kept: features, a scene around each, and the keyframes that scene tells of.

A pool is a folder of shards, each whole or absent, mapped from disk. A training step only picks rows; everything that
costs time (retargeting, kinematics, scenes) is in them already.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int16, UInt8

from scenemi.data.windows import MotionSet
from scenemi.features import FEATURE_COUNT, JOINTS, encode, to_canonical
from scenemi.model.base import join_keyframes
from scenemi.scene.body_balls import BodyBalls, fit_balls
from scenemi.scene.boxes import Boxes
from scenemi.scene.pseudo import PseudoConfig, PseudoScenes
from scenemi.training.keyframe_masks import draw_telling_mask
from scenemi.windows import WINDOW_FRAMES
from video2anim.body.skeleton import forward_kinematics
from video2anim.errors import InputError

SHARD_WINDOWS = 1024
UNITS_PER_METRE = 8192.0
"""Integer steps of a stored feature: windows reach 4 m, and an eighth of a millimetre is far below any noise."""
MOST_BOXES = 16
"""Boxes kept of a scene: the nearest to the true and the blind path."""
_NEAR_M = 0.7
"""Boxes farther than this from both paths are out of the field's reach."""
_INSIDE_M = 0.01
_VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class Shard:
    """Rows of windows, memory-mapped."""

    features: Int16[np.ndarray, "windows frames 201"]
    valid_frames: UInt8[np.ndarray, "windows"]
    """Frames before the window holds its last pose."""
    body: UInt8[np.ndarray, "windows"]
    boxes: Float[np.ndarray, "windows boxes 7"]
    """Center, half extent, yaw; zero rows are no boxes."""
    mask: UInt8[np.ndarray, "windows bytes"]
    """Keyframes whose scene-blind filling the scene was made against, packed bits."""
    collides: UInt8[np.ndarray, "windows"]
    """1 where that filling has a joint more than 1 cm inside."""

    def __len__(self) -> int:
        return len(self.body)


def grow_pool(
    folder: Path,
    motions: MotionSet,
    windows: int,
    *,
    seed: int = 0,
    config: PseudoConfig | None = None,
    on_shard: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Make the shards that are missing until the pool has `windows` windows.

    Args:
        folder: of the pool; a shard's content depends on the motion set, the seed and its number only.
        motions: clips on bodies.
        windows: wanted in all, rounded up to whole shards.
        seed: of everything random.
        config: of the scenes.
        on_shard: called with shards there are and wanted.
    """
    wanted = -(-windows // SHARD_WINDOWS)
    scenes = PseudoScenes(config)
    balls: list[BodyBalls] = []
    for number in range(wanted):
        path = folder / f"shard_{number:04d}"
        if not path.is_dir():
            balls = balls or [fit_balls(motions.body(i)) for i in range(len(motions.shapes))]
            _write(path, _made(motions, scenes, balls, np.random.default_rng([seed, _VERSION, number])))
        on_shard(number + 1, wanted)


def open_pool(folder: Path) -> list[Shard]:
    """The shards that are there.

    Raises:
        InputError: none, or a broken one.
    """
    paths = sorted(folder.glob("shard_????"))
    if not paths:
        raise InputError(f"{folder}: no training windows there; make them with `scenemi train --motion ...`")
    try:
        return [
            Shard(**{f.name: np.load(path / f"{f.name}.npy", mmap_mode="r") for f in fields(Shard)}) for path in paths
        ]
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: broken training windows ({error}); delete the folder") from error


def telling_share(shards: list[Shard]) -> float:
    """Share of the windows with solids in which the scene-blind filling collides."""
    collides = np.concatenate([shard.collides for shard in shards])
    filled = np.concatenate([(shard.boxes[:, 0, 3] > 0) for shard in shards])
    return float(collides[filled].mean()) if filled.any() else float("nan")


def _made(motions: MotionSet, scenes: PseudoScenes, balls: list[BodyBalls], rng: np.random.Generator) -> Shard:
    windows = motions.sample_batch(rng, SHARD_WINDOWS)
    R, translation_m = to_canonical(windows.R_parent_joint, windows.translation_m)
    rest_m = motions.rest_joints_m[windows.body_index]
    features = encode(R, translation_m, rest_m)
    joints_m, R_world = forward_kinematics(R, translation_m, rest_m[:, None])
    valid = windows.valid.sum(1)
    masks = np.stack([draw_telling_mask(rng, WINDOW_FRAMES) for _ in range(SHARD_WINDOWS)])
    masks |= ~windows.valid
    blind = join_keyframes(
        torch.from_numpy(features[..., JOINTS].astype(np.float32)), torch.from_numpy(masks.astype(np.float32))
    )
    blind_m = blind.unflatten(-1, (22, 3)).numpy()
    packed = np.stack([
        scene_boxes(
            scenes, rng, joints_m[i], R_world[i], windows.contact[i], balls[windows.body_index[i]], blind_m[i]
        )
        for i in range(SHARD_WINDOWS)
    ])  # fmt: skip
    collides = np.array([_collides(row, joints) for row, joints in zip(packed, blind_m, strict=True)], np.uint8)
    units = np.clip(np.rint(features * UNITS_PER_METRE), -32767, 32767).astype(np.int16)
    assert units.shape[-1] == FEATURE_COUNT
    return Shard(
        units, valid.astype(np.uint8), windows.body_index.astype(np.uint8), packed,
        np.packbits(masks, axis=1), collides,
    )  # fmt: skip


def scene_boxes(
    scenes: PseudoScenes,
    rng: np.random.Generator,
    joints_m: Float[np.ndarray, "frames 22 3"],
    R_world_joint: Float[np.ndarray, "frames 22 3 3"],
    contact: Bool[np.ndarray, "frames 22"],
    balls: BodyBalls,
    blind_m: Float[np.ndarray, "frames 22 3"],
) -> Float[np.ndarray, "boxes 7"]:
    """A scene around a motion as rows of center, half extent and yaw: the `MOST_BOXES` that come nearest to the body or
    to the scene-blind filling; rows of zeros fill up."""
    named = scenes.solids(rng, joints_m, R_world_joint, None, contact, balls=balls, blind_m=blind_m)
    boxes = _nearest(Boxes.joined(b for _, b in named), np.concatenate([joints_m, blind_m]).reshape(-1, 3))
    packed = np.zeros((MOST_BOXES, 7), np.float32)
    packed[: len(boxes)] = np.concatenate([boxes.center_m, boxes.half_m, boxes.yaw_rad[:, None]], 1)
    return packed


def _collides(packed: Float[np.ndarray, "boxes 7"], joints_m: Float[np.ndarray, "frames 22 3"]) -> bool:
    rows = packed[packed[:, 3] > 0].astype(np.float64)
    return len(rows) > 0 and bool(
        Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6]).signed_distance(joints_m).min() < -_INSIDE_M
    )


def _nearest(boxes: Boxes, points_m: Float[np.ndarray, "points 3"]) -> Boxes:
    """The boxes that come near the points, at most `MOST_BOXES`."""
    if not len(boxes):
        return boxes
    some = points_m[:: max(1, len(points_m) // 600)]
    near = np.array([
        Boxes(boxes.center_m[[k]], boxes.half_m[[k]], boxes.yaw_rad[[k]]).signed_distance(some).min()
        for k in range(len(boxes))
    ])  # fmt: skip
    kept: Int[np.ndarray, "boxes"] = np.argsort(near)[:MOST_BOXES]
    kept = kept[near[kept] < _NEAR_M]
    return Boxes(boxes.center_m[kept], boxes.half_m[kept], boxes.yaw_rad[kept])


def _write(path: Path, shard: Shard) -> None:
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        for item in fields(Shard):
            np.save(aside / f"{item.name}.npy", getattr(shard, item.name), allow_pickle=False)
        (aside / "meta.json").write_text(json.dumps({"version": _VERSION, "telling": float(shard.collides.mean())}))
        if not path.exists():
            os.replace(aside, path)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
