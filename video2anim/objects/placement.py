"""Pose and scale of an upright object by Chamfer distance to its depth points (SceneMI, supplement section 8.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from video2anim.geometry.chamfer import ChamferConfig, ChamferLoss, chamfer_m
from video2anim.geometry.line_of_sight import visible_vertices
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.types.camera import View

_MAX_FACTOR = 2.5
"""Maximum factor between the scale and its first guess."""
_PATCH_POINTS = 12
"""Neighboring depth points have common errors: so many count as one."""
_MIN_ERROR_M = 0.01
_ROUNDS = 3
"""Updates of the visible points during a descent."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """x_world = T_world_object @ (scale * x_object)."""

    T_world_object: Float[np.ndarray, "4 4"]
    scale: float
    chamfer_before_m: float
    chamfer_after_m: float
    position_sigma_m: float = float("nan")
    """Standard deviation of the horizontal place, by how sharply the points fix it."""
    yaw_sigma_rad: float = float("nan")
    scale_sigma: float = float("nan")


@dataclass(frozen=True, slots=True)
class _State:
    x_m: float
    z_m: float
    yaw_rad: float
    scale: float
    base_m: float
    """Height that it rests on."""
    loss: float = np.inf

    def transform(self) -> np.ndarray:
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, 0, s, self.x_m], [0, 1, 0, self.base_m], [-s, 0, c, self.z_m], [0, 0, 0, 1.0]])


class _Problem:
    """One object: its mesh, its depth points, and the camera that sees both."""

    def __init__(
        self,
        vertices_m: np.ndarray,
        faces: np.ndarray,
        points_world_m: np.ndarray,
        view: View,
        rng: np.random.Generator,
        max_points: int,
    ) -> None:
        self.vertices_m, self.faces, self.intrinsics = vertices_m, faces, view.intrinsics
        self.T_camera_world = invert_rigid(view.T_world_camera)
        self.points_m = points_world_m[rng.permutation(len(points_world_m))[:max_points]]
        self.max_points, self.rng = max_points, rng

    def visible(self, state: _State) -> Float[np.ndarray, "visible 3"]:
        """Object-frame vertices that the camera sees in this pose; all of them if it sees none."""
        world_m = transform_points(state.transform(), self.vertices_m * state.scale)
        seen = visible_vertices(transform_points(self.T_camera_world, world_m), self.faces, self.intrinsics)
        chosen = np.flatnonzero(seen) if seen.sum() >= 3 else np.arange(len(seen))
        return self.vertices_m[self.rng.permutation(chosen)[: self.max_points]]

    def chamfer_m(self, state: _State) -> float:
        world_m = transform_points(state.transform(), self.visible(state) * state.scale)
        return chamfer_m(world_m, self.points_m, trim_ratio=0.05)

    def sigma(self, state: _State) -> tuple[float, float, float]:
        """Standard deviations of place, yaw and scale: Gauss-Newton of each depth point to its nearest mesh point."""
        own_m = self.visible(state) * state.scale
        world_m = transform_points(state.transform(), own_m)
        gap_m, nearest = (np.asarray(found) for found in KDTree(world_m).query(self.points_m))
        kept = gap_m <= max(np.quantile(gap_m, 0.95), 1e-9)
        normal = world_m[nearest[kept]] - self.points_m[kept]
        error_m = max(1.48 * float(np.median(gap_m[kept])), _MIN_ERROR_M)
        # Where a point lies on the surface already its direction is unknown: it fixes all of them a little.
        unit = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        arm = world_m[nearest[kept]] - state.transform()[:3, 3]
        moved = np.stack([
            np.tile([1.0, 0, 0], (len(arm), 1)), np.tile([0, 0, 1.0], (len(arm), 1)),
            np.stack([arm[:, 2], np.zeros(len(arm)), -arm[:, 0]], -1), arm,
        ], 1)  # fmt: skip
        slope = np.einsum("nkd,nd->nk", moved, unit)
        information = slope.T @ slope / (error_m**2 * _PATCH_POINTS)
        covariance = np.linalg.pinv(information + 1e-6 * np.eye(4))
        x, z, yaw, scale = np.sqrt(np.maximum(np.diag(covariance), 0))
        return float(np.hypot(x, z)), float(yaw), float(state.scale * scale)

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
            cost = loss(torch.stack([x, scale * visible[:, 1] + state.base_m, z], -1))
            cost.backward()
            reached = float(cost.detach())
            optimizer.step()
        x_m, z_m, yaw_rad, log_scale = values.detach().tolist()
        limit = np.log(_MAX_FACTOR)
        log_scale = float(np.clip(log_scale, np.log(start.scale) - limit, np.log(start.scale) + limit))
        return _State(x_m, z_m, yaw_rad, float(np.exp(log_scale)), state.base_m, reached)


def place(
    vertices_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    T_world_object: Float[np.ndarray, "4 4"],
    points_world_m: Float[np.ndarray, "points 3"],
    view: View,
    *,
    yaw_starts_rad: tuple[float, ...],
    rng: np.random.Generator,
    max_points: int = 300,
    keep_ratio: float = 0.9,
) -> Placement:
    """Horizontal position, yaw and scale of minimum robust Chamfer distance, from several yaws.

    The yaw of the first guess is preferred: another start must reach `keep_ratio` of its loss, since many objects are
    similar from several sides.

    Raises:
        ValueError: there are no points or no vertices.
    """
    if not len(points_world_m) or not len(vertices_m):
        raise ValueError(f"place: want points and vertices, got {len(points_world_m)} and {len(vertices_m)}")
    problem = _Problem(vertices_m, faces, points_world_m, view, rng, max_points)
    yaw = float(np.arctan2(T_world_object[0, 2], T_world_object[2, 2]))
    x_m, base_m, z_m = (float(v) for v in T_world_object[:3, 3])
    first = _State(x_m, z_m, yaw, 1.0, base_m)
    before_m = problem.chamfer_m(first)
    config = ChamferConfig(huber_m=0.1, trim_ratio=0.05)
    best = problem.descend(first, config)
    for turn in yaw_starts_rad:
        other = problem.descend(_State(x_m, z_m, yaw + turn, 1.0, base_m), config)
        if other.loss < keep_ratio * best.loss:
            best = other
    after_m = problem.chamfer_m(best)
    if after_m > before_m:
        best, after_m = first, before_m
    return Placement(best.transform(), best.scale, before_m, after_m, *problem.sigma(best))
