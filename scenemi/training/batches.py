"""Batches by step: all random choices follow from (seed, step) and the pool, so a run can stop and resume anywhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, fields
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Int, Int8
from torch import Tensor

from scenemi.features import FEATURE_COUNT, Statistics, body_lengths
from scenemi.model.diffusion import STEPS
from scenemi.model.mirror import mirrored
from scenemi.scene.rows import BoxRows, SceneRows, VolumeRows
from scenemi.training.config import TrainConfig
from scenemi.training.keyframe_masks import draw_mask, draw_observed_mask
from scenemi.training.noise import PipelineErrors, gaussian, reported_level
from scenemi.training.pool import UNITS_PER_METER, AnyShard, SceneShard, stored_scenes
from video2anim.body.shaped_body import ShapedBody

LOOKED_AT = 31
"""Frames of a window in which joints by forward kinematics are compared: in all they cost as much as the network."""
TELLING_SHARE = 0.7
"""Share of shown scenes whose own keyframes are used; the others get any, for which the scene is as possible."""


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """One step's windows, in the canonical frame; float32 unless said."""

    features: Float[Tensor, "batch frames 201"]
    """Meters and 6D entries, not normalized."""
    body: Int[Tensor, "batch"]
    valid: Float[Tensor, "batch frames"]
    mask: Float[Tensor, "batch frames"]
    boxes: Float[Tensor, "batch boxes 7"]
    """Of made-up scenes; no columns where the scenes are captured ones."""
    scene_known: Float[Tensor, "batch"]
    """1 where the window is shown its scene."""
    local_known: Float[Tensor, "batch"]
    """The same of the paper's local part."""
    noise: Float[Tensor, "batch frames 2"]
    """Noise level of the keyframes that the model gets: degrees and centimeters."""
    step: Int[Tensor, "batch"]
    """Diffusion step."""
    looked_at: Int[Tensor, "batch"]
    """First of the `LOOKED_AT` frames."""
    noisy: Int[Tensor, "noisy"]
    """Windows with noisy keyframes."""
    turn_rad: Float[Tensor, "noisy frames 22 3"]
    """Noise of their local rotations."""
    shift_m: Float[Tensor, "noisy frames 3"]
    diffusion_noise: Float[Tensor, "batch frames 201"]
    """Unit Gaussian of the forward process."""
    condition_on_estimate: Float[Tensor, ""]
    """1 in steps in which the scene is asked along a first estimate, not along the joined keyframes."""
    values: Int8[Tensor, "batch x y z"] = field(default_factory=lambda: torch.zeros(0, 0, 0, 0, dtype=torch.int8))
    """Distances to solids of captured scenes, see `VolumeRows`; no rows where scenes are made up."""
    place: Float[Tensor, "batch 6"] = field(default_factory=lambda: torch.zeros(0, 6))
    """First node and steps of the nodes."""

    @property
    def scene(self) -> SceneRows:
        """The scenes, whichever they are."""
        return VolumeRows(self.values, self.place) if len(self.values) else BoxRows(self.boxes)

    def to(self, device: torch.device) -> Self:
        """On a device."""
        return type(self)(*(getattr(self, item.name).to(device, non_blocking=True) for item in fields(self)))


