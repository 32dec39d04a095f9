"""Robust least-squares fit of focal length, gravity, floor, body heights, scale and offset of depth, and the distances
of objects (docs/calibration.md has the factor graph).

One camera determines a scene up to scale only, which is fixed by the prior of body heights and the usual heights of
furniture. Every residual is divided by its standard deviation (`Sigmas`). Evidence may be gross error (a child, a step,
a wrong floor), so residuals of observations have Cauchy's cost; priors have a squared cost. The covariance is the
inverse of J^T J.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial import KDTree

from video2anim.calibration.evidence import Evidence, PixelEvidence
from video2anim.calibration.line import NEAREST, first_line
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.humans.ground import SOLE_SIGMA_M, lowest_level
from video2anim.types.scene import DEPTH_LOG_SIGMA


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Standard deviations of the residuals."""

    up_limit: float = 2.0
    """Standard deviations up to which the cost of a source of gravity is squared. With 1, a person on a step tilts a
    room whose line segments are clear (`tests/calibration/test_fit_contradictions.py`)."""
    sole_m: float = SOLE_SIGMA_M
    sole_distance_ratio: float = 0.03
    """Distance of a body along the line of sight from frame to frame."""
    upright_rad: float = 0.3
    """Direction from feet to center of mass (walking, reaching, bending)."""
    independent_points: float = 12.0
    """Errors of points of one kind are correlated: the floor pixels, the directions of each body's balance, and the
    soles of each other person weigh as much as so many independent points. The skin points of a frame weigh as one."""
    floor_log: float = 0.08
    """Depth of a floor pixel, logarithm."""
    skin_log: float = 0.05
    """Depth of skin against that of the nearest depth pixel, logarithm. Distances only: the shape of
    a body in a network's depth is no evidence of the focal length. With 0.08, as of the floor, scale and chamfer
    distance of `ocv_sts` grow by 4 and 2 %."""
    distance_log: float = DEPTH_LOG_SIGMA
    foot_px: float = 1.5
    """Row in which an object's mask ends. Near the horizon a pixel is far on the floor."""
    foot_log: float = 0.02
    """Distance of the floor at the lowest pixel of an object, logarithm: floors are not flat, lenses distort."""
    overhang_log: float = 0.08
    """An object may be so much nearer than its lowest pixel on the floor, logarithm: its lower edge may be above the
    floor."""


USUAL_HEIGHT_M = {
    "table": (0.74, 0.04), "dining table": (0.74, 0.04), "desk": (0.74, 0.04), "chair": (0.88, 0.08),
    "armchair": (0.90, 0.10), "sofa": (0.82, 0.08), "couch": (0.82, 0.08), "stool": (0.47, 0.08), "door": (2.03, 0.06),
}  # fmt: skip
"""Height of furniture and its spread: table tops 0.72 to 0.76 m and doors 1.985 and 2.11 m by the standards, seats 0.42
to 0.48 m, backs of chairs 0.8 to 1.0 m by catalogs."""
_ROUNDS = 4
"""Searches for the nearest points of skin and depth after the choice of the start."""
_PAIRS = 30
"""Pairs of points per frame and direction of the search."""
_BOUNDED = 0.0
"""Marks residuals with Geman and McClure's cost, at most 1 each: people on a roof do not tilt the ground below."""
MIN_CAMERA_M = 0.05
"""Least height of the camera at the start, since its logarithm is an unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Result of the fit, with standard deviations of logarithms, angles and meters."""

    focal_px: float
    focal_log_sigma: float
    up_camera: Float[np.ndarray, "3"]
    up_sigma_rad: float
    camera_height_m: float
    camera_height_sigma_m: float
    body_height_ratio: Float[np.ndarray, "persons"]
    """Sizes over those of stage humans."""
    body_height_log_sigma: Float[np.ndarray, "persons"]
    above_floor_m: Float[np.ndarray, "persons"]
    """Height of each person's soles over the floor, median."""
    scale: float
    offset: float
    scale_log_sigma: float
    offset_sigma: float
    person_depth_log: float
    """Logarithm of the factor on the main person's depth by the network, relative to the floor."""
    object_depth_log: Float[np.ndarray, "objects"]
    """The same of every object."""
    object_depth_log_sigma: Float[np.ndarray, "objects"]
    residuals: dict[str, float]
    """Root mean square of each kind of evidence in standard deviations; far above 1 it contradicts the rest."""
    chamfer_before_m: float
    chamfer_after_m: float


