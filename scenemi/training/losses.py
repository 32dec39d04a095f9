"""The training objective (paper eqs. 1 to 4, and 3.2.1 for noisy keyframes)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from torch import Tensor, nn

from scenemi.features import BODY_ROTATIONS, FEATURE_COUNT, JOINTS, ROOT_ROTATION, TRANSLATION, Statistics
from scenemi.model.denoiser import REACH, Conditions, Denoiser, distance_to_keyframes, impute, since_and_until
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.heading import headings, to_heading, view
from scenemi.model.kinematics import joints_of, posed_joints
from scenemi.model.linear_guess import fitted_length
from scenemi.training.batches import LOOKED_AT, Batch
from scenemi.training.config import TrainConfig
from video2anim.geometry.rotations import matrix_from_axis_angle, rot6d_from_matrix

_LEAST_FEATURE, _LEAST_JOINT_M = 0.02, 0.01
"""Errors below these (standard deviations; metres for each joint) need not become smaller."""
_LEAST_VIEW = 0.1
_SPANS = (2, 4, 8, 15, 30, 60, 120)
"""Distances of keyframes for which correlation lengths are measured; between them they are interpolated."""
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
            keys = self._keyframes(batch, x0)
            x = self.schedule.add_noise(x0, batch.step, batch.noise)
            steered = (batch.noise_level == 0) | (batch.step > config.stop_step)
            x = impute(x, keys, batch.mask * steered[:, None])
            base = self.denoiser.join(keys, batch.mask, batch.body, batch.noise_level, batch.part)
        given = Conditions(
            mask=batch.mask,
            imputed=batch.mask * steered[:, None],
            base=base,
            local=shifted_local(batch),
            body=batch.body,
            noise_level=batch.noise_level,
            scene=self._scene(batch),
            scene_known=batch.scene_known,
            local_known=batch.local_known,
        )
        estimate = self.denoiser(x, batch.step, given).float()
        return self.compared(estimate, x0, batch, self._expected(given) if config.relative else None)

    def _scene(self, batch: Batch) -> Tensor:
        """Global scene vectors of the windows that have one."""
        known = torch.nonzero(batch.scene_known > 0)[:, 0]
        if not len(known):
            return batch.mask.new_zeros(len(batch.mask), self.denoiser.config.embedding)
        found = self.denoiser.encode_scene(batch.occupancy[known].float())
        return found.new_zeros(len(batch.mask), found.shape[1]).index_copy(0, known, found)

    def _keyframes(self, batch: Batch, x0: Tensor) -> Tensor:
        """Normalized features with the noise of the keyframes; most windows have none."""
        noisy = torch.nonzero(batch.noise_level > 0)[:, 0]
        keys = x0.clone()
        keys[noisy] = (noisy_keyframes(batch.chosen(noisy)) - self.mean) / self.std
        return keys

    @torch.no_grad()
    def _expected(self, given: Conditions) -> tuple[Tensor, Tensor]:
        """Squared errors that interpolation makes at each frame: of features, and of a joint in m^2 (mean)."""
        scale = self.denoiser.scales(given)
        joint = (scale[..., JOINTS] * self.std[JOINTS]).square().sum(-1) / 22
        return scale.square() + _LEAST_FEATURE**2, joint + _LEAST_JOINT_M**2

    def compared(
        self, estimate: Tensor, x0: Tensor, batch: Batch, expected: tuple[Tensor, Tensor] | None = None
    ) -> Losses:
        """Losses of an estimate (B, N, 201), normalized; relative to the expected squared errors where given. Joints by
        forward kinematics are compared in a piece of each window: it costs as much as the network."""
        config = self.config
        frames = batch.looked_at[:, None] + torch.arange(min(LOOKED_AT, x0.shape[1]), device=x0.device)
        row = torch.arange(len(x0), device=x0.device)[:, None]
        some, valid = estimate[row, frames] * self.std + self.mean, batch.valid[row, frames]
        joints = joints_of(some, batch.rest_joints_m)
        true = (x0[row, frames] * self.std + self.mean)[..., JOINTS].unflatten(-1, (22, 3))
        apart = (joints - true).square().sum(-1)
        moves = (joints.diff(dim=1) - true.diff(dim=1)).square().sum(-1)
        simple = per_window((estimate - x0).square().mean(-1), batch.valid)
        off = per_window(apart.sum(-1), valid)
        velocity = per_window(moves.sum(-1), valid[:, 1:])
        if expected is None:
            total = simple + config.joints_weight * off + config.velocity_weight * velocity
        else:
            of_features, of_joint = expected
            of_joint = of_joint[row, frames][..., None]
            share = config.velocity_weight / config.joints_weight
            total = per_window(robust((estimate - x0).square() / of_features).mean(-1), batch.valid)
            total = total + per_window(robust(apart / of_joint).mean(-1), valid)
            total = total + share * per_window(robust(moves / of_joint[:, 1:]).mean(-1), valid[:, 1:])
        return Losses(total, simple, off, velocity)


@torch.no_grad()
def measure_scales(loss: TrainingLoss, batches: Sequence[Batch]) -> dict[str, Tensor]:
    """What `Denoiser.set_scales` wants, from batches as training draws them."""
    noise = torch.zeros(loss.mean.numel(), dtype=torch.float64)
    views, triples = [], []
    for batch in batches:
        x0 = (features_of(batch.R_parent_joint, batch.translation_m, batch.rest_joints_m) - loss.mean) / loss.std
        exact = torch.zeros_like(batch.noise_level)
        raw = loss.denoiser.join(x0, batch.mask, batch.body, exact, batch.part) * loss.std + loss.mean
        heading = headings(raw)
        triples.append((x0 * loss.std + loss.mean, raw, batch.mask))
        full = torch.ones_like(batch.noise_level)
        keys = (noisy_keyframes(replace(batch, noise_level=full)) - loss.mean) / loss.std
        keys = loss.denoiser.smoothed_keys(keys, batch.mask, full)
        left = to_heading(keys - x0, heading).double().square()[batch.mask > 0]
        noise += left.mean(0).cpu()
        views.append(view(raw, heading).flatten(0, 1).cpu())
    every = torch.cat(views)
    return {
        "residual_std": residual_size(triples) / loss.std.cpu(),
        "residual_frames": residual_frames(triples),
        "keyframe_std": (noise / max(1, len(batches))).sqrt().float(),
        "view_mean": every.mean(0),
        "view_std": every.std(0).clamp(min=_LEAST_VIEW),
        "feature_mean": loss.mean,
        "feature_std": loss.std,
    }


def residual_size(drawn: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Float[Tensor, "distances 201"]:
    """How far the truth is from a curve through the keyframes, by frames from the nearest one (0 to `REACH`): RMS of
    each feature in the heading of the curve, metres and 6D entries.

    Args:
        drawn: truth and curve (B, N, 201), denormalized, and mask (B, N) of batches.
    """
    total = torch.zeros(REACH + 1, FEATURE_COUNT, dtype=torch.float64)
    count = torch.zeros(REACH + 1, dtype=torch.float64)
    for truth, curve, mask in drawn:
        off = to_heading(truth - curve, headings(curve)).double().square().flatten(0, 1)
        distance = distance_to_keyframes(mask).flatten().cpu()
        total.index_add_(0, distance, off.cpu())
        count.index_add_(0, distance, torch.ones(len(distance), dtype=torch.float64))
    seen = torch.nonzero(count > 0)[:, 0]
    size = _pooled((total[seen] / count[seen, None]).numpy())
    grid = np.arange(REACH + 1)
    filled = np.stack([np.interp(grid, seen.numpy(), column) for column in size.T], 1)
    smooth = uniform_filter1d(filled, _SMOOTHING, axis=0, mode="nearest")
    smooth[0] = 0.0
    return torch.from_numpy(smooth).float()


def residual_frames(drawn: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Float[Tensor, "spans"]:
    """How long errors of a curve through the keyframes last: correlation length in frames, by the frames from keyframe
    to keyframe (0 to 2 `REACH`). Arguments as of `residual_size`."""
    lags = 8
    products = torch.zeros(len(_SPANS), lags + 1, dtype=torch.float64)
    edges = torch.tensor(_SPANS)
    for truth, curve, mask in drawn:
        off = to_heading(truth - curve, headings(curve)).cpu()[..., JOINTS]
        off = off / off.square().mean(1, keepdim=True).sqrt().clamp(min=1e-4)
        apart = since_and_until(mask.cpu())
        bin_of = torch.bucketize(apart.sum(-1), edges).clamp(max=len(_SPANS) - 1)
        for lag in range(lags + 1):
            count = off.shape[1] - lag
            inside = (apart[:, :count, 1] > lag) & (apart[:, :count, 0] > 0)
            both = (off[:, :count] * off[:, lag:]).mean(-1)
            # Correlations are of pairs in one segment, against the mean square of their own frames.
            squares = 0.5 * (off[:, :count].square() + off[:, lag:].square()).mean(-1)
            ratio = torch.stack([both, squares], -1)[inside]
            found = torch.zeros(len(_SPANS), 2).index_add_(0, bin_of[:, :count][inside], ratio)
            products[:, lag] += found[:, 0] / found[:, 1].clamp(min=1e-9) * (found[:, 1] > 0)
    measured = products / max(1, len(drawn))
    lengths = [
        fitted_length(row[1 : max(2, min(lags, span // 2) + 1)].float())
        for row, span in zip(measured, _SPANS, strict=True)
    ]
    grid = np.arange(2 * REACH + 1)
    return torch.from_numpy(np.interp(grid, _SPANS, lengths)).float()


def _pooled(square: Float[np.ndarray, "distances 201"]) -> np.ndarray:
    """RMS in which half of each column's square is its own and half that of all columns of its kind (translation, root
    orientation, rotations, joints): what hardly moved in the windows seen may move in others."""
    pooled = square.copy()
    for kind in (TRANSLATION, ROOT_ROTATION, BODY_ROTATIONS, JOINTS):
        pooled[:, kind] = 0.5 * square[:, kind] + 0.5 * square[:, kind].mean(1, keepdims=True)
    return np.sqrt(pooled)


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
    """`noisy_features` of a batch."""
    pose = batch.R_parent_joint, batch.translation_m, batch.rest_joints_m
    return noisy_features(*pose, batch.noise_level, batch.turn_noise, batch.shift_noise)


def noisy_features(
    R_parent_joint: Tensor,
    translation_m: Tensor,
    rest_joints_m: Tensor,
    noise_level: Float[Tensor, "batch"],
    turn_noise: Float[Tensor, "batch frames 22 3"],
    shift_noise: Float[Tensor, "batch frames 3"],
) -> Float[Tensor, "batch frames 201"]:
    """Features with Gaussian noise of l degrees on every joint's rotation and l centimeters on the translation."""
    level = noise_level[:, None, None]
    turn = matrix_from_axis_angle(turn_noise * (level[..., None] * torch.pi / 180))
    noisy = (R_parent_joint[..., :, :, None] * turn[..., None, :, :]).sum(-2)
    return features_of(noisy, translation_m + 0.01 * level * shift_noise, rest_joints_m)


def shifted_local(batch: Batch) -> Float[Tensor, "batch frames anchors 3"]:
    """Offsets to the scene as a body that stands off by the translation's noise has them (to first order, for surfaces
    that face the anchor)."""
    shift = 0.01 * batch.noise_level[:, None, None] * batch.shift_noise
    local = batch.local.float()
    return local - shift[:, :, None]