class PoolBatches:
    """The batch of each training step."""

    def __init__(self, shards: Sequence[AnyShard], config: TrainConfig, errors: PipelineErrors | None = None) -> None:
        """`errors`: of the video pipeline; without them noisy keyframes have Gaussian noise only."""
        self.config, self.errors = config, errors
        self.take(shards)

    def take(self, shards: Sequence[AnyShard]) -> None:
        """Draw from these shards from now on; windows of a batch are all in made-up scenes or all in captured ones."""
        self.shards = list(shards)
        kinds = ([s for s in shards if isinstance(s, SceneShard) == captured] for captured in (False, True))
        self._kinds = [kind for kind in kinds if kind]

    def __getitem__(self, number: int) -> Batch:
        """A batch; step s has those from s * `config.parts` on."""
        config = self.config
        rng = np.random.default_rng([config.seed, number])
        shards = self._kinds[int(rng.integers(len(self._kinds))) if len(self._kinds) > 1 else 0]
        units, scene, telling, valid, body = _rows(shards, rng.integers(0, sum(map(len, shards)), config.batch))
        count, frames = units.shape[:2]
        features = torch.from_numpy(units).float().div_(UNITS_PER_METER)
        mirror = torch.from_numpy(rng.random(count) < 0.5)
        features = torch.where(mirror[:, None, None], mirrored(features), features)
        shown = rng.random(count) < config.scene_share  # of some nothing but the floor
        kind = rng.random(count)
        piped = (kind < config.pipeline_share) & (self.errors is not None)
        own = shown & scene.filled & (rng.random(count) < TELLING_SHARE) & (config.keyframes == "mixed")
        masks = [
            draw_observed_mask(rng, frames)
            if piped[i]
            else telling[i] if own[i] else draw_mask(rng, frames, config.keyframes)
            for i in range(count)
        ]  # fmt: skip
        holds = np.arange(frames) >= valid[:, None]
        noisy = np.flatnonzero(piped | (kind >= 1 - config.noisy_share))
        noise, turn_rad, shift_m = self._noise(rng, noisy, piped, frames, count)
        dropped = rng.random(count)
        known = shown & (dropped < 1 - config.drop_global) if config.keyframes == "paper" else shown
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        return Batch(
            features=features,
            body=torch.from_numpy(body),
            valid=torch.from_numpy(~holds).float(),
            mask=torch.from_numpy(np.stack(masks) | holds).float(),
            **scene.mirrored(mirror).columns(),
            scene_known=torch.from_numpy(known).float(),
            local_known=torch.from_numpy(shown & (dropped >= config.drop_local)).float(),
            noise=torch.from_numpy(noise),
            step=torch.from_numpy(
                np.where(rng.random(count) < config.first_step_share, STEPS, rng.integers(1, STEPS + 1, count))
            ),
            looked_at=torch.from_numpy(rng.integers(0, max(1, frames - LOOKED_AT + 1), count)),
            noisy=torch.from_numpy(noisy),
            turn_rad=torch.from_numpy(turn_rad),
            shift_m=torch.from_numpy(shift_m),
            diffusion_noise=torch.randn(count, frames, FEATURE_COUNT, generator=generator),
            condition_on_estimate=torch.tensor(float(rng.random() < 0.5)),
        )

    def _noise(
        self, rng: np.random.Generator, noisy: np.ndarray, piped: np.ndarray, frames: int, count: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reported noise of all windows (B, N, 2), and turns and shifts of the noisy ones."""
        reported = np.zeros((count, frames, 2), np.float32)
        turn_rad = np.zeros((len(noisy), frames, 22, 3), np.float32)
        shift_m = np.zeros((len(noisy), frames, 3), np.float32)
        for row, i in enumerate(noisy):
            if piped[i] and self.errors is not None:
                turn_rad[row], shift_m[row] = self.errors.draw(rng, frames)
                reported[i] = reported_level(rng, turn_rad[row], shift_m[row])
            else:
                reported[i] = level = rng.random()
                turn_rad[row], shift_m[row] = gaussian(rng, frames, level)
        return reported, turn_rad, shift_m

    def of_step(self, step: int) -> tuple[Batch, ...]:
        """The batches of a step."""
        parts = self.config.parts
        return tuple(self[parts * step + part] for part in range(parts))

    def ahead(self, steps: range, workers: int) -> Iterator[tuple[Batch, ...]]:
        """Batches of some steps in order, made ahead by threads."""
        if workers == 0:
            yield from (self.of_step(step) for step in steps)
            return
        with ThreadPoolExecutor(workers) as pool:
            coming: list[Future[tuple[Batch, ...]]] = []
            for step in steps:
                coming.append(pool.submit(self.of_step, step))
                if len(coming) > workers:
                    yield coming.pop(0).result()
            for future in coming:
                yield future.result()


def _rows(
    shards: Sequence[AnyShard], index: np.ndarray
) -> tuple[np.ndarray, SceneRows, np.ndarray, np.ndarray, np.ndarray]:
    """Stored units, scenes, telling keyframes, valid frames and bodies of rows of all shards one after the other."""
    ends = np.cumsum([len(shard) for shard in shards])
    shard = np.searchsorted(ends, index, side="right")
    row = index - (ends[shard] - [len(shards[s]) for s in shard])
    picked = [(shards[s], r) for s, r in zip(shard, row, strict=True)]
    units = np.stack([one.features[r] for one, r in picked])
    telling = np.stack([np.unpackbits(one.mask[r])[: units.shape[1]] for one, r in picked]).astype(bool)
    return (
        units,
        stored_scenes(picked),
        telling,
        np.array([one.valid_frames[r] for one, r in picked], np.int64),
        np.array([one.body[r] for one, r in picked], np.int64),
    )


def statistics_of(shards: Sequence[AnyShard], bodies: Sequence[ShapedBody]) -> Statistics:
    """Statistics of the features over some windows of the pool, and of the bodies' lengths."""
    some = np.concatenate([shard.features[::8].reshape(-1, FEATURE_COUNT) for shard in shards[:4]])
    return Statistics.of(some.astype(np.float64) / UNITS_PER_METER, np.stack([body_lengths(body) for body in bodies]))
