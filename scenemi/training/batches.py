"""Batches by step: everything random about a step comes from (seed, step), so a run can be cut anywhere.

The whole global batch is drawn alike in every process; each keeps its share.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from scenemi.features import Statistics, body_lengths, encode, to_canonical
from scenemi.model.diffusion import STEPS
from scenemi.scene.basis_points import anchor_vertices
from scenemi.scene.body_balls import fit_balls
from scenemi.scene.pseudo import PseudoConfig, PseudoScenes
from scenemi.scene.voxels import GridSpec
from scenemi.training.config import TrainConfig
from scenemi.training.keyframe_masks import draw_mask
from video2anim.body.skeleton import forward_kinematics

if TYPE_CHECKING:
    from scenemi.data.windows import MotionSet, WindowBatch

_STATISTICS_WINDOWS = 1024
LOOKED_AT = 31


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """One step's windows, in the canonical frame; float32 unless said."""

    R_parent_joint: Float[Tensor, "batch frames 22 3 3"]
    translation_m: Float[Tensor, "batch frames 3"]
    rest_joints_m: Float[Tensor, "batch 22 3"]
    body: Float[Tensor, "batch 7"]
    """In standard deviations."""
    valid: Float[Tensor, "batch frames"]
    mask: Float[Tensor, "batch frames"]
    occupancy: Float[Tensor, "batch x y z"]
    """uint8."""
    local: Float[Tensor, "batch frames anchors 3"]
    """float16, m."""
    scene_known: Float[Tensor, "batch"]
    local_known: Float[Tensor, "batch"]
    noise_level: Float[Tensor, "batch"]
    turn_noise: Float[Tensor, "batch frames 22 3"]
    """Unit Gaussian."""
    shift_noise: Float[Tensor, "batch frames 3"]
    """Unit Gaussian."""
    step: Float[Tensor, "batch"]
    """Diffusion step, int64."""
    noise: Float[Tensor, "batch frames 201"]
    """Of the forward process."""
    looked_at: Int[Tensor, "batch"]
    """First of the `LOOKED_AT` frames in which joints are compared."""
    part: Int[Tensor, "batch"]
    """Which part of the clips a window is of (`scenemi.training.joiner`)."""

    def chosen(self, index: Tensor) -> Batch:
        """Some of the windows."""
        return Batch(*(getattr(self, item.name)[index] for item in fields(self)))

    def to(self, device: torch.device) -> Batch:
        """On a device."""
        return Batch(*(getattr(self, item.name).to(device, non_blocking=True) for item in fields(self)))


