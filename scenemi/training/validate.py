"""Validation during training: in-betweening of fixed windows of the validation part, without and with scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scenemi.data.windows import MotionSet
from scenemi.features import Statistics, body_lengths, canonical_frame, encode, to_canonical
from scenemi.metrics import INSIDE_M
from scenemi.model.base import join_keyframes
from scenemi.model.build import AnyDenoiser
from scenemi.model.conditions import Conditions
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.kinematics import joints_of
from scenemi.model.sampling import SamplerConfig, sample
from scenemi.scene.body_spheres import fit_spheres
from scenemi.scene.pseudo import SyntheticScenes
from scenemi.scene.rows import BoxRows, SceneRows
from scenemi.training.pool import scene_boxes
from scenemi.training.scene_pool import SceneMotions
from scenemi.windows import KEYFRAME_INTERVALS
from video2anim.types.skeleton import forward_kinematics

SCENE_INTERVAL = KEYFRAME_INTERVALS[-1]
_WINDOWS = 96
"""Of the validation clips (not measured)."""
_SAMPLER = SamplerConfig()
_SCENE_SEED = 77
"""Any number."""


@dataclass(frozen=True, slots=True)
class Validation:
    """Means over windows at one keyframe interval."""

    interval: int
    scene: bool
    """Whether the scenes were inputs of the denoiser; `inside` is measured against them in either case."""
    mjpe_ratio: float
    """Mean joint error over that of the joined keyframes."""
    jerk_ratio: float
    """Jerk over that of the truth."""
    inside: float
    """Share of frames with a joint more than 1 cm inside a solid; NaN where no scene was looked at."""


class Validator:
    """Samples the same windows each time."""

    def __init__(self, motions: MotionSet, statistics: Statistics) -> None:
        batches = list(motions.fixed_windows(full_only=True, body=0)) or list(motions.fixed_windows(body=0))
        R = np.concatenate([batch.R_parent_joint for batch in batches])
        chosen = np.linspace(0, len(R) - 1, min(_WINDOWS, len(R))).astype(int)
        translation_m = np.concatenate([batch.translation_m for batch in batches])[chosen]
        contact = np.concatenate([batch.contact for batch in batches])[chosen]
        T_world_canonical = canonical_frame(R[chosen, 0, 0], translation_m[:, 0])
        R, translation_m = to_canonical(R[chosen], translation_m)
        rest_m = np.repeat(motions.rest_joints_m[:1], len(chosen), 0)
        self.statistics, self.rest = statistics, torch.from_numpy(rest_m)
        lengths = statistics.normalize_body(body_lengths(motions.body(0))).astype(np.float32)
        self.body = torch.from_numpy(lengths).expand(len(chosen), -1)
        self.features = torch.from_numpy(encode(R, translation_m, rest_m)).float()
        joints_m, R_world = forward_kinematics(R, translation_m, rest_m[:, None])
        self.true_m = torch.from_numpy(joints_m).float()
        blind_m = join_keyframes(self.true_m.flatten(2), self._mask(SCENE_INTERVAL)).unflatten(-1, (22, 3)).numpy()
        if isinstance(motions, SceneMotions):
            clip = np.concatenate([batch.clip for batch in batches])[chosen]
            around_m = np.concatenate([joints_m, blind_m], 1).reshape(len(chosen), -1, 3)
            self.scene: SceneRows = motions.volumes(T_world_canonical, clip, np.zeros_like(clip), around_m)
            return
        scenes, spheres = SyntheticScenes(), fit_spheres(motions.body(0))
        motion = zip(joints_m, R_world, contact, blind_m, strict=True)
        rows = [
            scene_boxes(scenes, np.random.default_rng([_SCENE_SEED, i]), joints, R, touching, spheres, blind)
            for i, (joints, R, touching, blind) in enumerate(motion)
        ]
        self.scene = BoxRows(torch.from_numpy(np.stack(rows)))

    def __call__(self, denoiser: AnyDenoiser) -> tuple[Validation, ...]:
        """Rows for each interval without scenes, then for 60 frames in scenes that are not shown, and shown."""
        was_training = denoiser.training
        denoiser.eval()
        blind = [self.row(denoiser, interval) for interval in KEYFRAME_INTERVALS[:-1]]
        last = [self.row(denoiser, SCENE_INTERVAL, shown=shown) for shown in (False, True)]
        denoiser.train(was_training)
        return (*blind, *last)

    @torch.no_grad()
    def row(self, denoiser: AnyDenoiser, interval: int, *, shown: bool | None = None) -> Validation:
        """One row; `shown` None leaves the scenes out altogether."""
        device = next(denoiser.parameters()).device
        keys = self.statistics.normalize(self.features).to(device)
        mask = self._mask(interval).to(device)
        field = self.scene.to(device).field(torch.ones(len(keys), device=device))
        given = Conditions(
            mask=mask, imputed=mask, base=join_keyframes(keys, mask), noise=torch.zeros(*mask.shape, 2, device=device),
            body=self.body.to(device), field=field if shown else None,
        )  # fmt: skip
        generators = [torch.Generator().manual_seed(i) for i in range(len(keys))]
        made = sample(denoiser, CosineSchedule(), keys, given, _SAMPLER, generators)
        made = torch.where(mask[..., None] > 0, keys, made)
        joints, joined = self._joints(made), self._joints(given.base)
        inside = float("nan")
        if shown is not None:
            depth = field.distance_m(joints.to(device).flatten(1, 2)).unflatten(1, (-1, 22)).amin(-1)
            inside = float((depth < -INSIDE_M).float().sum() / (len(keys) * depth.shape[1]))
        return Validation(
            interval,
            bool(shown),
            float((joints - self.true_m).norm(dim=-1).mean() / (joined - self.true_m).norm(dim=-1).mean()),
            float(_jerk(joints) / _jerk(self.true_m)),
            inside,
        )

    def _mask(self, interval: int) -> Float[Tensor, "batch frames"]:
        mask = torch.zeros(self.true_m.shape[:2])
        mask[:, ::interval] = mask[:, -1] = 1
        return mask

    def _joints(self, normalized: Tensor) -> Float[Tensor, "batch frames 22 3"]:
        return joints_of(self.statistics.denormalize(normalized).cpu(), self.rest)


def _jerk(joints: Tensor) -> Tensor:
    return joints.diff(n=3, dim=1).norm(dim=-1).mean()