def under_lens(
    root_m: Float[np.ndarray, "*bodies 3"], lens: float
) -> tuple[Float[np.ndarray, "*bodies 3"], Float[np.ndarray, "*bodies 3 3"]]:
    """Roots under a focal length `lens` times as long, at the same pixel and body size, and the rotation from the old
    viewing ray to the new one (camera frame)."""
    moved_m = root_m * np.array([1.0, 1.0, lens])
    old, new = (one / np.linalg.norm(one, axis=-1, keepdims=True) for one in (root_m, moved_m))
    return moved_m, np.asarray(matrix_from_axis_angle(np.cross(old, new)))


class _State:
    """Named parts of the vector of unknowns, whose entries are 0 at the start and of order 1."""

    def __init__(self, x: np.ndarray, problem: _Problem) -> None:
        e, n = problem.evidence, len(problem.evidence.people)
        self.lens = float(np.exp(x[0]))
        self.focal_px = e.focal_px * self.lens
        self.up = matrix_from_axis_angle(problem.tangent @ x[1:3]) @ problem.up
        self.height_m = problem.height_m * float(np.exp(x[3]))
        self.scale = problem.line[0] * float(np.exp(x[4]))
        self.offset = problem.line[1] + x[5] * problem.unit
        self.person_log = x[6]
        self.size = np.exp(x[7 : 7 + n])
        self.object_log = x[7 + n :]

    def rays(self, pixel: np.ndarray) -> np.ndarray:
        """Rays of unit z-depth."""
        return np.concatenate([pixel / self.focal_px, np.ones((*pixel.shape[:-1], 1))], -1)

    def body(self, points_m: np.ndarray, root_m: np.ndarray, size: float) -> np.ndarray:
        """Points of a body of another size under another focal length: it keeps its position and size in the image, and
        turns with its viewing ray."""
        moved_m, _ = under_lens(root_m, self.lens)
        return size * (moved_m + self.turned(points_m - root_m, root_m))

    def turned(self, vectors: np.ndarray, root_m: np.ndarray) -> np.ndarray:
        """Vectors relative to roots, rotated from the old viewing ray to the new one."""
        _, R = under_lens(root_m, self.lens)
        return (np.broadcast_to(R, (*vectors.shape[:-1], 3, 3)) @ vectors[..., None])[..., 0]


