"""What a run is watched by: sampled in-betweening on fixed windows of the validation part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scenemi.data.windows import MotionSet, WindowBatch
from scenemi.features import Statistics, body_lengths, to_canonical
from scenemi.model.base import join_keyframes
from scenemi.model.denoiser import Conditions, Denoiser
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.kinematics import joints_of
from scenemi.model.sampling import SamplerConfig, sample
from scenemi.training.losses import features_of

INTERVALS = (15, 30, 60)
_WINDOWS = 64
_SAMPLER = SamplerConfig(steps=5, guidance_weight=1.0)


@dataclass(frozen=True, slots=True)
class Validation:
    """Means over windows at one keyframe interval, without a scene."""

    interval: int
    mjpe_m: float
    base_mjpe_m: float
    """Of the joined keyframes that the denoiser corrects."""
    interpolated_mjpe_m: float
    """Of plain cubic curves."""
    jerk_ratio: float
    """Jerk over that of the truth."""


class Validator:
    """Samples the same windows each time."""

    def __init__(self, motions: MotionSet, statistics: Statistics) -> None:
        batches = list(motions.fixed_windows(full_only=True, body=0)) or list(motions.fixed_windows(body=0))
        rows = [(batch, row) for batch in batches for row in range(len(batch))]
        chosen = [rows[i] for i in np.linspace(0, len(rows) - 1, min(_WINDOWS, len(rows))).astype(int)]
        R, translation_m = to_canonical(*(np.stack(arrays) for arrays in zip(*map(_poses, chosen), strict=True)))
        body = np.array([batch.body_index[row] for batch, row in chosen])
        lengths = np.stack(
            [statistics.normalize_body(body_lengths(motions.body(i))) for i in range(len(motions.shapes))]
        )
        self.statistics = statistics
        self.rest = torch.from_numpy(motions.rest_joints_m[body])
        self.body = torch.from_numpy(lengths[body].astype(np.float32))
        self.features = features_of(
            torch.from_numpy(R.astype(np.float32)), torch.from_numpy(translation_m.astype(np.float32)), self.rest
        )

    def __call__(self, denoiser: Denoiser) -> tuple[Validation, ...]:
        """One row for each interval."""
        was_training = denoiser.training
        denoiser.eval()
        with torch.no_grad():
            rows = tuple(self._row(denoiser, interval) for interval in INTERVALS)
        denoiser.train(was_training)
        return rows

    def _row(self, denoiser: Denoiser, interval: int) -> Validation:
        device = next(denoiser.parameters()).device
        keys = self.statistics.normalize(self.features).to(device)
        count, frames = keys.shape[:2]
        mask = torch.zeros(count, frames, device=device)
        mask[:, ::interval] = mask[:, -1] = 1
        none = torch.zeros(count, device=device)
        config = denoiser.config
        given = Conditions(
            mask=mask,
            imputed=mask,
            base=denoiser.join(keys, mask, self.body.to(device), none),
            local=torch.zeros(count, frames, config.bps_anchors, 3, device=device),
            body=self.body.to(device),
            noise_level=none,
            scene=torch.zeros(count, config.embedding, device=device),
            scene_known=none,
            local_known=none,
        )
        generators = [torch.Generator().manual_seed(i) for i in range(count)]
        made = sample(denoiser, CosineSchedule(), keys, given, _SAMPLER, generators)
        true = self._joints(keys)
        return Validation(
            interval,
            float((self._joints(made) - true).norm(dim=-1).mean()),
            float((self._joints(given.base) - true).norm(dim=-1).mean()),
            float((self._joints(join_keyframes(keys, mask)) - true).norm(dim=-1).mean()),
            float(_jerk(self._joints(made)) / _jerk(true)),
        )

    def _joints(self, normalized: Tensor) -> Float[Tensor, "batch frames 22 3"]:
        return joints_of(self.statistics.denormalize(normalized), self.rest.to(normalized.device))


def _poses(chosen: tuple[WindowBatch, int]) -> tuple[np.ndarray, np.ndarray]:
    batch, row = chosen
    return batch.R_parent_joint[row], batch.translation_m[row]


def _jerk(joints: Tensor) -> Tensor:
    return joints.diff(n=3, dim=1).norm(dim=-1).mean()
