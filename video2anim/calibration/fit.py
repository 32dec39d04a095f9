"""Robust least-squares fit of the floor, body heights, scale and offset of depth, and the distances of objects
(docs/calibration.md has the factor graph). Focal length and gravity are those of stage camera.

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

from video2anim.calibration.evidence import FLOOR, ROOM, Evidence, PersonEvidence, PixelEvidence, PointEvidence
from video2anim.calibration.line import NEAREST, first_line
from video2anim.humans.ground import SUPPORT_SIGMA_M, lowest_level
from video2anim.types.camera import SLOPE_SIGMA_RAD
from video2anim.types.scene import DEPTH_LOG_SIGMA


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Standard deviations of the residuals."""

    support_m: float = SUPPORT_SIGMA_M
    support_distance_ratio: float = 0.03
    """Distance of a body along the line of sight from frame to frame."""
    independent_points: float = 12.0
    """Errors of points of one kind are correlated: the floor pixels and the support of each other person weigh as much
    as so many independent points. The skin points of a frame weigh as one."""
    floor_log: float = 0.08
    """Depth of a floor pixel, logarithm."""
    skin_log: float = 0.05
    """Depth of skin against that of the nearest depth pixel, logarithm. With 0.08, as of the floor, scale and chamfer
    distance of `ocv_sts` grow by 4 and 2 %."""
    distance_log: float = DEPTH_LOG_SIGMA
    foot_px: float = 1.5
    """Row in which an object's mask ends. Near the horizon a pixel is far on the floor."""
    foot_log: float = 0.02
    """Distance of the floor at the lowest pixel of an object, logarithm: floors are not flat, lenses distort."""
    slope_rad: float = SLOPE_SIGMA_RAD
    """Of the ground. Near the horizon the slope makes ground much farther or nearer."""
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
"""Searches for the nearest points of skin and depth after the first."""
_PAIRS = 30
"""Pairs of points per frame and direction of the search."""
_BOUNDED = 0.0
"""Marks residuals with Geman and McClure's cost, at most 1 each: people on a roof do not lift the ground below."""
MIN_CAMERA_M = 0.05
"""Least height of the camera at the start, since its logarithm is an unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Result of the fit, with standard deviations of logarithms and meters."""

    camera_height_m: float
    camera_height_sigma_m: float
    body_height_ratio: Float[np.ndarray, "persons"]
    """Sizes over those of stage humans."""
    body_height_log_sigma: Float[np.ndarray, "persons"]
    path_ratio: float
    """Length of a traveling camera's path over that of stage humans, for a main person of the size there."""
    path_log_sigma: float
    """0 if the camera does not travel."""
    above_floor_m: Float[np.ndarray, "persons"]
    """Height of each person's support over the floor, median."""
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


class _State:
    """Named parts of the vector of unknowns, whose entries are 0 at the start and of order 1."""

    def __init__(self, x: np.ndarray, problem: _Problem) -> None:
        n = len(problem.evidence.people)
        self.height_m = problem.height_m * float(np.exp(x[0]))
        self.scale = problem.line[0] * float(np.exp(x[1]))
        self.offset = problem.line[1] + x[2] * problem.unit
        self.person_log = x[3]
        self.size = np.exp(x[4 : 4 + n])
        self.object_log = x[4 + n :][: len(problem.evidence.objects)]
        self.path_log = x[-1] if problem.evidence.path_log_sigma else 0.0


