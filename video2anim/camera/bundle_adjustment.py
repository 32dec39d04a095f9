"""Camera poses, inverse depths and focal length from tracked points (bundle adjustment; Triggs et al. 2000).

Each point has an anchor, the first keyframe that observes it, and one unknown: the logarithm of its inverse depth rho
there (Civera et al. 2008). In another camera k it projects along

    R_k^T (R_a ray + rho (c_a - c_k)),

which holds for a camera that only turns (rho = 0) too. With -rho and -c the same image shows points behind the cameras;
the logarithm leaves these out. Its prior fixes the unit of length, which images leave open, and decides between the two
reliefs that a short path cannot tell apart, of which one is the other turned inside out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix

from video2anim.geometry.rotations import matrix_from_axis_angle

_LOG_SIGMA = 1.5
"""Spread of the logarithms of inverse depths beside what is expected: three times that of scenes, so that it decides
only where the images do not. Of a camera that pans by 50 degrees (`00_pan_walk` of `moving_cameras.py`) a spread of 1
makes the last rotation 0.98 degrees wrong, 1.5 0.87, 2 0.67 to 0.74 (a script that is not kept)."""
_FOCAL_SIGMA = 0.5
"""Of the logarithm of an unknown focal length, for the sake of the solver: where nothing tells it, it stays."""
_DISTORTION_SIGMA = 0.05
"""Expected first radial coefficient of a lens. It is not fitted: over small turns it looks like another focal length,
and errors that the points of a track have in common make it negative."""
_MAX_LOG_STEP = 2.0
"""Of a logarithm of inverse depth in one iteration."""
_TOLERANCE, _MAX_STEPS = 1e-4, 100
"""Relative change of the cost at which the iteration ends, and most steps."""
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

    def rays(self, seen: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """x / z and y / z of observations through this lens."""
        return seen * np.exp(-self.log_focal)


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
    expected: Float[np.ndarray, "points"]
    """Logarithms of inverse depths before any motion is seen."""
    sigma: float
    """Standard deviation of `seen`, beyond which Cauchy's cost takes over."""

    def among(self, cameras: int) -> Observations:
        """Those of the first cameras."""
        own = self.camera < cameras
        return replace(self, camera=self.camera[own], point=self.point[own], seen=self.seen[own])


def errors(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "observations 2"]:
    """Projection minus observation, in standard deviations."""
    return _errors(_in_camera(poses, rho, seen)[0], poses, seen)


def _errors(x: np.ndarray, poses: Poses, seen: Observations) -> Float[np.ndarray, "observations 2"]:
    off = x[:, :2] / np.maximum(x[:, 2:], _NEAREST) - poses.rays(seen.seen)
    return off * (np.exp(poses.log_focal) / seen.sigma)


def _rays(poses: Poses, seen: Observations) -> Float[np.ndarray, "points 3"]:
    """Of the points in their anchors, with z = 1."""
    return np.c_[poses.rays(seen.ray[:, :2]), seen.ray[:, 2]]


