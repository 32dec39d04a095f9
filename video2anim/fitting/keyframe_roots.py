"""Root displacements of keyframes from five losses (paper 8.2): the maths behind the keyframes stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from video2anim.fitting.optimize import one_thread
from video2anim.geometry.chamfer import ChamferConfig, ChamferLoss, huber_of_square
from video2anim.geometry.sdf import SdfGrid

_DEPTH_TRIM_RATIO = 0.1
"""Share of the farthest depth and skin points left out: hair, clothes, mask borders."""


@dataclass(frozen=True, slots=True)
class RootWeights:
    """Weights of the losses, all of which are mean squares in m^2."""

    regularization: float
    """On displacement along the line of sight, where a single camera is least certain."""
    regularization_across: float
    """On displacement across it, which the picture fixes."""
    contact: float
    penetration: float
    displacement_change: float
    acceleration: float
    depth: float
    huber_m: float
    contact_points: int


@dataclass(frozen=True, slots=True, eq=False)
class ContactPart:
    """Skin of one part at the keyframes where it touches."""

    keyframe: Int[np.ndarray, "touches"]
    """Rows of `RootProblem.root_m`."""
    skin_m: Float[np.ndarray, "touches vertices 3"]
    probability: Float[np.ndarray, "touches"]


@dataclass(frozen=True, slots=True, eq=False)
class DepthTarget:
    """One frame's visible skin and depth points; the frame need not be a keyframe."""

    frame: int
    visible_m: Float[np.ndarray, "vertices 3"]
    depth_m: Float[np.ndarray, "points 3"]


@dataclass(frozen=True, slots=True, eq=False)
class RootProblem:
    """One person's keyframes, world frame."""

    frame: Int[np.ndarray, "keyframes"]
    root_m: Float[np.ndarray, "keyframes 3"]
    sight: Float[np.ndarray, "keyframes 3"]
    """Unit vector from the camera to the root."""
    skin_m: Float[np.ndarray, "points 3"]
    """Vertices to be kept out of solids, of keyframes and of frames between them."""
    skin_frame: Int[np.ndarray, "points"]
    """Frame of each of them."""
    contacts: tuple[ContactPart, ...]
    depth: tuple[DepthTarget, ...]
    scene: SdfGrid


@one_thread()
def solve_root_displacements(
    problem: RootProblem, weights: RootWeights, *, iterations: int, learning_rate_m: float
) -> Float[np.ndarray, "keyframes 3"]:
    """Displacements that minimize the weighted losses: Adam from zero, step size falling along a cosine."""
    losses = _Losses(problem, weights)
    displacement_m = torch.zeros(len(problem.frame), 3, requires_grad=True)
    optimizer = torch.optim.Adam([displacement_m], lr=learning_rate_m)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=max(1, iterations))
    for _ in range(iterations):
        optimizer.zero_grad()
        losses(displacement_m).backward()
        optimizer.step()
        schedule.step()
    return displacement_m.detach().numpy().astype(np.float64)


def contact_distance_m(
    part: ContactPart, displacement_m: Float[np.ndarray, "keyframes 3"], scene: SdfGrid, points: int
) -> Float[np.ndarray, "touches"]:
    """Signed distance of each touching part to the scene: mean over its `points` deepest vertices."""
    moved = part.skin_m + displacement_m[part.keyframe][:, None]
    return np.sort(scene.sample(moved), axis=1)[:, :points].mean(axis=1)