class _Problem:
    """Residuals, and the start of the unknowns."""

    def __init__(self, evidence: Evidence, sigmas: Sigmas) -> None:
        self.evidence, self.sigmas = evidence, sigmas
        support_m = evidence.people[0].support_m @ evidence.up
        level_m = lowest_level(support_m)
        self.height_m = max(-float(np.median(level_m)), MIN_CAMERA_M)
        self.on_floor = (support_m >= level_m.min()) & (support_m <= level_m.max())
        """Support of the main person on the lowest level at the start."""
        self.line = first_line(evidence, self.height_m)
        self.unit = max(self.line[0] * abs(evidence.median_value), 1e-9)
        self.pairs: tuple[np.ndarray, PixelEvidence] | None = None

    def inverse_log(self, value: np.ndarray, state: _State) -> np.ndarray:
        """Logarithm of the depth of values, smoothly bounded where the line is near 0 or below."""
        line = state.scale * value + state.offset
        line = np.logaddexp(0.0, (line - NEAREST) / (0.02 * self.unit)) * 0.02 * self.unit + NEAREST
        return np.log(line) if self.evidence.kind == "depth" else -np.log(line)

    def pair(self, state: _State) -> None:
        """Find the nearest points of skin and backprojected depth, in both directions, in all frames."""
        skins, rays, values = [], [], []
        for one in self.evidence.skin:
            skin_m = state.size[0] * one.skin_m
            depth_m = self.lifted(one.ray, one.value, state)
            some = [
                np.linspace(0, len(points) - 1, min(_PAIRS, len(points))).astype(int) for points in (skin_m, depth_m)
            ]
            skin = np.concatenate([some[0], KDTree(skin_m).query(depth_m[some[1]])[1]])
            depth = np.concatenate([KDTree(depth_m).query(skin_m[some[0]])[1], some[1]])
            skins.append(one.skin_m[skin, 2])
            rays.append(one.ray[depth])
            values.append(one.value[depth])
        if skins:
            self.pairs = np.concatenate(skins), PixelEvidence(np.concatenate(rays), np.concatenate(values))

    def lifted(self, ray: np.ndarray, value: np.ndarray, state: _State) -> np.ndarray:
        """Backprojected depth of the main person."""
        return ray * np.exp(state.person_log + self.inverse_log(value, state))[:, None]

    def weight(self, points: int) -> float:
        """Square root of the weight of each of `points` correlated points."""
        return min(1.0, self.sigmas.independent_points / max(points, 1)) ** 0.5

    def residuals(self, x: np.ndarray) -> np.ndarray:
        return np.concatenate([weight * _robust(r, limit) for _, r, weight, limit in self.rows(x)])

    def rows(self, x: np.ndarray) -> list[tuple[str, np.ndarray, float, float]]:
        """Kind of evidence, residuals in standard deviations, square root of their weight, and limit of `_robust`."""
        e, s, state = self.evidence, self.sigmas, _State(x, self)
        own = state.offset / (state.scale * e.median_value)
        rows = [("usual offset", np.array([(own - e.usual_offset) / e.usual_offset_sigma]), 1.0, np.inf)]
        depth_logs = np.concatenate([[state.person_log], state.object_log])
        rows.append(("distances", depth_logs / s.distance_log, 1.0, np.inf))
        for number, (size, person) in enumerate(zip(state.size, e.people, strict=True)):
            rows.append(("body height", np.array([np.log(size) / person.body_height_sigma]), 1.0, np.inf))
            low_m = self.low_m(person, size, state)
            sigma_m = np.hypot(s.support_m * size, s.support_distance_ratio * low_m)
            weight = self.weight(len(low_m)) if number else 1.0
            off = (low_m + state.height_m) / sigma_m
            floor = self.on_floor if number == 0 else np.zeros(len(off), bool)
            rows.append(("support on the floor", off[floor], weight, 1.0))
            rows.append(("support on other levels", off[~floor], weight, _BOUNDED))
        if len(e.floor.value):
            off = self._floor(e.floor, state) / s.floor_log
            rows.append(("floor pixels", off, self.weight(len(off)), 1.0))
        if self.pairs is not None:
            skin_m, seen = self.pairs
            skin_log = np.log(np.maximum(state.size[0] * skin_m, 0.1))
            off = (skin_log - state.person_log - self.inverse_log(seen.value, state)) / s.skin_log
            rows.append(("skin to its depth", off, (len(e.skin) / len(off)) ** 0.5, 1.0))
        if e.path_log_sigma:
            rows.append(("length of the path", np.array([state.path_log / e.path_log_sigma]), 1.0, np.inf))
        if e.points is not None:
            rows += self._points(e.points, state)
        return rows + self._objects(state)

    def low_m(self, person: PersonEvidence, size: float, state: _State) -> np.ndarray:
        """Height of the support of a person of a size above the first camera, for a path of another length."""
        camera_m = person.camera_m @ self.evidence.up
        path = state.size[0] * np.exp(state.path_log)
        return size * (person.support_m @ self.evidence.up - camera_m) + path * camera_m

    def _floor(self, floor: PixelEvidence, state: _State) -> np.ndarray:
        return self.inverse_log(floor.value, state) - self._log_floor(floor.ray, state)

    def _log_floor(self, ray: np.ndarray, state: _State) -> np.ndarray:
        """Logarithm of the depth at which rays meet the floor."""
        return np.log(state.height_m / np.maximum(-ray @ self.evidence.up, NEAREST))

    def _points(self, points: PointEvidence, state: _State) -> list[tuple[str, np.ndarray, float, float]]:
        """Points that the camera has passed, against the floor and against the depth of their pixels."""
        s, ray, rows = self.sigmas, points.seen.ray, []
        point_log = np.log(points.depth_m) + state.path_log + np.log(state.size[0])
        depth_log = self.inverse_log(points.seen.value, state)
        for surface in sorted(set(points.surface.tolist())):
            own = points.surface == surface
            weight, sigma = self.weight(int(own.sum())), points.log_sigma[own]
            if surface == FLOOR:
                off = point_log[own] - self._log_floor(ray[own], state)
                slope_log = s.slope_rad / np.maximum(-ray[own] @ self.evidence.up, NEAREST)
                rows.append(("points on the floor", off / np.hypot(sigma, slope_log), weight, 1.0))
            off = point_log[own] - depth_log[own] - (state.object_log[surface] if surface >= 0 else 0.0)
            of_network = s.distance_log if surface == ROOM else s.floor_log
            rows.append(("points and depth", off / np.hypot(sigma, of_network), weight, 1.0))
        return rows

    def _objects(self, state: _State) -> list[tuple[str, np.ndarray, float, float]]:
        e, s, rows = self.evidence, self.sigmas, []
        for log, one in zip(state.object_log, e.objects, strict=True):
            if one.under_feet is not None:
                soles = one.under_feet
                sole_m = state.size[0] * soles.skin_m
                off = log + self.inverse_log(soles.value, state) - np.log(np.maximum(sole_m[:, 2], 0.1))
                # From below, its top is hidden, and soles are behind the edge that is seen.
                off = np.where(sole_m @ e.up > 0, np.maximum(off, 0), off) / s.skin_log
                rows.append(("objects under feet", off, 1.0, 1.0))
            if one.foot is not None:
                off = log + self._floor(one.foot, state)
                nearer = 0.0 if one.foot_is_cut else np.minimum(off + s.overhang_log, 0)
                off = np.maximum(off, 0) + nearer
                row_log = s.foot_px / e.focal_px / np.maximum(-one.foot.ray @ e.up, NEAREST)
                rows.append(("objects' feet on the floor", off / np.hypot(row_log, s.foot_log), 1.0, 1.0))
            if one.top is not None and one.label in USUAL_HEIGHT_M:
                usual_m, sigma_m = USUAL_HEIGHT_M[one.label]
                z_m = np.exp(log + self.inverse_log(one.top.value, state))
                top_m = z_m * (one.top.ray @ e.up) + state.height_m
                rows.append(("sizes of furniture", (top_m - usual_m) / sigma_m, 1.0, 1.0))
        return rows