def _in_camera(poses: Poses, rho: np.ndarray, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions in the observing camera, and in the first camera's axes: of the ray alone and of both terms."""
    anchor = seen.anchor[seen.point]
    ray = np.einsum("nab,nb->na", poses.R[anchor], _rays(poses, seen)[seen.point])
    whole = ray + rho[seen.point, None] * (poses.center[anchor] - poses.center[seen.camera])
    return np.einsum("nab,na->nb", poses.R[seen.camera], whole), ray, whole


def known_points(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "points 3"]:
    """Homogeneous coordinates of the points in the first camera's axes; inverse depths are the fourth. A point whose
    anchor is no camera yet is NaN."""
    known = seen.anchor < len(poses.R)
    found = np.full(seen.ray.shape, np.nan)
    anchor = seen.anchor[known]
    found[known] = (
        np.einsum("nab,nb->na", poses.R[anchor], _rays(poses, seen)[known]) + rho[known, None] * poses.center[anchor]
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
    poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations, *, free_focal: bool = False
) -> tuple[Poses, Float[np.ndarray, "points"]]:
    """The least-squares fit from a start, by Levenberg and Marquardt's iteration; the first camera is fixed.

    Cauchy's cost leaves points that move by themselves without weight. Inverse depths are eliminated from every step
    (Schur complement). Those of 0 stay so, and if all are 0 the centers too: the camera only turns. The focal length is
    fixed unless `free_focal`.
    """
    damping, cost = 1e-3, cost_of(poses, rho, seen)
    for _ in range(_MAX_STEPS):
        normal = _Normal(poses, rho, seen)
        while damping < 1e6:
            next_poses, next_rho = normal.step(damping, free_focal)
            next_cost = cost_of(next_poses, next_rho, seen)
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


def cost_of(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> float:
    """Cauchy's cost of all errors, and the priors of inverse depths and focal length."""
    squared = (errors(poses, rho, seen) ** 2).sum(1)
    cost = np.log1p(squared).sum() + (_off_prior(rho, seen) ** 2).sum()
    return float(cost + (poses.log_focal / _FOCAL_SIGMA) ** 2)


def _off_prior(rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "points"]:
    """Logarithms of inverse depths beside what is expected, in standard deviations; 0 for points at infinity, which
    stay there."""
    return np.where(rho > 0, np.log(np.where(rho > 0, rho, 1.0)) - seen.expected, 0.0) / _LOG_SIGMA


def log_sigmas(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> Float[np.ndarray, "points"]:
    """Standard deviations of the logarithms of the inverse depths for known poses."""
    return _Normal(poses, rho, seen).log_information ** -0.5


def focal_information(poses: Poses, rho: Float[np.ndarray, "points"], seen: Observations) -> float:
    """What the points tell of the logarithm of the focal length: inverse of its variance, by their errors and by the
    usual distortion of lenses."""
    variance, by_distortion = _Normal(poses, rho, seen).focal_variance()
    told = max(1e-9, 1 / variance - _FOCAL_SIGMA**-2)
    return 1 / (1 / told + (by_distortion * _DISTORTION_SIGMA) ** 2)


class _Normal:
    """Normal equations at one state. Unknowns: six per camera (rotation vector, center), the logarithm of the focal
    length, the distortion, then logarithms of inverse depths."""

    def __init__(self, poses: Poses, rho: np.ndarray, seen: Observations) -> None:
        self._poses, self._rho = poses, rho
        x, ray, whole = _in_camera(poses, rho, seen)
        z = np.maximum(x[:, 2], _NEAREST)
        D = _to_pixel(x, z) @ np.swapaxes(poses.R[seen.camera], 1, 2) * (np.exp(poses.log_focal) / seen.sigma)
        anchor, own_rho = seen.anchor[seen.point], rho[seen.point, None, None]
        by_log = D @ (poses.center[anchor] - poses.center[seen.camera])[..., None] * own_rho
        error = _errors(x, poses, seen)
        by_lens = self._by_lens(D, error, poses.R[anchor], seen)
        blocks = [D @ _cross(whole), -D * own_rho, -D @ _cross(ray), D * own_rho, by_lens, by_log]
        weight = 1 / (1 + (error**2).sum(1))
        cameras, n = len(poses.R), len(z)
        columns = np.concatenate(
            [6 * seen.camera[:, None] + np.arange(6), 6 * anchor[:, None] + np.arange(6),
             np.tile(6 * cameras + np.arange(2), (n, 1)), 6 * cameras + 2 + seen.point[:, None]], 1,
        )  # fmt: skip
        values = np.concatenate(blocks, 2) * np.sqrt(weight)[:, None, None]
        rows = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), values.shape)
        columns = np.broadcast_to(columns[:, None], values.shape)
        split = 6 * cameras + 2
        J = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (2 * n, split + len(rho))).tocsr()
        H, g = (J.T @ J).tocsr(), J.T @ (error * np.sqrt(weight)[:, None]).ravel()
        self._camera, self._mixed = H[6:split, 6:split].toarray(), H[6:split, split:]
        self._g_camera = g[6:split]
        self._camera[-2, -2] += _FOCAL_SIGMA**-2
        self._g_camera[-2] += poses.log_focal / _FOCAL_SIGMA**2
        self.log_information = H.diagonal()[split:] + _LOG_SIGMA**-2
        self._g_log = g[split:] + _off_prior(rho, seen) / _LOG_SIGMA

    def _by_lens(self, D: np.ndarray, error: np.ndarray, R_anchor: np.ndarray, seen: Observations) -> np.ndarray:
        """Derivatives of the errors by the logarithm of the focal length and by the distortion: both move the
        observation, and the ray of the anchor."""
        to_error = np.exp(self._poses.log_focal) / seen.sigma
        own, anchor = (self._poses.rays(observed) for observed in (seen.seen, seen.ray[seen.point, :2]))
        moved = [np.stack([-ray, ray * (ray**2).sum(1, keepdims=True)], -1) for ray in (own, anchor)]
        by_lens = D @ R_anchor[:, :, :2] @ moved[1] - moved[0] * to_error
        by_lens[:, :, 0] += error
        return by_lens

    def _reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of cameras and lens alone."""
        A = self._camera + np.diag(damping * self._camera.diagonal() + 1e-9)
        scaled = self._mixed.multiply(1 / (self.log_information * (1 + damping))).tocsr()
        return A - (scaled @ self._mixed.T).toarray(), scaled @ self._g_log - self._g_camera

    def step(self, damping: float, free_focal: bool) -> tuple[Poses, np.ndarray]:
        A, b = self._reduced(damping)
        free = len(b) - (1 if free_focal else 2)
        change = np.zeros(len(b))
        change[:free] = np.linalg.solve(A[:free, :free], b[:free])
        d_log = -(self._g_log + self._mixed.T @ change) / (self.log_information * (1 + damping))
        turn, shift = np.split(np.r_[np.zeros((1, 6)), change[:-2].reshape(-1, 6)], 2, axis=1)
        R = np.asarray(matrix_from_axis_angle(turn)) @ self._poses.R
        rho = self._rho * np.exp(np.clip(d_log, -_MAX_LOG_STEP, _MAX_LOG_STEP))
        return Poses(R, self._poses.center + shift, self._poses.log_focal + float(change[-2])), rho

    def focal_variance(self) -> tuple[float, float]:
        """Variance of the logarithm of the focal length for a lens without distortion, and its derivative by that."""
        A = self._reduced(0.0)[0]
        row = np.linalg.inv(A[:-1, :-1])[-1]
        return float(row[-1]), float(-row @ A[:-1, -1])


def _cross(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Matrices of the cross product with each vector."""
    M = np.zeros((len(v), 3, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return M - np.swapaxes(M, 1, 2)