class StepBatches(Dataset[Batch]):
    """The batch of each training step."""

    def __init__(
        self, motions: MotionSet, statistics: Statistics, config: TrainConfig, *, rank: int = 0, world: int = 1
    ) -> None:
        if config.batch % world:
            raise ValueError(f"training: want a batch that {world} processes share evenly, got {config.batch}")
        self.motions, self.statistics, self.config = motions, statistics, config
        self.share = range(rank, config.batch, world)
        bodies = [motions.body(i) for i in range(len(motions.shapes))]
        self.bodies = bodies
        self.lengths = np.stack([statistics.normalize_body(body_lengths(body)) for body in bodies]).astype(np.float32)
        self.anchors = anchor_vertices(bodies[0], config.model.bps_anchors)
        self.balls = [fit_balls(body) for body in bodies]
        self.scenes = PseudoScenes(PseudoConfig(grid=GridSpec(config.model.grid, config.model.voxel_m)))
        self.clip_part = parts_of(motions.store.clip_name, max(1, config.model.members))

    def __len__(self) -> int:
        return self.config.steps

    def __getitem__(self, step: int) -> Batch:
        """The batch of a step (this process's share)."""
        rng = np.random.default_rng([self.config.seed, step])
        windows = self.motions.sample_batch(rng, self.config.batch)
        return self.made(windows, np.array(self.share), step)

    def made(self, windows: WindowBatch, rows: np.ndarray, step: int) -> Batch:
        """The chosen rows of a batch of windows, with conditions and noise."""
        R, translation_m = to_canonical(windows.R_parent_joint[rows], windows.translation_m[rows])
        body = windows.body_index[rows]
        columns: dict[str, list[Any]] = {name: [] for name in _DRAWN}
        for i, row in enumerate(rows):
            rng = np.random.default_rng([self.config.seed, step, int(row)])
            pose = R[i], translation_m[i], int(body[i])
            drawn = self._drawn(rng, *pose, windows.contact[row], windows.valid[row], bool(windows.uneven[row]))
            for name in _DRAWN:
                columns[name].append(drawn[name])
        return Batch(
            R_parent_joint=torch.from_numpy(R.astype(np.float32)),
            translation_m=torch.from_numpy(translation_m.astype(np.float32)),
            rest_joints_m=torch.from_numpy(self.motions.rest_joints_m[body]),
            body=torch.from_numpy(self.lengths[body]),
            valid=torch.from_numpy(windows.valid[rows].astype(np.float32)),
            part=torch.from_numpy(self.clip_part[windows.clip[rows]]),
            **{name: torch.from_numpy(np.stack(values)) for name, values in columns.items()},
        )

    def _drawn(
        self,
        rng: np.random.Generator,
        R: np.ndarray,
        translation_m: np.ndarray,
        body_index: int,
        contact: np.ndarray,
        valid: np.ndarray,
        uneven: bool,
    ) -> dict[str, Any]:
        config, frames = self.config, len(translation_m)
        with_scene = not uneven and rng.random() < config.scene_share
        occupancy = np.zeros(config.model.grid, np.uint8)
        local = np.zeros((frames, config.model.bps_anchors, 3), np.float16)
        if with_scene:
            joints_m, R_world = forward_kinematics(R, translation_m, self.motions.rest_joints_m[body_index])
            anchors_m = self.bodies[body_index].vertices(R_world, joints_m, self.anchors)
            scene = self.scenes.draw(rng, joints_m, R_world, anchors_m, contact, balls=self.balls[body_index])
            occupancy, local = scene.occupancy.astype(np.uint8), scene.bps.astype(np.float16)
        noisy = rng.random() < config.noisy_share
        return {
            "mask": (draw_mask(rng, frames, config.keyframes) | ~valid).astype(np.float32),
            "occupancy": occupancy,
            "local": local,
            "scene_known": np.float32(with_scene and rng.random() >= config.drop_global),
            "local_known": np.float32(with_scene and rng.random() >= config.drop_local),
            "noise_level": np.float32(rng.random() if noisy else 0.0),
            "turn_noise": rng.standard_normal((frames, 22, 3), np.float32),
            "shift_noise": rng.standard_normal((frames, 3), np.float32),
            "step": np.int64(rng.integers(1, STEPS + 1)),
            "looked_at": np.int64(rng.integers(0, max(1, frames - LOOKED_AT + 1))),
            "noise": rng.standard_normal((frames, config.model.feature_count), np.float32),
        }


_DRAWN = (
    "mask", "occupancy", "local", "scene_known", "local_known", "noise_level", "turn_noise", "shift_noise", "step",
    "looked_at", "noise",
)  # fmt: skip


def statistics_of(motions: MotionSet, seed: int) -> Statistics:
    """Statistics of the training windows as they are drawn."""
    rng = np.random.default_rng([seed, 0x57A7])
    features, lengths = [], []
    for _ in range(_STATISTICS_WINDOWS // 64):
        windows = motions.sample_batch(rng, 64)
        rest = motions.rest_joints_m[windows.body_index]
        x = encode(windows.R_parent_joint, windows.translation_m, rest)
        features.append(x[windows.valid])
    lengths = np.stack([body_lengths(motions.body(i)) for i in range(len(motions.shapes))])
    return Statistics.of(np.concatenate(features), lengths)


def parts_of(names: Sequence[str] | np.ndarray, parts: int) -> Int[np.ndarray, "clips"]:
    """Part of each clip, by its name: alike on every machine and whatever other clips there are."""
    digests = (hashlib.sha256(str(name).encode()).digest() for name in names)
    return np.array([int.from_bytes(digest[:4], "little") % parts for digest in digests], dtype=np.int64)


Drawn = TypeVar("Drawn")


def load_in_order(data: Dataset[Drawn], steps: range, workers: int) -> Iterator[Drawn]:
    """Batches of some steps, made ahead by worker processes."""
    if workers == 0:
        yield from (data[step] for step in steps)
        return
    yield from DataLoader(
        data,
        batch_size=None,
        sampler=list(steps),
        num_workers=workers,
        prefetch_factor=4,
        worker_init_fn=_one_thread,
    )


def _one_thread(_: int) -> None:
    torch.set_num_threads(1)