class _Losses:
    """Weighted sum of the five losses as a function of the displacements."""

    def __init__(self, problem: RootProblem, weights: RootWeights) -> None:
        self.weights, self.problem = weights, problem
        self.sight = _tensor(problem.sight)
        self.root_m, self.skin_m = _tensor(problem.root_m), _tensor(problem.skin_m)
        frames, rows = np.unique(problem.skin_frame, return_inverse=True)
        self.frames, self.skin_row = max(len(frames), 1), torch.as_tensor(rows)
        self.skin_place = _between(problem.frame, problem.skin_frame)
        steps = np.diff(problem.frame).astype(np.float64)
        self.step = _tensor(steps / np.median(steps) if len(steps) else steps)
        self.contacts = [
            (torch.as_tensor(part.keyframe), _tensor(part.skin_m), _tensor(part.probability))
            for part in problem.contacts
        ]
        chamfer = ChamferConfig(huber_m=weights.huber_m, trim_ratio=_DEPTH_TRIM_RATIO)
        self.depth = [
            (
                _between(problem.frame, np.array([target.frame])),
                _tensor(target.visible_m),
                ChamferLoss(target.depth_m, chamfer),
            )
            for target in problem.depth
        ]

    def __call__(self, displacement_m: torch.Tensor) -> torch.Tensor:
        w = self.weights
        along_m = (displacement_m * self.sight).sum(-1, keepdim=True)
        across_m = displacement_m - along_m * self.sight
        total = w.regularization * (along_m**2).mean()
        total = total + w.regularization_across * (across_m**2).sum(-1).mean()
        total = total + w.penetration * self._penetration(displacement_m)
        if self.contacts:
            total = total + w.contact * self._contact(displacement_m)
        if len(displacement_m) > 1:
            change = displacement_m.diff(dim=0) / self.step[:, None]
            total = total + w.displacement_change * (change**2).sum(-1).mean()
        if len(displacement_m) > 2:
            total = total + w.acceleration * self._acceleration(displacement_m)
        if self.depth:
            total = total + w.depth * self._depth(displacement_m)
        return total

    def _penetration(self, displacement_m: torch.Tensor) -> torch.Tensor:
        """Mean over frames of the mean squared depth of the vertices that are inside."""
        shift_m = self._at(displacement_m, *self.skin_place)
        inside_m = torch.relu(-self.problem.scene.sample(self.skin_m + shift_m))
        square, count = torch.zeros(self.frames), torch.zeros(self.frames)
        square = square.index_add(0, self.skin_row, inside_m**2)
        count = count.index_add(0, self.skin_row, (inside_m > 0).float())
        return (square / count.clamp(min=1)).mean()

    def _contact(self, displacement_m: torch.Tensor) -> torch.Tensor:
        """Mean over all touches, weighed by probability, of the Huber cost of the part's distance."""
        costs, weights = [], []
        for keyframe, skin_m, probability in self.contacts:
            distance_m = self.problem.scene.sample(skin_m + displacement_m[keyframe][:, None])
            count = min(self.weights.contact_points, distance_m.shape[1])
            nearest_m = distance_m.topk(count, dim=1, largest=False).values.mean(dim=1)
            costs.append(probability * huber_of_square(nearest_m**2, self.weights.huber_m))
            weights.append(probability)
        return torch.cat(costs).sum() / torch.cat(weights).sum()

    def _acceleration(self, displacement_m: torch.Tensor) -> torch.Tensor:
        """Mean squared second difference of the displaced roots, in meters per usual keyframe step squared."""
        velocity = (self.root_m + displacement_m).diff(dim=0) / self.step[:, None]
        span = 0.5 * (self.step[1:] + self.step[:-1])
        return ((velocity.diff(dim=0) / span[:, None]) ** 2).sum(-1).mean()

    def _depth(self, displacement_m: torch.Tensor) -> torch.Tensor:
        """Mean over frames of the Chamfer cost."""
        terms = [chamfer(skin_m + self._at(displacement_m, *place)) for place, skin_m, chamfer in self.depth]
        return torch.stack(terms).mean()

    @staticmethod
    def _at(
        displacement_m: torch.Tensor, left: torch.Tensor, right: torch.Tensor, weight: torch.Tensor
    ) -> torch.Tensor:
        """Displacement (N, 3) at frames between keyframes, linear in time."""
        return displacement_m[left] + weight * (displacement_m[right] - displacement_m[left])


def _between(
    keyframes: Int[np.ndarray, "keyframes"], frames: Int[np.ndarray, "points"]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rows of the keyframes around each frame (N,), and its place between them (N, 1) from 0 to 1."""
    right = np.clip(np.searchsorted(keyframes, frames), 0, len(keyframes) - 1)
    left = np.maximum(right - 1, 0)
    span = np.maximum(keyframes[right] - keyframes[left], 1)
    place = np.clip((frames - keyframes[left]) / span, 0.0, 1.0)
    return torch.as_tensor(left), torch.as_tensor(right), _tensor(place[:, None])


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.asarray(array), dtype=torch.float32)
