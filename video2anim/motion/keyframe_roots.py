"""Displacements of keyframe roots along their lines of sight by four losses (SceneMI, supplement section 8.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize

from scenemi.postprocess.motion_solve import TOUCHING_POINTS
from video2anim.geometry.robust import huber_of_square
from video2anim.geometry.sdf import SdfGrid
from video2anim.geometry.torch_threads import one_thread

REGULARIZATION = 2.0
"""Weight of the mean squared displacement; that of contact is 1, all in m^2. With a tenth of it, roots
follow errors of the scene: on clips with motion capture the root's path became up to 12 mm worse by this stage
(`benchmarks/real_clips.py`); with this value it changes by less than 3 mm."""
PENETRATION = 5.0
"""Weight of the mean squared depth of penetrating vertices. With 2 the deepest penetration on `ocv_walk` is 91 mm
instead of 77, with the root's path 1.5 mm better."""
CHANGE = 0.1
"""Weight of the squared difference of consecutive displacements; the paper's smoothness, taken on the displacement so
that walking is not slowed. Without it a root that is drawn to the floor may jump by 12 mm from frame to frame."""
HUBER_M = 0.05
"""Contact distances above this count linearly. Not measured."""


@dataclass(frozen=True, slots=True, eq=False)
class ContactPart:
    """Skin of one part of the body, at the keyframes where it touches."""

    joints: tuple[int, ...]
    keyframe: Int[np.ndarray, "touches"]
    """Rows of `RootProblem.frame`."""
    skin_m: Float[np.ndarray, "touches vertices 3"]
    probability: Float[np.ndarray, "touches"]


@dataclass(frozen=True, slots=True, eq=False)
class RootProblem:
    """One person's keyframes, world frame."""

    frame: Int[np.ndarray, "keyframes"]
    direction: Float[np.ndarray, "keyframes 3"]
    """Unit vectors from the camera to the keyframes' roots."""
    skin_m: Float[np.ndarray, "points 3"]
    """Vertices of the penetration loss, of keyframes and of the frames between them."""
    skin_frame: Int[np.ndarray, "points"]
    """Frame of each of them."""
    contacts: tuple[ContactPart, ...]
    scene: SdfGrid


@one_thread()
def solve_along(problem: RootProblem) -> Float[np.ndarray, "keyframes"]:
    """Displacements along the lines of sight (meters) that minimize the weighted losses: L-BFGS from zero."""
    losses = _Losses(problem)

    def cost(values_m: Float[np.ndarray, "keyframes"]) -> tuple[float, Float[np.ndarray, "keyframes"]]:
        along_m = _tensor(values_m[:, None]).requires_grad_()
        total = losses(along_m)
        (slope,) = torch.autograd.grad(total, along_m)
        return total.item(), slope.numpy()[:, 0].astype(np.float64)

    return np.asarray(minimize(cost, np.zeros(len(problem.frame)), jac=True, method="L-BFGS-B").x)


def contact_distance_m(skin_m: Float[np.ndarray, "touches vertices 3"], scene: SdfGrid) -> Float[np.ndarray, "touches"]:
    """Signed distance of a touching part to the scene: mean over its deepest vertices."""
    return np.sort(scene.sample(skin_m), axis=1)[:, :TOUCHING_POINTS].mean(axis=1)


class _Losses:
    """Weighted sum of the four losses as a function of the displacements along the lines of sight (K, 1)."""

    def __init__(self, problem: RootProblem) -> None:
        self.problem = problem
        self.direction = _tensor(problem.direction)
        self.skin_m = _tensor(problem.skin_m)
        frames, rows = np.unique(problem.skin_frame, return_inverse=True)
        self.frames, self.skin_row = max(len(frames), 1), torch.as_tensor(rows)
        self.skin_place = _between(problem.frame, problem.skin_frame)
        steps = np.diff(problem.frame).astype(np.float64)
        self.step = _tensor(steps / np.median(steps) if len(steps) else steps)
        self.contacts = [
            (torch.as_tensor(part.keyframe), _tensor(part.skin_m), _tensor(part.probability))
            for part in problem.contacts
        ]

    def __call__(self, along_m: torch.Tensor) -> torch.Tensor:
        displacement_m = along_m * self.direction
        total = REGULARIZATION * (along_m**2).mean() + PENETRATION * self._penetration(displacement_m)
        if self.contacts:
            total = total + self._contact(displacement_m)
        if len(displacement_m) > 1:
            total = total + CHANGE * ((displacement_m.diff(dim=0) / self.step[:, None]) ** 2).sum(-1).mean()
        return total

    def _penetration(self, displacement_m: torch.Tensor) -> torch.Tensor:
        """Mean over frames of the mean squared depth of the vertices that are inside."""
        inside_m = torch.relu(-self.problem.scene.sample(self.skin_m + _at(displacement_m, self.skin_place)))
        square, count = torch.zeros(self.frames), torch.zeros(self.frames)
        square = square.index_add(0, self.skin_row, inside_m**2)
        count = count.index_add(0, self.skin_row, (inside_m > 0).float())
        return (square / count.clamp(min=1)).mean()

    def _contact(self, displacement_m: torch.Tensor) -> torch.Tensor:
        """Mean over all contacts, weighted by probability, of the Huber cost of the part's distance."""
        costs, weights = [], []
        for keyframe, skin_m, probability in self.contacts:
            distance_m = self.problem.scene.sample(skin_m + displacement_m[keyframe][:, None])
            count = min(TOUCHING_POINTS, distance_m.shape[1])
            nearest_m = distance_m.topk(count, dim=1, largest=False).values.mean(dim=1)
            costs.append(probability * huber_of_square(nearest_m**2, HUBER_M))
            weights.append(probability)
        return torch.cat(costs).sum() / torch.cat(weights).sum()


_Place = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Rows of the keyframes before and after each frame (N,) (N,), and its position between them (N, 1) from 0 to 1."""


def _at(move_m: torch.Tensor, place: _Place) -> torch.Tensor:
    """Displacement (N, D) at frames between keyframes, linear in time."""
    left, right, weight = place
    before, after = move_m.index_select(0, left), move_m.index_select(0, right)
    return before + weight * (after - before)


def _between(keyframes: Int[np.ndarray, "keyframes"], frames: Int[np.ndarray, "points"]) -> _Place:
    right = np.clip(np.searchsorted(keyframes, frames), 0, len(keyframes) - 1)
    left = np.maximum(right - 1, 0)
    span = np.maximum(keyframes[right] - keyframes[left], 1)
    place = np.clip((frames - keyframes[left]) / span, 0.0, 1.0)
    return torch.as_tensor(left), torch.as_tensor(right), _tensor(place[:, None])


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.asarray(array), dtype=torch.float32)
