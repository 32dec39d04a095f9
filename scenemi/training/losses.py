"""The training objective (paper eqs. 1 to 4, and 3.2.1 for noisy keyframes)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from torch import Tensor, nn

from scenemi.features import JOINTS, TRANSLATION, Statistics
from scenemi.model.base import join_keyframes
from scenemi.model.denoiser import REACH, Conditions, Denoiser, distance_to_keyframes, impute
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.heading import headings, to_heading, view
from scenemi.model.kinematics import joints_of, posed_joints
from scenemi.training.batches import Batch
from scenemi.training.config import TrainConfig
from video2anim.geometry.rotations import matrix_from_axis_angle, rot6d_from_matrix

_LEAST_FEATURE, _LEAST_JOINT_M = 0.02, 0.01
"""Errors below these (standard deviations; metres for each joint) need not become smaller."""
_LEAST_VIEW = 0.1
_SMOOTHING = 3
"""Distances averaged over: far ones are rare."""


@dataclass(frozen=True, slots=True, eq=False)
class Losses:
    """Means over the batch."""

    total: Tensor
    simple: Tensor
    """Squared error of normalized features, mean over features."""
    joints: Tensor
    """Squared distance of joints, m^2, summed over the 22 joints."""
    velocity: Tensor
    """Squared difference of the joints' displacements from frame to frame, m^2, summed over the 22 joints."""


class TrainingLoss(nn.Module):
    """Noises a batch, denoises it, and compares."""

    mean: Tensor
    std: Tensor

    def __init__(self, denoiser: Denoiser, statistics: Statistics, config: TrainConfig) -> None:
        super().__init__()
        self.denoiser, self.config = denoiser, config
        self.schedule = CosineSchedule()
        self.register_buffer("mean", torch.from_numpy(statistics.mean), persistent=False)
        self.register_buffer("std", torch.from_numpy(statistics.std), persistent=False)

    def forward(self, batch: Batch) -> Losses:
        """Losses of one batch."""
        config = self.config
        with torch.no_grad():
            x0 = (features_of(batch.R_parent_joint, batch.translation_m, batch.rest_joints_m) - self.mean) / self.std
            keys = (noisy_keyframes(batch) - self.mean) / self.std
            x = self.schedule.add_noise(x0, batch.step, batch.noise)
            steered = (batch.noise_level == 0) | (batch.step > config.stop_step)
            x = impute(x, keys, batch.mask * steered[:, None])
            base = join_keyframes(keys, batch.mask)
        given = Conditions(
            mask=batch.mask,
            imputed=batch.mask * steered[:, None],
            base=base,
            local=shifted_local(batch),
            body=batch.body,
            noise_level=batch.noise_level,
            scene=self.denoiser.encode_scene(batch.occupancy.float()),
            scene_known=batch.scene_known,
            local_known=batch.local_known,
        )
        estimate = self.denoiser(x, batch.step, given).float()
        return self.compared(estimate, x0, batch, self._expected(given) if config.relative else None)

    @torch.no_grad()
    def _expected(self, given: Conditions) -> tuple[Tensor, Tensor]:
        """Squared errors that interpolation makes at each frame: of features, and of a joint in m^2 (mean)."""
        scale = self.denoiser.scales(given)
        joint = (scale[..., JOINTS] * self.std[JOINTS]).square().sum(-1) / 22
        return scale.square() + _LEAST_FEATURE**2, joint + _LEAST_JOINT_M**2

    def compared(
        self, estimate: Tensor, x0: Tensor, batch: Batch, expected: tuple[Tensor, Tensor] | None = None
    ) -> Losses:
        """Losses of an estimate (B, N, 201), normalized; relative to the expected squared errors where given."""
        config, valid = self.config, batch.valid
        joints = joints_of(estimate * self.std + self.mean, batch.rest_joints_m)
        with torch.no_grad():
            true = posed_joints(batch.R_parent_joint, batch.translation_m, batch.rest_joints_m)
        simple = per_window((estimate - x0).square().mean(-1), valid)
        off = per_window((joints - true).square().sum((-1, -2)), valid)
        moves = (joints.diff(dim=1) - true.diff(dim=1)).square().sum((-1, -2))
        velocity = per_window(moves, valid[:, 1:])
        if expected is None:
            total = simple + config.joints_weight * off + config.velocity_weight * velocity
        else:
            of_features, of_joint = expected
            share = config.velocity_weight / config.joints_weight
            relative = (joints - true).square().sum(-1) / of_joint[..., None]
            relative_moves = (joints.diff(dim=1) - true.diff(dim=1)).square().sum(-1) / of_joint[:, 1:, None]
            total = per_window(robust((estimate - x0).square() / of_features).mean(-1), valid)
            total = total + per_window(robust(relative).mean(-1), valid)
            total = total + share * per_window(robust(relative_moves).mean(-1), valid[:, 1:])
        return Losses(total, simple, off, velocity)


