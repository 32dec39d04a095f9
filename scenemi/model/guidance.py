"""Extra costs while sampling: each estimate of the clean window takes a few descent steps before it is used.

A cost sees joints by forward kinematics of the decoded features, in metres, in the canonical frame of each window. The
descent direction is smoothed over time and its length found by trying halves of the longest, so no cost needs a tuned
step size and none can make a motion jitter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from scenemi.features import Statistics
from scenemi.metrics import ANKLES, GMD_SPEED_M_S, GMD_TOE_HEIGHT_M, ROHM_ANKLE_HEIGHT_M, TOES
from scenemi.model.kinematics import Pose, pose_of
from scenemi.scene.body_balls import BodyBalls

_LONGEST_STEP = 0.2
"""Largest change of a feature in one descent step, in standard deviations."""
_HALVINGS = 5
_NEARLY = 0.05
"""Share of the largest gain by which a step may gain less and still count."""
_LOW_WITHIN_M = 0.005
"""A foot is taken for low more and more over so many metres: rounding must not decide."""
_NEAR_M = 0.15
"""A descent does not move a ball farther."""

Value = Callable[[Pose], Tensor]
"""Poses to one cost per window: (batch,), or (tries, batch) where poses have that axis before the windows'."""


class Cost(Protocol):
    """What is to be low."""

    @property
    def weight(self) -> float:
        """Makes costs of different units comparable."""
        ...

    def about(self, pose: Pose) -> Value:
        """The cost near some poses: what it treats as fixed (which feet stand) is read off there."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ContactCost:
    """Feet that stand do not move: mean squared speed, (m/s)^2, of low and slow ankles and balls of the feet."""

    fps: float
    weight: float = 1.0

    def about(self, pose: Pose) -> Value:
        feet = pose.joints_m[:, :, (*ANKLES, *TOES)].detach()
        limit_m = feet.new_tensor([ROHM_ANKLE_HEIGHT_M] * len(ANKLES) + [GMD_TOE_HEIGHT_M] * len(TOES))
        low = torch.sigmoid((limit_m - feet[..., 1]) / _LOW_WITHIN_M)
        speed = self._velocity(feet).norm(dim=-1)
        stands = low[:, 1:] * low[:, :-1] * torch.exp(-((speed / GMD_SPEED_M_S) ** 2))

        def value(pose: Pose) -> Tensor:
            velocity = self._velocity(pose.joints_m[..., (*ANKLES, *TOES), :])
            return (stands * (velocity**2).sum(-1)).mean((-2, -1))

        return value

    def _velocity(self, feet_m: Tensor) -> Tensor:
        return self.fps * feet_m.diff(dim=-3)


@dataclass(frozen=True, slots=True, eq=False)
class PenetrationCost:
    """The body keeps out of solids: squared depth of its balls (`scenemi.scene.body_balls`) in cm^2, summed over balls,
    mean over frames."""

    distances: Sequence[Callable[[Tensor], Tensor] | None]
    """Per window, signed distance at canonical points (..., 3), differentiable, positive in free space; None = no
    scene."""
    balls: Sequence[BodyBalls]
    """Per window."""
    allowed_m: Sequence[Float[Tensor, "balls"]]
    """Per window, how deep each ball may be."""
    weight: float = 1.0

    def about(self, pose: Pose) -> Value:
        """Only balls that come near a solid are looked at."""
        near = []
        for i, distance in enumerate(self.distances):
            if distance is None:
                near.append(torch.zeros(0, dtype=torch.long))
                continue
            clear_m = self.clearance_m(pose, i).amin(0)
            near.append(torch.nonzero(clear_m < _NEAR_M)[:, 0].cpu())

        def value(pose: Pose) -> Tensor:
            return torch.stack([self._total(pose, i, chosen) for i, chosen in enumerate(near)], -1)

        return value

    def depth_m(self, pose: Pose) -> Float[Tensor, "batch"]:
        """The deepest that a ball of each window is in a solid, beyond what it may."""
        depths = []
        for i, distance in enumerate(self.distances):
            none = pose.joints_m.new_zeros(())
            depths.append(none if distance is None else functional.relu(-self.clearance_m(pose, i)).max())
        return torch.stack(depths)

    def _total(self, pose: Pose, i: int, chosen: Tensor) -> Tensor:
        if not len(chosen):
            return pose.joints_m.new_zeros(pose.joints_m.shape[:-4])
        return 1e4 * (functional.relu(-self.clearance_m(pose, i, chosen)) ** 2).sum(-1).mean(-1)

    def clearance_m(
        self, pose: Pose, i: int, chosen: Int[Tensor, "chosen"] | None = None
    ) -> Float[Tensor, "*tries frames chosen"]:
        """How far balls of window `i`, which has a scene, are from solids; less than zero: deeper than they may be."""
        distance = self.distances[i]
        assert distance is not None
        chosen = torch.arange(len(self.balls[i].joint)) if chosen is None else chosen
        rows = chosen.numpy()
        radius_m = torch.from_numpy(self.balls[i].radius_m[rows]).to(pose.joints_m)
        allowed_m = self.allowed_m[i].to(pose.joints_m)[chosen]
        return distance(placed_balls(self.balls[i], pose, i, rows)) - radius_m + allowed_m


def placed_balls(
    balls: BodyBalls, pose: Pose, window: int, rows: Int[np.ndarray, "chosen"]
) -> Float[Tensor, "*tries frames chosen 3"]:
    """Centers of some balls of one window."""
    joint = balls.joint[rows]
    center = torch.from_numpy(balls.center_joint_m[rows]).to(pose.joints_m)
    turned = (pose.R_world_joint[..., window, :, :, :, :][..., joint, :, :] @ center[:, :, None])[..., 0]
    return pose.joints_m[..., window, :, :, :][..., joint, :] + turned


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeCost:
    """Joints at keyframes are the keyframes': mean squared distance, in cm^2."""

    joints_m: Float[Tensor, "batch frames 22 3"]
    mask: Float[Tensor, "batch frames"]
    weight: float = 1.0

    def about(self, pose: Pose) -> Value:
        share = self.mask / self.mask.sum(1, keepdim=True)

        def value(pose: Pose) -> Tensor:
            return 1e4 * (share * ((pose.joints_m - self.joints_m) ** 2).sum(-1).mean(-1)).sum(-1)

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
        moved: Float[Tensor, "201"] | None = None,
        stay: float = 0.0,
    ) -> None:
        """`moved` is 1 at features that may change, 0 at the others; None = all may. `stay` weighs the mean squared
        displacement of joints, in cm^2: without it a step that is longer than needed costs nothing."""
        self.moved, self.stay = moved, stay
        self.statistics, self.rest_joints_m, self.costs = statistics, rest_joints_m, tuple(costs)
        self.iterations, self.smooth_frames = iterations, smooth_frames

    def pose(self, x0: Float[Tensor, "*tries batch frames 201"]) -> Pose:
        """Joints of normalized features, in the canonical frame."""
        features, rest_joints_m = self.statistics.denormalize(x0), self.rest_joints_m.to(x0)
        if x0.ndim == 3:
            return pose_of(features, rest_joints_m)
        pose = pose_of(features.flatten(0, 1), rest_joints_m.repeat(len(x0), 1, 1))
        return Pose(*(part.unflatten(0, x0.shape[:2]) for part in (pose.joints_m, pose.R_world_joint)))

    def __call__(self, x0: Float[Tensor, "batch frames 201"]) -> Float[Tensor, "batch frames 201"]:
        """The window after a few descent steps; windows whose cost no step lowers stay as they are."""
        with torch.no_grad():
            given = self.pose(x0)
            values = [(cost.weight, cost.about(given)) for cost in self.costs]

        def total(x: Tensor) -> Tensor:
            pose = self.pose(x)
            costs = [weight * value(pose) for weight, value in values]
            if self.stay:
                costs.append(1e4 * self.stay * (pose.joints_m - given.joints_m).square().sum(-1).mean((-2, -1)))
            return torch.stack(costs).sum(0)

        x = x0.detach()
        for _ in range(self.iterations):
            before, x = x, self._step(x, total)
            if torch.equal(before, x):
                break
        return x

    def _step(self, x: Tensor, total: Callable[[Tensor], Tensor]) -> Tensor:
        with torch.enable_grad():
            free = x.clone().requires_grad_(True)
            cost = total(free)
            if not cost.requires_grad:
                return x
            (gradient,) = torch.autograd.grad(cost.sum(), free)
        direction = smoothed_over_time(gradient, self.smooth_frames)
        if self.moved is not None:
            direction = direction * self.moved.to(direction)
        peak = direction.abs().amax((1, 2), keepdim=True)
        length = _LONGEST_STEP / peak.clamp(min=1e-12)
        with torch.no_grad():
            tried = torch.stack([length * 0.5**halving for halving in range(_HALVINGS)])
            costs = total(x - tried * direction)
            gain = (cost.detach() - costs).clamp(min=0)
            # Lengths that gain nearly as much as the best one share in it: rounding must not choose between them.
            share = torch.exp((gain / gain.amax(0).clamp(min=1e-30) - 1) / _NEARLY) * (gain > 0)
            mean = (share[:, :, None, None] * tried).sum(0) / share.sum(0).clamp(min=1e-30)[:, None, None]
            moved = x - mean * direction
            return torch.where((total(moved) < cost)[:, None, None], moved, x)


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
