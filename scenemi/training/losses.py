"""The training objective (paper eqs. 1 to 4, and 3.2.1 for noisy keyframes)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from scenemi.features import JOINTS, Statistics, body_lengths
from scenemi.model.base import join_keyframes
from scenemi.model.build import AnyDenoiser
from scenemi.model.conditions import Conditions, impute
from scenemi.model.denoiser import Denoiser, Prepared, body_points
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.kinematics import joints_of
from scenemi.scene.field import BoxField, SceneField, VolumeField
from scenemi.training.batches import LOOKED_AT, Batch
from scenemi.training.config import TrainConfig
from scenemi.training.descriptors import descriptors_of
from scenemi.training.noise import noisy_features
from video2anim.body.shaped_body import ShapedBody

_MIN_FEATURE, _MIN_JOINT_M = 0.02, 0.01
"""Errors below these (standard deviations; meters for each joint) need not become smaller."""
_STEP_M, _CHANGE_M = 0.01, 0.004
"""Between median and root mean square of what joined keyframes miss of a joint's displacement in a frame, and of its
change from frame to frame; hardly other at other distances from a keyframe."""
_SKIN_M = 0.12
"""The skin lies at most this far from joints: nearer to solids than the truth is wrong up to this distance."""


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
    inside: Tensor
    """How much nearer to solids joints are than the truth, cm, mean over windows with a scene."""


class TrainingLoss(nn.Module):
    """Noises a batch, denoises it, and compares."""

    mean: Tensor
    std: Tensor
    rest_joints_m: Tensor
    lengths: Tensor

    def __init__(
        self,
        denoiser: AnyDenoiser,
        statistics: Statistics,
        bodies: Sequence[ShapedBody],
        config: TrainConfig,
    ) -> None:
        super().__init__()
        self.denoiser, self.bodies, self.config = denoiser, tuple(bodies), config
        self.schedule = CosineSchedule()
        lengths = statistics.normalize_body(np.stack([body_lengths(body) for body in bodies]))
        for name, value in (
            ("mean", statistics.mean), ("std", statistics.std), ("lengths", lengths.astype(np.float32)),
            ("rest_joints_m", np.stack([body.rest_joints_m for body in bodies]).astype(np.float32)),
        ):  # fmt: skip
            self.register_buffer(name, torch.from_numpy(value), persistent=False)

    def forward(self, batch: Batch) -> Losses:
        """Losses of one batch."""
        with torch.no_grad():
            x0, x, given, prepared = self._noised(batch)
            estimate = None
            if prepared is not None and given.field is not None and batch.condition_on_estimate > 0:
                estimate = self.denoiser(x, batch.step, given, None, prepared)
        made = self.denoiser(x, batch.step, given, estimate, prepared)
        return self.compared(made, x0, batch, given.field, prepared if self.config.relative else None)

    @torch.no_grad()
    def set_input_scales(self, drawn: Sequence[Batch]) -> None:
        """Measure what the network reads on some batches, in half of which the estimate is the truth."""
        model = self.denoiser
        assert isinstance(model, Denoiser)
        inputs = []
        for i, batch in enumerate(drawn):
            x0, x, given, prepared = self._noised(batch)
            inputs.append(model.inputs(x, batch.step, given, x0 if i % 2 else None, prepared or model.prepare(given)))
        model.set_input_scales(torch.cat(inputs))

    def _noised(self, batch: Batch) -> tuple[Tensor, Tensor, Conditions, Prepared | None]:
        """x_0, x_t with keyframes imputed, conditions, and what the shipped model prepares of them."""
        x0 = (batch.features - self.mean) / self.std
        keys = self._keyframes(batch, x0)
        given = self._conditions(batch, keys)
        prepared = self.denoiser.prepare(given) if isinstance(self.denoiser, Denoiser) else None
        noise = self.denoiser.noise(batch.diffusion_noise, prepared)
        center = self.denoiser.center(given)
        noised = center + self.schedule.add_noise(x0 - center, batch.step, noise)
        return x0, impute(noised, keys, given.imputed), given, prepared

    def _conditions(self, batch: Batch, keys: Tensor) -> Conditions:
        exact = torch.ones_like(batch.step, dtype=torch.bool).index_fill(0, batch.noisy, False)
        steered = exact | (batch.step > self.config.stop_step)
        given = Conditions(
            mask=batch.mask,
            imputed=batch.mask * steered[:, None],
            base=join_keyframes(keys, batch.mask),
            noise=batch.noise,
            body=self.lengths[batch.body],
            field=batch.scene.field(batch.scene_known) if bool(batch.scene_known.any()) else None,
        )
        if isinstance(self.denoiser, Denoiser):
            return given
        raw = keys * self.std + self.mean
        found = descriptors_of(batch, raw, self.bodies, self.denoiser.config)
        return replace(given, descriptors=found).with_keyframes(self.denoiser.keyframes)

    def _keyframes(self, batch: Batch, x0: Tensor) -> Tensor:
        """Normalized features with the noise of the keyframes; most windows have none."""
        if not len(batch.noisy):
            return x0
        keys, rest = x0.clone(), self.rest_joints_m[batch.body[batch.noisy]]
        made = noisy_features(batch.features[batch.noisy], rest, batch.turn_rad, batch.shift_m)
        keys[batch.noisy] = (made - self.mean) / self.std
        return keys

    def compared(
        self,
        made: Float[Tensor, "batch frames 201"],
        x0: Float[Tensor, "batch frames 201"],
        batch: Batch,
        field: SceneField | None = None,
        prepared: Prepared | None = None,
    ) -> Losses:
        """Losses of an estimate, normalized; relative to the errors expected of the joined keyframes where `prepared`
        tells them. Joints by forward kinematics are compared in a piece of each window."""
        config = self.config
        frames = batch.looked_at[:, None] + torch.arange(min(LOOKED_AT, x0.shape[1]), device=x0.device)
        row = torch.arange(len(x0), device=x0.device)[:, None]
        valid = batch.valid[row, frames]
        joints = joints_of(made[row, frames] * self.std + self.mean, self.rest_joints_m[batch.body])
        true = batch.features[row, frames][..., JOINTS].unflatten(-1, (22, 3))
        apart = (joints - true).square().sum(-1)
        moves = (joints.diff(dim=1) - true.diff(dim=1)).square().sum(-1)
        simple = per_window((made - x0).square().mean(-1), batch.valid)
        off, velocity = per_window(apart.sum(-1), valid), per_window(moves.sum(-1), valid[:, 1:])
        inside = self._inside(joints, true, field)
        if prepared is None:
            total = simple + config.joints_weight * off + config.velocity_weight * velocity
        else:
            scale = prepared.scale
            of_features = scale.square() + _MIN_FEATURE**2
            of_joint = (scale[row, frames][..., JOINTS] * self.std[JOINTS]).square().sum(-1, keepdim=True) / 22
            of_joint = of_joint + _MIN_JOINT_M**2
            total = (
                per_window(robust((made - x0).square() / of_features).mean(-1), batch.valid)
                + config.joints_weight * per_window(robust(apart / of_joint).mean(-1), valid)
                + config.velocity_weight * per_window(robust(moves / _STEP_M**2).mean(-1), valid[:, 1:])
            )
            if config.acceleration_weight:
                changes = (joints - true).diff(n=2, dim=1).square().sum(-1)
                change = per_window(robust(changes / _CHANGE_M**2).mean(-1), valid[:, 2:])
                total = total + config.acceleration_weight * change
        return Losses(total + config.inside_weight * inside, simple, off, velocity, inside)

    def _inside(self, joints: Tensor, true: Tensor, field: SceneField | None) -> Tensor:
        if not isinstance(field, BoxField | VolumeField) or not len(field.rows):
            return joints.new_zeros(())
        distance, least = (field.distance_m(body_points(j).flatten(1, 2)) for j in (joints, true))
        return 100 * functional.relu(least.clamp(max=_SKIN_M) - distance).mean()


def robust(square: Tensor) -> Tensor:
    """Square of small relative errors, twice the absolute value of large ones (Charbonnier): clips whose movement no
    keyframe tells do not rule the gradient."""
    return 2 * ((1 + square).sqrt() - 1)


def per_window(error: Float[Tensor, "batch frames"], valid: Float[Tensor, "batch frames"]) -> Tensor:
    """Mean over the valid frames of each window, then over windows."""
    return ((error * valid).sum(1) / valid.sum(1).clamp(min=1)).mean()
