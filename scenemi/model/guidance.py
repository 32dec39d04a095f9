"""Extra costs while sampling: each estimate of the clean window takes a few descent steps before it is used.

A cost sees joints by forward kinematics of the decoded features, in metres, in the canonical frame of each window. The
descent direction is smoothed over time and its length found by halving until the cost falls, so no cost needs a tuned
step size and none can make a motion jitter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from scenemi.features import Statistics
from scenemi.metrics import ANKLES, GMD_SPEED_M_S, GMD_TOE_HEIGHT_M, ROHM_ANKLE_HEIGHT_M, TOES
from scenemi.model.kinematics import joints_of
from video2anim.body.skeleton import PARENTS

_LONGEST_STEP = 0.2
"""Largest change of a feature in one descent step, in standard deviations."""
_HALVINGS = 5

Value = Callable[[Tensor], Tensor]
"""Joints (B, N, 22, 3) to one cost per window (B,)."""


class Cost(Protocol):
    """What is to be low."""

    @property
    def weight(self) -> float:
        """Makes costs of different units comparable."""
        ...

    def about(self, joints_m: Tensor) -> Value:
        """The cost near some joints (B, N, 22, 3): what it treats as fixed (which feet stand) is read off there."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ContactCost:
    """Feet that stand do not move: mean squared speed, (m/s)^2, of low and slow ankles and balls of the feet."""

    fps: float
    weight: float = 1.0

    def about(self, joints_m: Tensor) -> Value:
        feet = joints_m[:, :, (*ANKLES, *TOES)].detach()
        limit_m = feet.new_tensor([ROHM_ANKLE_HEIGHT_M] * len(ANKLES) + [GMD_TOE_HEIGHT_M] * len(TOES))
        low = feet[..., 1] < limit_m
        speed = self._velocity(feet).norm(dim=-1)
        stands = (low[:, 1:] & low[:, :-1]) * torch.exp(-((speed / GMD_SPEED_M_S) ** 2))

        def value(joints_m: Tensor) -> Tensor:
            velocity = self._velocity(joints_m[:, :, (*ANKLES, *TOES)])
            return (stands * (velocity**2).sum(-1)).mean((1, 2))

        return value

    def _velocity(self, feet_m: Tensor) -> Tensor:
        return self.fps * (feet_m[:, 1:] - feet_m[:, :-1])


@dataclass(frozen=True, slots=True, eq=False)
class PenetrationCost:
    """Bones keep out of solids: mean squared depth, in cm^2, of joints and bone middles with a flesh radius."""

    distances: Sequence[Callable[[Tensor], Tensor] | None]
    """Per window, signed distance at world points (..., 3), differentiable, positive in free space; None = no scene."""
    T_world_canonical: Float[Tensor, "batch 4 4"]
    weight: float = 1.0
    radius_m: float = 0.06
    """Flesh around bones: of the order of a forearm's or a shin's; the trunk's is larger."""

    def about(self, joints_m: Tensor) -> Value:
        parents = [int(parent) for parent in PARENTS[1:]]

        def value(joints_m: Tensor) -> Tensor:
            # Feet stand on the floor with less flesh below them than the radius: they are left out.
            middles = 0.5 * (joints_m[:, :, 1:] + joints_m[:, :, parents])
            feet = {*ANKLES, *TOES}
            joints = joints_m[:, :, [j for j in range(len(PARENTS)) if j not in feet]]
            bones = middles[:, :, [j - 1 for j in range(1, len(PARENTS)) if j not in feet]]
            points = torch.cat([joints, bones], 2)
            T = self.T_world_canonical.to(points)
            world = points @ T[:, None, :3, :3].transpose(-1, -2) + T[:, None, None, :3, 3]
            depths = [
                torch.zeros_like(at[..., 0]) if distance is None else functional.relu(self.radius_m - distance(at))
                for at, distance in zip(world, self.distances, strict=True)
            ]
            return 1e4 * (torch.stack(depths) ** 2).mean((1, 2))

        return value


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeCost:
    """Joints at keyframes are the keyframes': mean squared distance, in cm^2."""

    joints_m: Float[Tensor, "batch frames 22 3"]
    mask: Float[Tensor, "batch frames"]
    weight: float = 1.0

    def about(self, joints_m: Tensor) -> Value:
        share = self.mask / self.mask.sum(1, keepdim=True)

        def value(joints_m: Tensor) -> Tensor:
            return 1e4 * (share * ((joints_m - self.joints_m) ** 2).sum(-1).mean(-1)).sum(1)

        return value