@torch.no_grad()
def measure_scales(loss: TrainingLoss, batches: Sequence[Batch]) -> dict[str, Tensor]:
    """What `Denoiser.set_scales` wants, from batches as training draws them."""
    total = torch.zeros(REACH + 1, loss.mean.numel(), dtype=torch.float64)
    noise = torch.zeros(loss.mean.numel(), dtype=torch.float64)
    count = torch.zeros(REACH + 1, dtype=torch.float64)
    views = []
    for batch in batches:
        x0 = (features_of(batch.R_parent_joint, batch.translation_m, batch.rest_joints_m) - loss.mean) / loss.std
        base = join_keyframes(x0, batch.mask)
        raw = base * loss.std + loss.mean
        heading = headings(raw)
        off = to_heading(x0 - base, heading).double().square().flatten(0, 1)
        distance = distance_to_keyframes(batch.mask).flatten()
        total.index_add_(0, distance.cpu(), off.cpu())
        count.index_add_(0, distance.cpu(), torch.ones(len(distance), dtype=torch.float64))
        keys = (noisy_keyframes(replace(batch, noise_level=torch.ones_like(batch.noise_level))) - loss.mean) / loss.std
        noise += to_heading(keys - x0, heading).double().square().mean((0, 1)).cpu()
        views.append(view(raw, heading).flatten(0, 1).cpu())
    seen = torch.nonzero(count > 0)[:, 0]
    size = _pooled((total[seen] / count[seen, None]).numpy(), loss.std.cpu().numpy())
    grid = np.arange(REACH + 1)
    filled = np.stack([np.interp(grid, seen.numpy(), column) for column in size.T], 1)
    smooth = uniform_filter1d(filled, _SMOOTHING, axis=0, mode="nearest")
    smooth[0] = 0.0
    every = torch.cat(views)
    return {
        "residual_std": torch.from_numpy(smooth).float(),
        "keyframe_std": (noise / max(1, len(batches))).sqrt().float(),
        "view_mean": every.mean(0),
        "view_std": every.std(0).clamp(min=_LEAST_VIEW),
        "feature_mean": loss.mean,
        "feature_std": loss.std,
    }


def _pooled(square: Float[np.ndarray, "distances 201"], std: Float[np.ndarray, "201"]) -> np.ndarray:
    """RMS in which half of each column's square is its own and half that of all columns of its kind (translation, root
    orientation, rotations, joints), in their common unit: what hardly moved in the windows seen may move in others."""
    raw = square * std**2
    pooled = raw.copy()
    for kind in (TRANSLATION, slice(3, 9), slice(9, 135), JOINTS):
        pooled[:, kind] = 0.5 * raw[:, kind] + 0.5 * raw[:, kind].mean(1, keepdims=True)
    return np.sqrt(pooled) / std


def robust(square: Tensor) -> Tensor:
    """Square of small relative errors, twice the absolute value of large ones (Charbonnier): clips whose movement no
    keyframe tells do not rule the gradient."""
    return 2 * ((1 + square).sqrt() - 1)


def per_window(error: Float[Tensor, "batch frames"], valid: Float[Tensor, "batch frames"]) -> Tensor:
    """Mean over the valid frames of each window, then over windows: every window weighs the same, so that processes
    that share a batch have the same gradient as one."""
    return ((error * valid).sum(1) / valid.sum(1).clamp(min=1)).mean()


def features_of(R_parent_joint: Tensor, translation_m: Tensor, rest_joints_m: Tensor) -> Tensor:
    """Features (B, N, 201) of a motion in the canonical frame, not normalized."""
    joints = posed_joints(R_parent_joint, translation_m, rest_joints_m)
    return torch.cat([translation_m, rot6d_from_matrix(R_parent_joint).flatten(2), joints.flatten(2)], -1)


def noisy_keyframes(batch: Batch) -> Float[Tensor, "batch frames 201"]:
    """Features with Gaussian noise of l degrees on every joint's rotation and l centimeters on the translation."""
    level = batch.noise_level[:, None, None]
    turn = matrix_from_axis_angle(batch.turn_noise * (level[..., None] * torch.pi / 180))
    noisy = (batch.R_parent_joint[..., :, :, None] * turn[..., None, :, :]).sum(-2)
    return features_of(noisy, batch.translation_m + 0.01 * level * batch.shift_noise, batch.rest_joints_m)


def shifted_local(batch: Batch) -> Float[Tensor, "batch frames anchors 3"]:
    """Offsets to the scene as a body that stands off by the translation's noise has them (to first order, for surfaces
    that face the anchor)."""
    shift = 0.01 * batch.noise_level[:, None, None] * batch.shift_noise
    local = batch.local.float()
    return local - shift[:, :, None]
