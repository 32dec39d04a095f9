"""Training windows made once and kept: features, a scene around each, and the keyframes that scene tells of.

A pool is a folder of shards, each whole or absent, mapped from disk. A training step only picks rows; everything that
costs time (retargeting, kinematics, scenes) is in them already.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8, Int16, UInt8

from scenemi.data.windows import MotionSet, WindowBatch
from scenemi.features import FEATURE_COUNT, JOINTS, canonical_frame, encode, to_canonical
from scenemi.metrics import INSIDE_M
from scenemi.model.base import join_keyframes
from scenemi.scene.body_spheres import BodySpheres, fit_spheres
from scenemi.scene.boxes import Boxes
from scenemi.scene.pseudo import SyntheticSceneConfig, SyntheticScenes
from scenemi.scene.rows import BoxRows, SceneRows, VolumeRows
from scenemi.training.keyframe_masks import draw_telling_mask
from scenemi.training.scene_pool import SceneMotions
from scenemi.windows import WINDOW_FRAMES
from video2anim.errors import InputError
from video2anim.types.skeleton import forward_kinematics

SHARD_WINDOWS = 1024
"""Made at once: 50 MB of features."""
_MAX_UNITS = np.iinfo(np.int16).max
UNITS_PER_METER = 8192.0
"""Integer steps of a stored feature: windows reach 4 m, and an eighth of a millimeter is far below any noise."""
MAX_BOXES = 16
"""Boxes kept of a scene: the nearest to the true and the blind path."""
_NEAR_M = 0.7
"""Boxes farther than this from both paths are out of the field's reach."""
_POINT_STEP = 9
"""Of all joints in all frames so many are skipped: no factor in common with 22, so that each joint is looked at."""
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


@dataclass(frozen=True, slots=True, eq=False)
class SceneShard:
    """The same of captured clips in their scenes."""

    features: Int16[np.ndarray, "windows frames 201"]
    valid_frames: UInt8[np.ndarray, "windows"]
    body: UInt8[np.ndarray, "windows"]
    values: Int8[np.ndarray, "windows x y z"]
    """Distances to solids around each window, see `scenemi.scene.field.VolumeField`."""
    place: Float[np.ndarray, "windows 6"]
    """First node and steps of the nodes."""
    mask: UInt8[np.ndarray, "windows bytes"]
    collides: UInt8[np.ndarray, "windows"]

    def __len__(self) -> int:
        return len(self.body)


AnyShard = Shard | SceneShard


