"""Batches drawn where the model trains: on a GPU, `scenemi.training.batches` would make it wait for the processor.

Windows are those of the pool and choices follow the same laws, but windows of one kind (noisy, observed by the video
pipeline, shown their scene) have fixed rows of a batch, so that no shape depends on chance, and frames of keyframes are
picked from a table drawn before.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from scenemi.features import FEATURE_COUNT
from scenemi.model.diffusion import STEPS
from scenemi.model.mirror import mirrored
from scenemi.scene.field import BoxField, rooted_boxes, signed_distance, way_out
from scenemi.scene.grid import REACH_M
from scenemi.scene.rows import BoxRows
from scenemi.training.batches import LOOKED_AT, TELLING_SHARE, Batch
from scenemi.training.config import TrainConfig
from scenemi.training.keyframe_masks import draw_mask, draw_observed_mask
from scenemi.training.noise import DEGREE, ERROR_SIZES, REPORTED_SPREAD, PipelineErrors
from scenemi.training.pool import MAX_BOXES, UNITS_PER_METER, Shard
from scenemi.windows import WINDOW_FRAMES

_MASKS = 65_536
"""Of each table of keyframes: as many different ones as any window meets in a long run."""


@dataclass(frozen=True, slots=True, eq=False)
class AllBoxes(BoxField):
    """The same solids, all boxes of all windows at once: many times the work, in few steps."""

    def query(
        self, points_m: Float[Tensor, "batch points 3"]
    ) -> tuple[Float[Tensor, "batch points"], Float[Tensor, "batch points 3"]]:
        """See `SceneField`."""
        points = points_m[self.rows]
        best, nearest = self._distances(points).min(1)
        height = points[..., 1].clamp(max=REACH_M)
        is_floor = height <= best
        best = torch.minimum(best, height)
        box = self.boxes.gather(1, nearest[..., None].expand(-1, -1, 7))
        up = torch.zeros_like(points)
        up[..., 1] = (best < REACH_M).to(points)
        distance_m = points_m.new_full(points_m.shape[:2], REACH_M).index_copy(0, self.rows, best)
        way = torch.where(is_floor[..., None], up, way_out(points, box))
        return distance_m, torch.zeros_like(points_m).index_copy(0, self.rows, way)

    def distance_m(self, points_m: Float[Tensor, "batch points 3"]) -> Float[Tensor, "scenes points"]:
        """See `BoxField`."""
        points = points_m[self.rows]
        return torch.minimum(self._distances(points).amin(1), points[..., 1].clamp(max=REACH_M))

    def _distances(self, points: Float[Tensor, "scenes points 3"]) -> Float[Tensor, "scenes boxes points"]:
        boxes = self.boxes[:, :, None]
        return torch.where(boxes[..., 3] > 0, signed_distance(points[:, None], boxes), REACH_M)


@dataclass(frozen=True, slots=True, eq=False)
class _FixedRows(BoxRows):
    """Scenes of a batch of which certain rows are shown."""

    shown: Int[Tensor, "scenes"]

    def field(self, known: Float[Tensor, "batch"]) -> AllBoxes:
        """See `SceneRows`; which windows are shown their scene is known already."""
        return AllBoxes(self.shown, rooted_boxes(self.boxes[self.shown]), ())


@dataclass(frozen=True, slots=True, eq=False)
class DeviceBatch(Batch):
    """A batch of which certain rows are shown their scene."""

    shown: Int[Tensor, "scenes"] | None = None

    def to(self, device: torch.device) -> Self:
        """Itself: it was drawn on its device, but for two flags that the processor reads."""
        return self

    @property
    def scene(self) -> _FixedRows:
        """See `Batch`."""
        assert self.shown is not None
        return _FixedRows(self.boxes, self.shown)


class DeviceBatches:
    """Windows on a device, and batches of them."""

    def __init__(
        self, config: TrainConfig, capacity: int, device: torch.device, errors: PipelineErrors | None, seed: int
    ) -> None:
        """`capacity`: windows there is room for."""
        self.config, self.device = config, device
        self.generator = torch.Generator(device).manual_seed(seed)
        self._chance = np.random.default_rng([config.seed, seed])
        frames = WINDOW_FRAMES
        kinds = {"features": torch.int16, "boxes": torch.float32, "mask": torch.bool}
        shapes = {"features": (frames, FEATURE_COUNT), "boxes": (MAX_BOXES, 7), "mask": (frames,)}
        self._held = {name: torch.empty(capacity, *shapes[name], dtype=kinds[name], device=device) for name in kinds}
        self._held |= {
            name: torch.empty(capacity, dtype=torch.long, device=device) for name in ("valid_frames", "body")
        }
        self.windows, self.capacity = 0, capacity
        rng = np.random.default_rng([config.seed, seed, 1])
        self._drawn = self._table([draw_mask(rng, frames, config.keyframes) for _ in range(_MASKS)])
        self._observed = self._table([draw_observed_mask(rng, frames) for _ in range(_MASKS)])
        self.piped = round(config.batch * config.pipeline_share) if errors is not None else 0
        self.noisy = torch.arange(self.piped + round(config.batch * config.noisy_share), device=device)
        shown = np.flatnonzero(np.diff(np.floor(config.scene_share * np.arange(config.batch + 1) + 1e-6)))
        self.shown = torch.from_numpy(shown).to(device)
        if errors is not None:
            self._turn = torch.from_numpy(errors.turn_rad.astype(np.float32)).to(device)
            self._shift = torch.from_numpy(errors.shift_m.astype(np.float32)).to(device)
            self._start = torch.from_numpy(errors.start.astype(np.int64)).to(device)

    def add(self, shard: Shard) -> None:
        """Copy a shard to the device, where there is room."""
        count = len(shard)
        if self.windows + count > self.capacity:
            return
        rows = slice(self.windows, self.windows + count)
        self._held["features"][rows] = torch.from_numpy(np.array(shard.features)).to(self.device)
        self._held["boxes"][rows] = torch.from_numpy(np.array(shard.boxes)).to(self.device)
        mask = np.unpackbits(np.asarray(shard.mask), axis=1)[:, :WINDOW_FRAMES].astype(bool)
        self._held["mask"][rows] = torch.from_numpy(mask).to(self.device)
        for name in ("valid_frames", "body"):
            values = torch.from_numpy(np.asarray(getattr(shard, name)).astype(np.int64))
            self._held[name][rows] = values.to(self.device)
        self.windows += count

    def draw(self) -> DeviceBatch:
        """The next batch."""
        config, count, frames = self.config, self.config.batch, WINDOW_FRAMES
        row = self._below(self.windows, count)
        boxes = self._held["boxes"][row]
        mirror = self._uniform(count) < 0.5
        features = self._held["features"][row].float() / UNITS_PER_METER
        features = torch.where(mirror[:, None, None], mirrored(features), features)
        own = torch.zeros(count, dtype=torch.bool, device=self.device)
        own[self.shown] = (boxes[self.shown, 0, 3] > 0) & (self._uniform(len(self.shown)) < TELLING_SHARE)
        mask = torch.where(own[:, None], self._held["mask"][row], self._drawn[self._below(_MASKS, count)])
        mask[: self.piped] = self._observed[self._below(_MASKS, self.piped)]
        holds = torch.arange(frames, device=self.device) >= self._held["valid_frames"][row][:, None]
        noise, turn_rad, shift_m = self._noise()
        first = self._uniform(count) < config.first_step_share
        return DeviceBatch(
            features=features,
            body=self._held["body"][row],
            valid=(~holds).float(),
            mask=(mask | holds).float(),
            boxes=BoxRows(boxes).mirrored(mirror).boxes,
            scene_known=torch.ones(1),
            local_known=torch.ones(1),
            noise=noise,
            step=torch.where(first, STEPS, 1 + self._below(STEPS, count)),
            looked_at=self._below(frames - LOOKED_AT + 1, count),
            noisy=self.noisy,
            turn_rad=turn_rad,
            shift_m=shift_m,
            diffusion_noise=self._normal(count, frames, FEATURE_COUNT),
            condition_on_estimate=torch.tensor(float(self._chance.random() < 0.5)),
            shown=self.shown,
        )

    def _noise(self) -> tuple[Tensor, Tensor, Tensor]:
        """See `PoolBatches`."""
        frames, noisy = WINDOW_FRAMES, len(self.noisy)
        turn, shift = self._normal(noisy, frames, 22, 3), self._normal(noisy, frames, 3)
        level = self._uniform(noisy)
        turn, shift = turn * (DEGREE * level)[:, None, None, None], shift * (0.01 * level)[:, None, None]
        reported = torch.zeros(self.config.batch, frames, 2, device=self.device)
        reported[:noisy] = level[:, None, None]
        if self.piped:
            turn[: self.piped], shift[: self.piped] = found = self._of_pipeline(self.piped)
            true = [one.square().flatten(1).mean(1).sqrt() for one in found]
            spread = (REPORTED_SPREAD * self._normal(self.piped, 2)).exp()
            told = torch.stack([true[0] / DEGREE, 100 * true[1]], 1) * spread
            reported[: self.piped] = told[:, None]
        return reported, turn, shift

    def _of_pipeline(self, count: int) -> tuple[Tensor, Tensor]:
        """See `PipelineErrors.draw`."""
        frames = WINDOW_FRAMES
        run = self._below(len(self._start) - 1, count)
        first, last = self._start[run], self._start[run + 1] - 1
        begin = first + (self._uniform(count) * ((last - frames - first).clamp(min=0) + 1)).long()
        span = (last - begin)[:, None]
        step = torch.arange(frames, device=self.device) % (2 * span).clamp(min=1)
        rows = begin[:, None] + torch.where(step > span, 2 * span - step, step)
        turn, shift = self._turn[rows], self._shift[rows]
        level = torch.tensor([1.0, 0.0, 1.0], device=self.device)
        x, y, z = (shift - level * shift[:, :1]).unbind(-1)
        yaw = (2 * torch.pi * self._uniform(count))[:, None]
        turned = torch.stack([yaw.cos() * x + yaw.sin() * z, y, yaw.cos() * z - yaw.sin() * x], -1)
        low, high = ERROR_SIZES
        size = (low + (high - low) * self._uniform(count))[:, None, None]
        return size[..., None] * turn, size * turned

    def _table(self, masks: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(masks)).to(self.device)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, device=self.device)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, device=self.device)

    def _below(self, end: int, count: int) -> Tensor:
        return torch.randint(end, (count,), generator=self.generator, device=self.device)


def read_shard(path: Path) -> Shard:
    """A shard from a folder, into memory."""
    return Shard(**{name: np.load(path / f"{name}.npy", allow_pickle=False) for name in Shard.__slots__})