class _Problem:
    """Residuals for one start of gravity."""

    def __init__(self, evidence: Evidence, sigmas: Sigmas, up: np.ndarray) -> None:
        self.evidence, self.sigmas, self.up = evidence, sigmas, up
        soles_m = evidence.people[0].soles_m @ up
        level_m = lowest_level(soles_m)
        self.height_m = max(-float(np.median(level_m)), MIN_CAMERA_M)
        self.on_floor = (soles_m >= level_m.min()) & (soles_m <= level_m.max())
        """Soles of the main person on the lowest level at the start."""
        self.line = first_line(evidence, up, self.height_m)
        self.unit = max(self.line[0] * abs(evidence.median_value), 1e-9)
        self.tangent = np.linalg.svd(up[None])[2][1:].T
        self.pairs: tuple[np.ndarray, np.ndarray, PixelEvidence] | None = None

    def inverse_log(self, value: np.ndarray, state: _State) -> np.ndarray:
        """Logarithm of the depth of values, smoothly bounded where the line is near 0 or below."""
        line = state.scale * value + state.offset
        line = np.logaddexp(0.0, (line - NEAREST) / (0.02 * self.unit)) * 0.02 * self.unit + NEAREST
        return np.log(line) if self.evidence.kind == "depth" else -np.log(line)

    def pair(self, state: _State) -> None:
        """Find the nearest points of skin and backprojected depth, in both directions, in all frames."""
        skins, roots, pixels, values = [], [], [], []
        for one in self.evidence.skin:
            skin_m = state.body(one.skin_m, one.root_m, float(state.size[0]))
            depth_m = self.lifted(one.pixel, one.value, state)
            some = [
                np.linspace(0, len(points) - 1, min(_PAIRS, len(points))).astype(int) for points in (skin_m, depth_m)
            ]
            skin = np.concatenate([some[0], KDTree(skin_m).query(depth_m[some[1]])[1]])
            depth = np.concatenate([KDTree(depth_m).query(skin_m[some[0]])[1], some[1]])
            skins.append(one.skin_m[skin])
            roots.append(np.broadcast_to(one.root_m, skins[-1].shape))
            pixels.append(one.pixel[depth])
            values.append(one.value[depth])
        if skins:
            seen = PixelEvidence(np.concatenate(pixels), np.concatenate(values))
            self.pairs = np.concatenate(skins), np.concatenate(roots), seen

    def lifted(self, pixel: np.ndarray, value: np.ndarray, state: _State) -> np.ndarray:
        """Backprojected depth of the main person."""
        return state.rays(pixel) * np.exp(state.person_log + self.inverse_log(value, state))[:, None]

    def weight(self, points: int) -> float:
        """Square root of the weight of each of `points` correlated points."""
        return min(1.0, self.sigmas.independent_points / max(points, 1)) ** 0.5

    def residuals(self, x: np.ndarray) -> np.ndarray:
        return np.concatenate([weight * _robust(r, limit) for _, r, weight, limit in self.rows(x)])

    def rows(self, x: np.ndarray) -> list[tuple[str, np.ndarray, float, float]]:
        """Kind of evidence, residuals in standard deviations, square root of their weight, and limit of `_robust`."""
        e, s, state = self.evidence, self.sigmas, _State(x, self)
        rows = [("lens", np.array([x[0] / e.focal_log_sigma]), 1.0, np.inf)]
        rows += [
            (f"up by {one.source}", _apart(state.up, one.up_camera) / one.sigma_rad, 1.0, s.up_limit) for one in e.up
        ]
        own = state.offset / (state.scale * e.median_value)
        rows.append(("usual offset", np.array([(own - e.usual_offset) / e.usual_offset_sigma]), 1.0, np.inf))
        depth_logs = np.concatenate([[state.person_log], state.object_log])
        rows.append(("distances", depth_logs / s.distance_log, 1.0, np.inf))
        for number, (size, person) in enumerate(zip(state.size, e.people, strict=True)):
            rows.append(("body height", np.array([np.log(size) / person.body_height_sigma]), 1.0, np.inf))
            soles_m = state.body(person.soles_m, person.soles_root_m, size)
            sigma_m = np.hypot(s.sole_m * size, s.sole_distance_ratio * soles_m @ state.up)
            weight = self.weight(len(soles_m)) if number else 1.0
            off = (soles_m @ state.up + state.height_m) / sigma_m
            floor = self.on_floor if number == 0 else np.zeros(len(off), bool)
            rows.append(("soles on the floor", off[floor], weight, 1.0))
            rows.append(("soles on other levels", off[~floor], weight, _BOUNDED))
            upright = state.turned(person.upright, person.upright_root_m)
            off = _apart(state.up, upright).reshape(-1) / s.upright_rad
            rows.append(("upright", off, self.weight(len(upright)), 1.0))
        if len(e.floor.value):
            off = self._floor(e.floor, state) / s.floor_log
            rows.append(("floor pixels", off, self.weight(len(off)), 1.0))
        if self.pairs is not None:
            skin_m, root_m, seen = self.pairs
            skin_log = np.log(np.maximum(state.body(skin_m, root_m, state.size[0])[:, 2], 0.1))
            off = (skin_log - state.person_log - self.inverse_log(seen.value, state)) / s.skin_log
            rows.append(("skin to its depth", off, (len(e.skin) / len(off)) ** 0.5, 1.0))
        return rows + self._objects(state)

    def _floor(self, floor: PixelEvidence, state: _State) -> np.ndarray:
        return self.inverse_log(floor.value, state) - self._log_floor(floor.pixel, state)

    def _log_floor(self, pixel: np.ndarray, state: _State) -> np.ndarray:
        """Logarithm of the depth at which rays meet the floor."""
        return np.log(state.height_m / np.maximum(-state.rays(pixel) @ state.up, NEAREST))

    def _objects(self, state: _State) -> list[tuple[str, np.ndarray, float, float]]:
        e, s, rows = self.evidence, self.sigmas, []
        for log, one in zip(state.object_log, e.objects, strict=True):
            if one.under_feet is not None:
                soles = one.under_feet
                sole_m = state.body(soles.skin_m, soles.root_m, state.size[0])
                off = log + self.inverse_log(soles.value, state) - np.log(np.maximum(sole_m[:, 2], 0.1))
                # From below, its top is hidden, and soles are behind the edge that is seen.
                off = np.where(sole_m @ state.up > 0, np.maximum(off, 0), off) / s.skin_log
                rows.append(("objects under feet", off, 1.0, 1.0))
            if one.foot is not None:
                off = log + self._floor(one.foot, state)
                nearer = 0.0 if one.foot_is_cut else np.minimum(off + s.overhang_log, 0)
                off = np.maximum(off, 0) + nearer
                row_log = s.foot_px / state.focal_px / np.maximum(-state.rays(one.foot.pixel) @ state.up, NEAREST)
                rows.append(("objects' feet on the floor", off / np.hypot(row_log, s.foot_log), 1.0, 1.0))
            if one.top is not None and one.label in USUAL_HEIGHT_M:
                usual_m, sigma_m = USUAL_HEIGHT_M[one.label]
                z_m = np.exp(log + self.inverse_log(one.top.value, state))
                top_m = z_m * (state.rays(one.top.pixel) @ state.up) + state.height_m
                rows.append(("sizes of furniture", (top_m - usual_m) / sigma_m, 1.0, 1.0))
        return rows


