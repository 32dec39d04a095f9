"""Left and right: a motion reflected in the plane x = 0, and a denoiser that does not tell the sides apart."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from scenemi.features import FEATURE_COUNT, JOINTS, ROTATIONS
from scenemi.model.conditions import Conditions
from scenemi.model.denoiser import Denoiser, Prepared
from scenemi.scene.field import SceneField
from video2anim.types.skeleton import MIRROR_JOINT


def _mirror_table() -> tuple[Int[Tensor, "201"], Float[Tensor, "201"]]:
    """Where each feature comes from when a motion is reflected in the plane x = 0, and its sign."""
    source, sign = np.arange(FEATURE_COUNT), np.ones(FEATURE_COUNT, np.float32)
    sign[0] = -1
    for joint, other in enumerate(MIRROR_JOINT):
        rotation, position = ROTATIONS.start + 6 * joint, JOINTS.start + 3 * joint
        source[rotation : rotation + 6] = ROTATIONS.start + 6 * other + np.arange(6)
        sign[rotation : rotation + 6] = [1, -1, -1, -1, 1, 1]
        source[position : position + 3] = JOINTS.start + 3 * other + np.arange(3)
        sign[position] = -1
    return torch.from_numpy(source), torch.from_numpy(sign)


_SOURCE, _SIGN = _mirror_table()


def mirrored(features: Float[Tensor, "... 201"]) -> Float[Tensor, "... 201"]:
    """Features (not normalized) of the motion reflected in the plane x = 0, left and right exchanged."""
    return features[..., _SOURCE] * _SIGN.to(features)


@dataclass(frozen=True, slots=True, eq=False)
class MirroredField:
    """Solids reflected in the plane x = 0."""

    field: SceneField

    def query(
        self, points_m: Float[Tensor, "batch points 3"]
    ) -> tuple[Float[Tensor, "batch points"], Float[Tensor, "batch points 3"]]:
        """See `SceneField`."""
        flip = points_m.new_tensor([-1.0, 1.0, 1.0])
        distance_m, out = self.field.query(points_m * flip)
        return distance_m, out * flip


@dataclass(frozen=True, slots=True, eq=False)
class BothSides:
    """What the steps have in common, and the same of the reflected window."""

    own: Prepared
    mirrored: Prepared
    conditions: Conditions
    """Of the reflected window."""


class EvenDenoiser:
    """Mean of a denoiser's answers to a window and to its reflection. A reflected motion is as likely, but a trained
    network answers the two differently: the mean has 2 to 3 % less error than one answer, for twice the time
    (`benchmarks/scenemi/choices.py sampler --every 2`)."""

    def __init__(self, denoiser: Denoiser) -> None:
        self.denoiser = denoiser

    def __call__(
        self, x: Tensor, t: Tensor, given: Conditions, estimate: Tensor | None, prepared: BothSides, /
    ) -> Tensor:
        """See `Denoiser.forward`."""
        other = replace(prepared.conditions, imputed=given.imputed)
        reflected = None if estimate is None else self._reflect(estimate)
        own = self.denoiser(x, t, given, estimate, prepared.own)
        return (own + self._reflect(self.denoiser(self._reflect(x), t, other, reflected, prepared.mirrored))) / 2

    def prepare(self, given: Conditions) -> BothSides:
        """See `Denoiser.prepare`."""
        field = None if given.field is None else MirroredField(given.field)
        other = replace(given, base=self._reflect(given.base), field=field)
        return BothSides(self.denoiser.prepare(given), self.denoiser.prepare(other), other)

    def center(self, given: Conditions) -> Tensor:
        """See `Denoiser.center`."""
        return self.denoiser.center(given)

    def noise(self, white: Tensor, prepared: BothSides) -> Tensor:
        """See `Denoiser.noise`."""
        return self.denoiser.noise(white, prepared.own)

    def _reflect(self, normalized: Tensor) -> Tensor:
        mean, std = self.denoiser.feature_mean, self.denoiser.feature_std
        return (mirrored(normalized * std + mean) - mean) / std
