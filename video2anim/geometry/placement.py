"""Pose and scale of an object by Chamfer distance to its depth points (paper 8.1): upright, resting on the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from video2anim.geometry.chamfer import ChamferConfig, ChamferLoss, chamfer_m
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.geometry.visible import visible_vertices
from video2anim.types.camera import Intrinsics

_LARGEST_FACTOR = 2.5
"""Scales are kept within this factor of the first guess."""
_ROUNDS = 3
"""Times that visibility is found again in a descent."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """x_world = T_world_object @ (scale * x_object)."""

    T_world_object: Float[np.ndarray, "4 4"]
    scale: float
    chamfer_before_m: float
    chamfer_after_m: float


@dataclass(frozen=True, slots=True)
class _State:
    x_m: float
    z_m: float
    yaw_rad: float
    scale: float
    loss: float = np.inf

    def transform(self) -> np.ndarray:
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, 0, s, self.x_m], [0, 1, 0, 0], [-s, 0, c, self.z_m], [0, 0, 0, 1.0]])


class _Problem:
    """One object: its mesh, its depth points, and the camera that sees both."""

    def __init__(
        self,
        vertices_m: np.ndarray,
        faces: np.ndarray,
        points_world_m: np.ndarray,
        T_world_camera: np.ndarray,
        intrinsics: Intrinsics,
        rng: np.random.Generator,
        most_points: int,
    ) -> None:
        self.vertices_m, self.faces, self.intrinsics = vertices_m, faces, intrinsics
        self.T_camera_world = invert_rigid(T_world_camera)
        self.points_m = points_world_m[rng.permutation(len(points_world_m))[:most_points]]
        self.most_points, self.rng = most_points, rng

    def visible(self, state: _State) -> Float[np.ndarray, "visible 3"]:
        """Object-frame vertices that the camera sees in this pose; all of them if it sees none."""
        world_m = transform_points(state.transform(), self.vertices_m * state.scale)
        seen = visible_vertices(transform_points(self.T_camera_world, world_m), self.faces, self.intrinsics)
        chosen = np.flatnonzero(seen) if seen.sum() >= 3 else np.arange(len(seen))
        return self.vertices_m[self.rng.permutation(chosen)[: self.most_points]]

    def chamfer_m(self, state: _State) -> float:
        world_m = transform_points(state.transform(), self.visible(state) * state.scale)
        return chamfer_m(world_m, self.points_m, trim_ratio=0.05)

    def descend(self, start: _State, config: ChamferConfig) -> _State:
        state = start
        for _ in range(_ROUNDS):
            state = self._descend_once(state, start, config)
        return state

    def _descend_once(self, state: _State, start: _State, config: ChamferConfig) -> _State:
        visible = torch.as_tensor(self.visible(state), dtype=torch.float64)
        loss = ChamferLoss(self.points_m, config)
        values = torch.tensor([state.x_m, state.z_m, state.yaw_rad, np.log(state.scale)], dtype=torch.float64)
        values.requires_grad_(True)
        optimizer = torch.optim.Adam([values], lr=0.03)
        reached = np.inf
        for step in range(25):
            optimizer.param_groups[0]["lr"] = 0.03 * (1 - step / 30)
            optimizer.zero_grad()
            c, s, scale = torch.cos(values[2]), torch.sin(values[2]), torch.exp(values[3])
            x = scale * (c * visible[:, 0] + s * visible[:, 2]) + values[0]
            z = scale * (c * visible[:, 2] - s * visible[:, 0]) + values[1]
            cost = loss(torch.stack([x, scale * visible[:, 1], z], -1))
            cost.backward()
            reached = float(cost.detach())
            optimizer.step()
        x_m, z_m, yaw_rad, log_scale = values.detach().tolist()
        limit = np.log(_LARGEST_FACTOR)
        log_scale = float(np.clip(log_scale, np.log(start.scale) - limit, np.log(start.scale) + limit))
        return _State(x_m, z_m, yaw_rad, float(np.exp(log_scale)), reached)


def place(
    vertices_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    T_world_object: Float[np.ndarray, "4 4"],
    points_world_m: Float[np.ndarray, "points 3"],
    T_world_camera: Float[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
    *,
    yaw_starts_rad: tuple[float, ...],
    rng: np.random.Generator,
    most_points: int = 300,
    keep_ratio: float = 0.9,
) -> Placement:
    """Horizontal position, yaw and scale of least robust Chamfer distance, from several yaws.

    The first guess's own yaw is preferred: another start must reach `keep_ratio` of its loss, since many objects look
    alike from several sides.

    Raises:
        ValueError: there are no points or no vertices.
    """
    if not len(points_world_m) or not len(vertices_m):
        raise ValueError(f"place: want points and vertices, got {len(points_world_m)} and {len(vertices_m)}")
    problem = _Problem(vertices_m, faces, points_world_m, T_world_camera, intrinsics, rng, most_points)
    yaw = float(np.arctan2(T_world_object[0, 2], T_world_object[2, 2]))
    first = _State(float(T_world_object[0, 3]), float(T_world_object[2, 3]), yaw, 1.0)
    before_m = problem.chamfer_m(first)
    config = ChamferConfig(huber_m=0.1, trim_ratio=0.05)
    best = problem.descend(first, config)
    for turn in yaw_starts_rad:
        other = problem.descend(_State(first.x_m, first.z_m, yaw + turn, 1.0), config)
        if other.loss < keep_ratio * best.loss:
            best = other
    after_m = problem.chamfer_m(best)
    if after_m > before_m:
        best, after_m = first, before_m
    return Placement(best.transform(), best.scale, before_m, after_m)
