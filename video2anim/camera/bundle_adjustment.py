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
    log_focal: float = 0.0
    """Logarithm of the focal length of all over the one that the observations assume."""

    @property
    def to_ray(self) -> Float[np.ndarray, "3"]:
        """What observed rays of unit depth are multiplied by."""
        return np.exp([-self.log_focal, -self.log_focal, 0.0])


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
    return _errors(_in_camera(poses, rho, seen)[0], poses, seen)


def _errors(x: np.ndarray, poses: Poses, seen: Observations) -> Float[np.ndarray, "observations 2"]:
    return (np.exp(poses.log_focal) * x[:, :2] / np.maximum(x[:, 2:], _NEAREST) - seen.seen) / seen.sigma


def _in_camera(poses: Poses, rho: np.ndarray, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions in the observing camera, and in the first camera's axes: of the ray alone and of both terms."""
    anchor = seen.anchor[seen.point]
    ray = np.einsum("nab,nb->na", poses.R[anchor], seen.ray[seen.point] * poses.to_ray)
    whole = ray + rho[seen.point, None] * (poses.center[anchor] - poses.center[seen.camera])
    return np.einsum("nab,na->nb", poses.R[seen.camera], whole), ray, whole


def known_points(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "points 3"]:
    """Homogeneous coordinates of the points in the first camera's axes; inverse depths are the fourth. A point whose
    anchor is no camera yet is NaN."""
    known = seen.anchor < len(poses.R)
    found = np.full(seen.ray.shape, np.nan)
    anchor = seen.anchor[known]
    found[known] = (
        np.einsum("nab,nb->na", poses.R[anchor], seen.ray[known] * poses.to_ray)
        + rho[known, None] * poses.center[anchor]
    )
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
    poses: Poses,
    rho: Float[np.ndarray, "points"],
    seen: Observations,
    *,
    scale: float = 1.0,
    steps: int = 30,
    focal_sigma: float = 0.0,
) -> tuple[Poses, Float[np.ndarray, "points"]]:
    """The least-squares fit from a start, by Levenberg and Marquardt's iteration; the first camera is fixed.

    Cauchy's cost, of the given scale, leaves points that move by themselves without weight. Inverse depths are
    eliminated from every step (Schur complement). If all are 0 they stay so, and with them the centers: the camera
    only turns. The focal length is an unknown if `focal_sigma` is above 0, the standard deviation of its logarithm
    before the fit.
    """
    damping, cost = 1e-3, cost_of(poses, rho, seen, scale, focal_sigma)
    for _ in range(steps):
        normal = _Normal(poses, rho, seen, scale, focal_sigma)
        while damping < 1e6:
            next_poses, next_rho = normal.step(damping)
            next_cost = cost_of(next_poses, next_rho, seen, scale, focal_sigma)
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


def cost_of(
    poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations, scale: float = 1.0, focal_sigma: float = 0.0
) -> float:
    """Cauchy's cost of all errors, and the priors of the inverse depths and of the focal length."""
    squared = (errors(poses, rho, seen) ** 2).sum(1)
    cost = scale**2 * np.log1p(squared / scale**2).sum() + rho.any() * (((rho - 1) / _RHO_SIGMA) ** 2).sum()
    return float(cost + ((poses.log_focal / focal_sigma) ** 2 if focal_sigma else 0.0))


def rho_sigmas(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "points"]:
    """Standard deviations of the inverse depths for known poses."""
    return _Normal(poses, rho, seen, 1.0, 0.0).rho_information ** -0.5


def focal_sigma_after(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations, before: float) -> float:
    """Standard deviation of the logarithm of the focal length, of which `before` is the one before the fit."""
    return _Normal(poses, rho, seen, 1.0, before).focal_sigma()


class _Normal:
    """Normal equations at one state. Unknowns: six per camera (rotation vector, center), the logarithm of the focal
    length, then inverse depths."""

    def __init__(self, poses: Poses, rho: np.ndarray, seen: Observations, scale: float, focal_sigma: float) -> None:
        self._poses, self._rho = poses, rho
        x, ray, whole = _in_camera(poses, rho, seen)
        z = np.maximum(x[:, 2], _NEAREST)
        D = _to_pixel(x, z) @ np.swapaxes(poses.R[seen.camera], 1, 2) * (np.exp(poses.log_focal) / seen.sigma)
        anchor, own_rho = seen.anchor[seen.point], rho[seen.point, None, None]
        by_rho = D @ (poses.center[anchor] - poses.center[seen.camera])[..., None]
        error = _errors(x, poses, seen)
        # A longer lens spreads the projection, and brings the ray of the anchor nearer to its axis.
        sideways = ray - poses.R[anchor, :, 2]
        by_focal = (error + seen.seen / seen.sigma - np.einsum("nka,na->nk", D, sideways)) * (focal_sigma > 0)
        blocks = [D @ _cross(whole), -D * own_rho, -D @ _cross(ray), D * own_rho, by_focal[..., None], by_rho]
        weight = 1 / (1 + (error**2).sum(1) / scale**2)
        cameras, n = len(poses.R), len(z)
        columns = np.concatenate(
            [6 * seen.camera[:, None] + np.arange(6), 6 * anchor[:, None] + np.arange(6),
             np.full((n, 1), 6 * cameras), 6 * cameras + 1 + seen.point[:, None]], 1,
        )  # fmt: skip
        values = np.concatenate(blocks, 2) * np.sqrt(weight)[:, None, None]
        rows = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), values.shape)
        columns = np.broadcast_to(columns[:, None], values.shape)
        split = 6 * cameras + 1
        J = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (2 * n, split + len(rho))).tocsr()
        H, g = (J.T @ J).tocsr(), J.T @ (error * np.sqrt(weight)[:, None]).ravel()
        self._camera, self._mixed = H[6:split, 6:split].toarray(), H[6:split, split:]
        self._g_camera = g[6:split]
        # Without a prior the focal length has no column, and any number keeps it where it is.
        self._camera[-1, -1] += focal_sigma**-2 if focal_sigma else 1.0
        self._g_camera[-1] += poses.log_focal / focal_sigma**2 if focal_sigma else 0.0
        self.rho_information = H.diagonal()[split:] + 1 / _RHO_SIGMA**2
        self._g_rho = g[split:] + (rho - 1) / _RHO_SIGMA**2

    def _reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
        """Normal equations of cameras and focal length alone, the inverse depths' part of them and their weights."""
        own = self.rho_information * (1 + damping) if self._rho.any() else np.inf
        A = self._camera + np.diag(damping * self._camera.diagonal() + 1e-9)
        scaled = self._mixed.multiply(1 / own).tocsr()
        return A - (scaled @ self._mixed.T).toarray(), scaled @ self._g_rho - self._g_camera, own

    def step(self, damping: float) -> tuple[Poses, np.ndarray]:
        A, b, own = self._reduced(damping)
        change = np.linalg.solve(A, b)
        d_rho = -(self._g_rho + self._mixed.T @ change) / own
        turn, shift = np.split(np.r_[np.zeros((1, 6)), change[:-1].reshape(-1, 6)], 2, axis=1)
        R = np.asarray(matrix_from_axis_angle(turn)) @ self._poses.R
        log_focal = self._poses.log_focal + float(change[-1])
        return Poses(R, self._poses.center + shift, log_focal), self._rho + d_rho

    def focal_sigma(self) -> float:
        return float(np.linalg.inv(self._reduced(0.0)[0])[-1, -1] ** 0.5)


def _cross(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Matrices of the cross product with each vector."""
    M = np.zeros((len(v), 3, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return M - np.swapaxes(M, 1, 2)