class Guidance:
    """Lowers a weighted sum of costs of an estimated clean window (an `Adjust` of `scenemi.model.sampling`)."""

    def __init__(
        self,
        statistics: Statistics,
        rest_joints_m: Float[Tensor, "batch 22 3"],
        costs: Sequence[Cost],
        *,
        iterations: int = 3,
        smooth_frames: float = 2.0,
    ) -> None:
        self.statistics, self.rest_joints_m, self.costs = statistics, rest_joints_m, tuple(costs)
        self.iterations, self.smooth_frames = iterations, smooth_frames

    def joints_m(self, x0: Float[Tensor, "batch frames 201"]) -> Float[Tensor, "batch frames 22 3"]:
        """Joints of normalized features, in the canonical frame."""
        return joints_of(self.statistics.denormalize(x0), self.rest_joints_m.to(x0))

    def __call__(self, x0: Float[Tensor, "batch frames 201"]) -> Float[Tensor, "batch frames 201"]:
        """The window after a few descent steps; windows whose cost no step lowers stay as they are."""
        with torch.no_grad():
            values = [(cost.weight, cost.about(self.joints_m(x0))) for cost in self.costs]

        def total(x: Tensor) -> Tensor:
            joints_m = self.joints_m(x)
            return torch.stack([weight * value(joints_m) for weight, value in values]).sum(0)

        x = x0.detach()
        for _ in range(self.iterations):
            x = self._step(x, total)
        return x

    def _step(self, x: Tensor, total: Callable[[Tensor], Tensor]) -> Tensor:
        with torch.enable_grad():
            free = x.clone().requires_grad_(True)
            cost = total(free)
            if not cost.requires_grad:
                return x
            (gradient,) = torch.autograd.grad(cost.sum(), free)
        direction = smoothed_over_time(gradient, self.smooth_frames)
        peak = direction.abs().amax((1, 2), keepdim=True)
        length = _LONGEST_STEP / peak.clamp(min=1e-12)
        with torch.no_grad():
            best, lowest = x, cost.detach()
            for halving in range(_HALVINGS):
                tried = x - length * 0.5**halving * direction
                now = total(tried)
                better = now < lowest
                best = torch.where(better[:, None, None], tried, best)
                lowest = torch.where(better, now, lowest)
        return best


def smoothed_over_time(x: Float[Tensor, "batch frames features"], sigma_frames: float) -> Tensor:
    """Gaussian filter along the frames, nothing beyond the ends: a symmetric positive operator, so a smoothed gradient
    is still a direction of descent."""
    half_sigma = sigma_frames / math.sqrt(2)
    reach = math.ceil(3 * half_sigma)
    lag = torch.arange(-reach, reach + 1, dtype=x.dtype, device=x.device)
    root = torch.exp(-0.5 * (lag / half_sigma) ** 2)
    # A kernel that is another one's correlation with itself has no negative frequency.
    kernel = functional.conv1d(root[None, None], root[None, None], padding=2 * reach)
    rows = x.transpose(1, 2).reshape(-1, 1, x.shape[1])
    out = functional.conv1d(rows, kernel / kernel.sum(), padding=2 * reach)
    return out.reshape(x.shape[0], x.shape[2], x.shape[1]).transpose(1, 2)