def calibrate(evidence: Evidence, sigmas: Sigmas | None = None) -> Calibration:
    """The best fit from several starts of gravity.

    Raises:
        ValueError: no person was seen, or there is no source of gravity.
    """
    if not evidence.people or not len(evidence.people[0].soles_m) or not evidence.up:
        raise ValueError("calibrate: want a person who was seen and at least one source of gravity")
    sigmas = sigmas or Sigmas()
    start = np.zeros(7 + len(evidence.people) + len(evidence.objects))
    fits = [_solve(_Problem(evidence, sigmas, one.up_camera), start) for one in evidence.up]
    best, problem = min(fits, key=lambda fit: fit[0].cost)
    for _ in range(_ROUNDS):
        best, _ = _solve(problem, best.x)
    return _result(best, problem)


def _solve(problem: _Problem, x: np.ndarray) -> tuple[OptimizeResult, _Problem]:
    problem.pair(_State(x, problem))
    return least_squares(problem.residuals, x, x_scale=0.1, max_nfev=30, xtol=1e-4), problem


def _result(found: OptimizeResult, problem: _Problem) -> Calibration:
    x, e = found.x, problem.evidence
    state, start = _State(x, problem), _State(np.zeros_like(x), problem)
    J = found.jac
    sigma = np.sqrt(np.diag(np.linalg.inv(J.T @ J + 1e-9 * np.eye(len(x)))))
    n = len(e.people)
    return Calibration(
        focal_px=state.focal_px,
        focal_log_sigma=float(sigma[0]),
        up_camera=state.up,
        up_sigma_rad=float(np.hypot(sigma[1], sigma[2]) / 2**0.5),
        camera_height_m=state.height_m,
        camera_height_sigma_m=float(state.height_m * sigma[3]),
        body_height_ratio=state.size,
        body_height_log_sigma=sigma[7 : 7 + n],
        above_floor_m=np.array(
            [
                state.height_m + np.median(state.body(one.soles_m, one.soles_root_m, size) @ state.up)
                for one, size in zip(e.people, state.size, strict=True)
            ]
        ),
        scale=state.scale,
        offset=float(state.offset),
        scale_log_sigma=float(sigma[4]),
        offset_sigma=float(sigma[5] * problem.unit),
        person_depth_log=float(state.person_log),
        object_depth_log=state.object_log,
        object_depth_log_sigma=np.array(
            [
                np.hypot(own, 0.0 if one.foot is None else 0.5 * problem.sigmas.overhang_log)
                for own, one in zip(sigma[7 + n :], e.objects, strict=True)
            ]
        ),
        residuals=_by_kind(problem.rows(x)),
        chamfer_before_m=_chamfer_m(problem, start),
        chamfer_after_m=_chamfer_m(problem, state),
    )


def _by_kind(rows: Sequence[tuple[str, np.ndarray, float, float]]) -> dict[str, float]:
    kinds = dict.fromkeys(kind for kind, *_ in rows)
    every = {kind: np.concatenate([r for own, r, *_ in rows if own == kind]) for kind in kinds}
    return {kind: float(np.sqrt(np.mean(r**2))) for kind, r in every.items() if len(r)}


def _chamfer_m(problem: _Problem, state: _State) -> float:
    from video2anim.geometry.chamfer import chamfer_m

    distances_m = [
        chamfer_m(
            problem.lifted(one.pixel, one.value, state), state.body(one.skin_m, one.root_m, state.size[0]),
            trim_ratio=0.05,
        )
        for one in problem.evidence.skin
    ]  # fmt: skip
    return float(np.mean(distances_m or [np.nan]))


def _apart(up: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Rotation vectors (radians) from one direction to others."""
    axis = np.cross(up, directions)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (directions @ up)[..., None])
    return axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)


def _robust(r: np.ndarray, limit: float) -> np.ndarray:
    """Residuals whose square is the robust cost of the given ones: Cauchy's with the given scale, squared for infinity,
    Geman and McClure's for `_BOUNDED`."""
    if limit == _BOUNDED:
        return r / np.sqrt(1 + r * r)
    return r if np.isinf(limit) else np.sign(r) * limit * np.sqrt(np.log1p((r / limit) ** 2))
