"""Camera poses and inverse depths from tracked points (bundle adjustment; Triggs et al. 2000).

Each point has an anchor, the first keyframe that observes it, and one unknown: its inverse depth rho there (Civera et
al. 2008). In another camera k it projects along

    R_k^T (R_a ray + rho (c_a - c_k)),

which holds for a camera that only turns (c_a = c_k) and for points at infinity (rho = 0) alike, so no case needs a
model of its own. A prior rho ~ N(1, 1) fixes the unit of length, which images leave open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix

from video2anim.geometry.rotations import matrix_from_axis_angle

_RHO_SIGMA = 1.0
"""Spread of inverse depths over their mean: half of the points are between 0.6 and infinity times the usual depth."""
_TOLERANCE = 1e-4
"""Relative change of the cost at which the iteration ends."""
_SCALES = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 1.0)
"""Scales of Cauchy's cost in the steps of `locate`, in standard deviations: keyframes are up to 30 apart."""
_NEAREST = 0.05
"""Least depth of a projected point, in units of its ray; behind the camera it has no projection."""


@dataclass(slots=True, eq=False)
class Poses:
    """Cameras in the axes of the first one; the unit of length is that of inverse depths."""

    R: Float[np.ndarray, "cameras 3 3"]
    center: Float[np.ndarray, "cameras 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Points in cameras other than their anchors. Rays have unit depth; errors are in units of `sigma`."""

    camera: Int[np.ndarray, "observations"]
    point: Int[np.ndarray, "observations"]
    seen: Float[np.ndarray, "observations 2"]
    """x / z and y / z."""
    anchor: Int[np.ndarray, "points"]
    ray: Float[np.ndarray, "points 3"]
    """In the anchor, with z = 1."""
    sigma: float
    """Standard deviation of `seen`, beyond which Cauchy's cost takes over."""

    def among(self, cameras: int) -> Observations:
        """Those of the first cameras."""
        own = self.camera < cameras
        return Observations(self.camera[own], self.point[own], self.seen[own], self.anchor, self.ray, self.sigma)


def errors(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "observations 2"]:
    """Projection minus observation, in standard deviations."""
    x = _in_camera(poses, rho, seen)[0]
    return (x[:, :2] / np.maximum(x[:, 2:], _NEAREST) - seen.seen) / seen.sigma


def _in_camera(poses: Poses, rho: np.ndarray, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions in the observing camera, and in the first camera's axes: of the ray alone and of both terms."""
    anchor = seen.anchor[seen.point]
    ray = np.einsum("nab,nb->na", poses.R[anchor], seen.ray[seen.point])
    whole = ray + rho[seen.point, None] * (poses.center[anchor] - poses.center[seen.camera])
    return np.einsum("nab,na->nb", poses.R[seen.camera], whole), ray, whole


def known_points(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "points 3"]:
    """Homogeneous coordinates of the points in the first camera's axes; inverse depths are the fourth. A point whose
    anchor is no camera yet is NaN."""
    known = seen.anchor < len(poses.R)
    found = np.full(seen.ray.shape, np.nan)
    anchor = seen.anchor[known]
    found[known] = np.einsum("nab,nb->na", poses.R[anchor], seen.ray[known]) + rho[known, None] * poses.center[anchor]
    return found


def locate(
    point: Float[np.ndarray, "points 3"],
    rho: Float[np.ndarray, "points"],
    seen: Float[np.ndarray, "points 2"],
    sigma: float,
    start: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], Float[np.ndarray, "points"]]:
    """Rotation and center of one camera that observes known points, and the error of each in standard deviations.

    Cauchy's scale shrinks from step to step, so a start far off does not lose the points.
    """
    R, center = start
    for scale in _SCALES:
        whole = point - rho[:, None] * center
        x = whole @ R
        z = np.maximum(x[:, 2], _NEAREST)
        to_pixel = _to_pixel(x, z) / sigma
        D = to_pixel @ R.T
        J = np.concatenate([D @ _cross(whole), -D * rho[:, None, None]], 2)
        error = (x[:, :2] / z[:, None] - seen) / sigma
        weight = 1 / (1 + (error**2).sum(1) / scale**2)
        A = np.einsum("n,nki,nkj->ij", weight, J, J)
        step = np.linalg.solve(
            A + 1e-6 * np.diag(A.diagonal()) + 1e-9 * np.eye(6), -np.einsum("n,nki,nk->i", weight, J, error)
        )
        R, center = np.asarray(matrix_from_axis_angle(step[:3])) @ R, center + step[3:]
    x = (point - rho[:, None] * center) @ R
    return R, center, np.linalg.norm((x[:, :2] / np.maximum(x[:, 2:], _NEAREST) - seen) / sigma, axis=1)


def _to_pixel(x: np.ndarray, z: np.ndarray) -> Float[np.ndarray, "n 2 3"]:
    """Derivative of x / z and y / z by the direction."""
    D = np.zeros((len(z), 2, 3))
    D[:, 0, 0] = D[:, 1, 1] = 1 / z
    D[:, :, 2] = -x[:, :2] / z[:, None] ** 2
    return D


def adjust(
    poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations, *, scale: float = 1.0, steps: int = 30
) -> tuple[Poses, Float[np.ndarray, "points"]]:
    """The least-squares fit from a start, by Levenberg and Marquardt's iteration; the first camera is fixed.

    Cauchy's cost, of the given scale, leaves points that move by themselves without weight. Inverse depths are
    eliminated from every step (Schur complement). If all are 0 they stay so, and with them the centers: the camera
    only turns.
    """
    damping, cost = 1e-3, cost_of(poses, rho, seen, scale)
    for _ in range(steps):
        normal = _Normal(poses, rho, seen, scale)
        while damping < 1e6:
            next_poses, next_rho = normal.step(damping)
            next_cost = cost_of(next_poses, next_rho, seen, scale)
            if next_cost < cost:
                break
            damping *= 8
        else:
            break
        done = cost - next_cost < _TOLERANCE * cost
        poses, rho, cost, damping = next_poses, next_rho, next_cost, max(damping / 5, 1e-7)
        if done:
            break
    return poses, rho


def cost_of(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations, scale: float = 1.0) -> float:
    """Cauchy's cost of all errors, and the prior of the inverse depths."""
    squared = (errors(poses, rho, seen) ** 2).sum(1)
    return float(scale**2 * np.log1p(squared / scale**2).sum() + rho.any() * (((rho - 1) / _RHO_SIGMA) ** 2).sum())


def rho_sigmas(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "points"]:
    """Standard deviations of the inverse depths for known poses."""
    return _Normal(poses, rho, seen, 1.0).rho_information ** -0.5


class _Normal:
    """Normal equations at one state. Unknowns: six per camera (rotation vector, center), then inverse depths."""

    def __init__(self, poses: Poses, rho: np.ndarray, seen: Observations, scale: float) -> None:
        self._poses, self._rho = poses, rho
        x, ray, whole = _in_camera(poses, rho, seen)
        z = np.maximum(x[:, 2], _NEAREST)
        D = _to_pixel(x, z) @ np.swapaxes(poses.R[seen.camera], 1, 2) / seen.sigma
        anchor, own_rho = seen.anchor[seen.point], rho[seen.point, None, None]
        blocks = [D @ _cross(whole), -D * own_rho, -D @ _cross(ray), D * own_rho]
        by_rho = D @ (poses.center[anchor] - poses.center[seen.camera])[..., None]
        error = (x[:, :2] / z[:, None] - seen.seen) / seen.sigma
        weight = 1 / (1 + (error**2).sum(1) / scale**2)
        cameras, n = len(poses.R), len(z)
        columns = np.concatenate(
            [6 * seen.camera[:, None] + np.arange(6), 6 * anchor[:, None] + np.arange(6),
             6 * cameras + seen.point[:, None]], 1,
        )  # fmt: skip
        values = np.concatenate([*blocks, by_rho], 2) * np.sqrt(weight)[:, None, None]
        rows = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), values.shape)
        columns = np.broadcast_to(columns[:, None], values.shape)
        size = 6 * cameras + len(rho)
        J = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (2 * n, size)).tocsr()
        H, g = (J.T @ J).tocsr(), J.T @ (error * np.sqrt(weight)[:, None]).ravel()
        split = 6 * cameras
        self._camera, self._mixed = H[6:split, 6:split].toarray(), H[6:split, split:]
        self.rho_information = H.diagonal()[split:] + 1 / _RHO_SIGMA**2
        self._g_camera, self._g_rho = g[6:split], g[split:] + (rho - 1) / _RHO_SIGMA**2

    def step(self, damping: float) -> tuple[Poses, np.ndarray]:
        own = self.rho_information * (1 + damping) if self._rho.any() else np.inf
        A = self._camera + np.diag(damping * self._camera.diagonal() + 1e-9)
        scaled = self._mixed.multiply(1 / own).tocsr()
        A -= (scaled @ self._mixed.T).toarray()
        d_camera = np.linalg.solve(A, scaled @ self._g_rho - self._g_camera)
        d_rho = -(self._g_rho + self._mixed.T @ d_camera) / own
        turn, shift = np.split(np.r_[np.zeros((1, 6)), d_camera.reshape(-1, 6)], 2, axis=1)
        R = np.asarray(matrix_from_axis_angle(turn)) @ self._poses.R
        return Poses(R, self._poses.center + shift), self._rho + d_rho


def _cross(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Matrices of the cross product with each vector."""
    M = np.zeros((len(v), 3, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return M - np.swapaxes(M, 1, 2)