def grow_pool(
    folder: Path,
    motions: MotionSet,
    windows: int,
    *,
    seed: int = 0,
    on_shard: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Make the shards that are missing until the pool has `windows` windows.

    Args:
        folder: of the pool; a shard's content depends on the motion set, the seed and its number only.
        motions: clips on bodies.
        windows: wanted in all, rounded up to whole shards.
        seed: of everything random.
        on_shard: called with shards there are and wanted.

    Raises:
        InputError: the shards that are there were made of other motion, or by other rules.
    """
    scenes = SyntheticScenes()
    made_of = _digest(motions, seed, scenes.config)
    for path in sorted(folder.glob("shard_????")):
        if _meta(path).get("made_of") != made_of:
            raise InputError(f"{folder}: training windows of other motion or of an older version; delete the folder")
    wanted = -(-windows // SHARD_WINDOWS)
    spheres: list[BodySpheres] = []
    for number in range(wanted):
        path = folder / f"shard_{number:04d}"
        if not path.is_dir():
            rng = np.random.default_rng([seed, _VERSION, number])
            if isinstance(motions, SceneMotions):
                write_shard(path, _captured(motions, rng), made_of)
            else:
                spheres = spheres or [fit_spheres(motions.body(i)) for i in range(len(motions.shapes))]
                write_shard(path, made_shard(motions, scenes, spheres, rng), made_of)
        on_shard(number + 1, wanted)


def open_pool(folder: Path) -> list[AnyShard]:
    """The shards that are there.

    Raises:
        InputError: none, or a broken one.
    """
    paths = sorted(folder.glob("shard_????"))
    if not paths:
        raise InputError(f"{folder}: no training windows there; make them with `scenemi train --motion ...`")
    try:
        return [_opened(path, SceneShard if (path / "values.npy").is_file() else Shard) for path in paths]
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{folder}: broken training windows ({error}); delete the folder") from error


def stored_scenes(picked: Sequence[tuple[AnyShard, int]]) -> SceneRows:
    """Scenes of rows of shards, which are all of one kind."""
    boxes = [shard.boxes[row] for shard, row in picked if isinstance(shard, Shard)]
    if boxes:
        return BoxRows(torch.from_numpy(np.stack(boxes)))
    captured = [(shard.values[row], shard.place[row]) for shard, row in picked if isinstance(shard, SceneShard)]
    values, place = (torch.from_numpy(np.stack(one)) for one in zip(*captured, strict=True))
    return VolumeRows(values, place)


def _opened(path: Path, kind: type[Shard] | type[SceneShard]) -> AnyShard:
    names = [item.name for item in fields(kind)]
    return kind(**{name: np.load(path / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in names})


def telling_share(shards: Sequence[AnyShard]) -> float:
    """Share of the windows with solids in which the scene-blind filling collides."""
    collides = np.concatenate([shard.collides for shard in shards])
    filled = np.concatenate([stored_scenes([(shard, row) for row in range(len(shard))]).filled for shard in shards])
    return float(collides[filled].mean()) if filled.any() else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """Windows of a shard in their canonical frames, their keyframes and the scene-blind filling of these."""

    windows: WindowBatch
    units: Int16[np.ndarray, "windows frames 201"]
    joints_m: Float[np.ndarray, "windows frames 22 3"]
    R_world: Float[np.ndarray, "windows frames 22 3 3"]
    masks: Bool[np.ndarray, "windows frames"]
    blind_m: Float[np.ndarray, "windows frames 22 3"]

    @classmethod
    def of(cls, motions: MotionSet, rng: np.random.Generator) -> _Drawn:
        windows = motions.sample_batch(rng, SHARD_WINDOWS)
        R, translation_m = to_canonical(windows.R_parent_joint, windows.translation_m)
        rest_m = motions.rest_joints_m[windows.body_index]
        features = encode(R, translation_m, rest_m)
        joints_m, R_world = forward_kinematics(R, translation_m, rest_m[:, None])
        masks = np.stack([draw_telling_mask(rng, WINDOW_FRAMES) for _ in range(SHARD_WINDOWS)])
        masks |= ~windows.valid
        blind = join_keyframes(
            torch.from_numpy(features[..., JOINTS].astype(np.float32)), torch.from_numpy(masks.astype(np.float32))
        )
        units = np.clip(np.rint(features * UNITS_PER_METER), -_MAX_UNITS, _MAX_UNITS).astype(np.int16)
        assert units.shape[-1] == FEATURE_COUNT
        return cls(windows, units, joints_m, R_world, masks, blind.unflatten(-1, (22, 3)).numpy())

    def columns(self) -> dict[str, np.ndarray]:
        """What shards of both kinds have."""
        return {
            "features": self.units, "valid_frames": self.windows.valid.sum(1).astype(np.uint8),
            "body": self.windows.body_index.astype(np.uint8), "mask": np.packbits(self.masks, axis=1),
        }  # fmt: skip


def made_shard(
    motions: MotionSet, scenes: SyntheticScenes, spheres: list[BodySpheres], rng: np.random.Generator
) -> Shard:
    """Random windows with made-up scenes; `spheres` of each body of the motion set."""
    drawn = _Drawn.of(motions, rng)
    contact, body, blind_m = drawn.windows.contact, drawn.windows.body_index, drawn.blind_m
    packed = np.stack([
        scene_boxes(scenes, rng, drawn.joints_m[i], drawn.R_world[i], contact[i], spheres[body[i]], blind_m[i])
        for i in range(SHARD_WINDOWS)
    ])  # fmt: skip
    collides = np.array([_collides(row, joints) for row, joints in zip(packed, blind_m, strict=True)], np.uint8)
    return Shard(boxes=packed, collides=collides, **drawn.columns())


def _captured(motions: SceneMotions, rng: np.random.Generator) -> SceneShard:
    drawn = _Drawn.of(motions, rng)
    windows = drawn.windows
    T = canonical_frame(windows.R_parent_joint[:, 0, 0], windows.translation_m[:, 0])
    around_m = np.concatenate([drawn.joints_m, drawn.blind_m], 1).reshape(SHARD_WINDOWS, -1, 3)
    rows = motions.volumes(T, windows.clip, windows.body_index, around_m)
    field = rows.field(torch.ones(SHARD_WINDOWS))
    collides = field.solids_m(torch.from_numpy(drawn.blind_m).float().flatten(1, 2)).amin(1) < -INSIDE_M
    return SceneShard(
        values=rows.values.numpy(),
        place=rows.place.numpy(),
        collides=collides.numpy().astype(np.uint8),
        **drawn.columns(),
    )


def scene_boxes(
    scenes: SyntheticScenes,
    rng: np.random.Generator,
    joints_m: Float[np.ndarray, "frames 22 3"],
    R_world_joint: Float[np.ndarray, "frames 22 3 3"],
    contact: Bool[np.ndarray, "frames 22"],
    spheres: BodySpheres,
    blind_m: Float[np.ndarray, "frames 22 3"],
) -> Float[np.ndarray, "boxes 7"]:
    """A scene around a motion as rows of center, half extent and yaw: the `MAX_BOXES` that come nearest to the body or
    to the scene-blind filling; rows of zeros fill up."""
    named = scenes.solids(rng, joints_m, R_world_joint, None, contact, spheres=spheres, blind_m=blind_m)
    boxes = _nearest(Boxes.joined(b for _, b in named), np.concatenate([joints_m, blind_m]).reshape(-1, 3))
    packed = np.zeros((MAX_BOXES, 7), np.float32)
    packed[: len(boxes)] = np.concatenate([boxes.center_m, boxes.half_m, boxes.yaw_rad[:, None]], 1)
    return packed


def _collides(packed: Float[np.ndarray, "boxes 7"], joints_m: Float[np.ndarray, "frames 22 3"]) -> bool:
    rows = packed[packed[:, 3] > 0].astype(np.float64)
    return len(rows) > 0 and bool(
        Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6]).signed_distance(joints_m).min() < -INSIDE_M
    )


def _nearest(boxes: Boxes, points_m: Float[np.ndarray, "points 3"]) -> Boxes:
    """The boxes that come near the points, at most `MAX_BOXES`."""
    if not len(boxes):
        return boxes
    some = points_m[::_POINT_STEP]
    near = np.array([
        Boxes(boxes.center_m[[k]], boxes.half_m[[k]], boxes.yaw_rad[[k]]).signed_distance(some).min()
        for k in range(len(boxes))
    ])  # fmt: skip
    kept: Int[np.ndarray, "boxes"] = np.argsort(near)[:MAX_BOXES]
    kept = kept[near[kept] < _NEAR_M]
    return Boxes(boxes.center_m[kept], boxes.half_m[kept], boxes.yaw_rad[kept])


def _digest(motions: MotionSet, seed: int, config: SyntheticSceneConfig) -> str:
    """Of all that decides what a shard holds."""
    # Values without their names: a renamed option makes no other windows.
    digest = hashlib.sha256(repr((_VERSION, seed, astuple(config), astuple(motions.config))).encode())
    store = motions.store
    for table in (motions.rest_joints_m, store.clip_name, store.piece_clip, store.piece_first, store.piece_frames):
        digest.update(np.ascontiguousarray(table).tobytes())
    return digest.hexdigest()[:16]


def _meta(path: Path) -> dict[str, Any]:
    try:
        return json.loads((path / "meta.json").read_text())
    except (OSError, ValueError):
        return {}


def write_shard(path: Path, shard: AnyShard, made_of: str) -> None:
    """Write a shard and a digest of all that decides what it holds; the folder is whole or absent."""
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        for item in fields(shard):
            np.save(aside / f"{item.name}.npy", getattr(shard, item.name), allow_pickle=False)
        (aside / "meta.json").write_text(json.dumps({"made_of": made_of, "telling": float(shard.collides.mean())}))
        if not path.exists():
            os.replace(aside, path)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