def calibrate(evidence: Evidence, sigmas: Sigmas | None = None) -> Calibration:
    """The best fit.

    Raises:
        ValueError: no person was seen.
    """
    if not evidence.people or not len(evidence.people[0].support_m):
        raise ValueError("calibrate: want a person who was seen")
    problem = _Problem(evidence, sigmas or Sigmas())
    x = np.zeros(4 + len(evidence.people) + len(evidence.objects) + (evidence.path_log_sigma > 0))
    found = _solve(problem, x)
    for _ in range(_ROUNDS):
        found = _solve(problem, found.x)
    return _result(found, problem)


def _solve(problem: _Problem, x: np.ndarray) -> OptimizeResult:
    problem.pair(_State(x, problem))
    return least_squares(problem.residuals, x, x_scale=0.1, max_nfev=30, xtol=1e-4)


def _result(found: OptimizeResult, problem: _Problem) -> Calibration:
    x, e = found.x, problem.evidence
    state, start = _State(x, problem), _State(np.zeros_like(x), problem)
    J = found.jac
    sigma = np.sqrt(np.diag(np.linalg.inv(J.T @ J + 1e-9 * np.eye(len(x)))))
    n = len(e.people)
    return Calibration(
        camera_height_m=state.height_m,
        camera_height_sigma_m=float(state.height_m * sigma[0]),
        body_height_ratio=state.size,
        body_height_log_sigma=sigma[4 : 4 + n],
        path_ratio=float(np.exp(state.path_log)),
        path_log_sigma=float(sigma[-1]) if e.path_log_sigma else 0.0,
        above_floor_m=np.array(
            [
                state.height_m + np.median(problem.low_m(one, size, state))
                for one, size in zip(e.people, state.size, strict=True)
            ]
        ),
        scale=state.scale,
        offset=float(state.offset),
        scale_log_sigma=float(sigma[1]),
        offset_sigma=float(sigma[2] * problem.unit),
        person_depth_log=float(state.person_log),
        object_depth_log=state.object_log,
        object_depth_log_sigma=np.array(
            [
                np.hypot(own, 0.0 if one.foot is None else 0.5 * problem.sigmas.overhang_log)
                for own, one in zip(sigma[4 + n :][: len(e.objects)], e.objects, strict=True)
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
            problem.lifted(one.ray, one.value, state),
            state.size[0] * one.skin_m,
            trim_ratio=0.05,
        )
        for one in problem.evidence.skin
    ]
    return float(np.mean(distances_m or [np.nan]))


def _robust(r: np.ndarray, limit: float) -> np.ndarray:
    """Residuals whose square is the robust cost of the given ones: Cauchy's with the given scale, squared for infinity,
    Geman and McClure's for `_BOUNDED`."""
    if limit == _BOUNDED:
        return r / np.sqrt(1 + r * r)
    return r if np.isinf(limit) else np.sign(r) * limit * np.sqrt(np.log1p((r / limit) ** 2))
