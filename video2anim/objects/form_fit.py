"""A form laid onto what is seen of an object: sizes, place and yaw by least squares, the form by its evidence.

One fit joins the object's depth points, its outline (what it must cover and what it must not), the usual sizes of its
kind, what rested on it and where bodies were. Forms and starts are compared by the Laplace approximation of their
evidence (MacKay 2003, ch. 27-28), so that a form with more sizes must explain more. Place and scale by the distance
between object and depth are those of the paper, 8.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from video2anim.geometry.heading import Heading
from video2anim.objects.furniture import Form
from video2anim.objects.observed import ObjectEvidence
from video2anim.objects.shapes import CUBE, CYLINDER
from video2anim.objects.solids import Solids

POSE = ("x", "z", "yaw", "base", "distance", "stretch")
"""What every form has beside its sizes: place (m), turn (rad), height that it rests on (m), logarithm of the correction
of its distance, and the share by which its relief (`DepthErrors`) is larger than estimated."""
THIN = ("leg", "pole", "base")
"""Parts that masks lose. Bases stand for the stars that swivel chairs and bar tables have."""
OPEN = ("chair", "table", "stool")
"""Forms that the picture shows the background between the parts of."""
LEANED_ON = ("back", "headboard")
"""Parts that bodies meet from the front; on others they rest from above."""
BESIDE_SEATS = (*LEANED_ON, "arm")
"""Parts that nobody sits or stands on."""
_FLESH_M = 0.05
"""Skin is at least so far from the joints that count: at elbows, knees and ankles; twice that at hips and spine.
Not measured."""
_BEHIND_M = 0.3
"""Deeper than skin is behind a front by error."""
_ROUNDS = 25
_DAMPINGS = np.array([1.0, 10.0, 100.0])
"""Tried at once, times the damping of each start."""
_MIN_GAIN, _MAX_DAMPING = 1e-3, 1e4
"""A start has arrived when its cost falls by less, or its step is damped by more."""
_STEP = np.array([2e-3, 2e-3, 4e-3, 2e-3, 2e-3, 1e-2])
_SIZE_STEP = 4e-3
"""Steps of the numerical derivative: well below what a pixel shows, well above rounding."""
_WIDE = 10.0
"""Times wider are those for evidence and standard deviations, as wide as errors are: where masks and depth jump from
pixel to pixel, narrow ones see a steep slope and no error is left."""


@dataclass(frozen=True, slots=True)
class FitSigmas:
    """Standard deviations and numbers of independent looks.

    Half and twice of each changed, on 29 pieces (seed 9001), the median Chamfer distance by at most 6 mm, the box IoU
    by at most 0.05 and the share of right classes by at most 0.1 (`benchmarks/object_shapes.py --sigma`). That was
    before `noise_observations` left out people and priors; since then only itself was measured (`docs/benchmarks.md`).
    """

    outline_px: float = 1.5
    """Of an object's outline, in pixels of the depth map."""
    outline_share: float = 0.02
    """The same over the square root of the object's area: of half of the masks 95 % of the true pixels are within 0.6 %
    of it, of a quarter some are beyond 14 % (44 masks of `synth --preset random --seed 7201`, 2026-11-29; a script that
    is not kept). A judgment between them; half and twice of it are no better (docs/benchmarks.md)."""
    looks: float = 30.0
    """Neighboring pixels err together: all pixels of an object count as so many independent ones."""
    form_m: float = 0.02
    """Objects differ so much from their form: cushions bulge, edges are round."""
    rest_m: float = 0.03
    """Skin that rests on a surface is so near to it."""
    body_m: float = 0.05
    """Bodies are so deep in objects by their own error; that of the object's distance is fitted."""
    square_rad: float = 0.05
    """Furniture that stands square in its room is so by this: 3 degrees."""
    edge_rad: float = 0.0175
    """Sides of objects are square to their own straight edges by this: 1 degree."""
    square_observations: float = 2.0
    """Either counts as so many looks: objects that stand otherwise are outliers."""
    forward_nats: float = 4.0
    """Who sits on a seat with a back turns that way, but for one of 50: a judgment."""
    base_m: float = 0.005
    """Height of the feet of what stands on the floor."""
    noise_observations: float = 30.0
    """How well those of mask and depth are known for one object: as from so many looks. They share an unknown
    factor."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Deviations of a batch of values from what is known, in units of their standard deviations."""

    loose: Float[np.ndarray, "batch loose"]
    """Those with outliers, which count by Cauchy's logarithm: of depth and of skin."""
    firm: Float[np.ndarray, "batch firm"]
    """Those that count by their size when they are large: of the outline and of bodies."""
    prior: Float[np.ndarray, "batch prior"]
    """Those of usual sizes and places, squared."""
    of_picture: tuple[int, int]
    """The first so many of `loose` and of `firm` are of mask and depth."""
    noise_observations: float
    """Of `FitSigmas`."""

    def picture_cost(self) -> Float[np.ndarray, "batch"]:
        """That of mask and depth, were their noise known."""
        loose, firm = self.of_picture
        return (0.5 * np.log1p(self.loose**2))[:, :loose].sum(1) + (np.sqrt(1 + self.firm**2) - 1)[:, :firm].sum(1)

    def cost(self) -> Float[np.ndarray, "batch"]:
        """Negative logarithm of likelihood and prior.

        All deviations of mask and depth share a factor that is not known: integrated over, their cost counts like this.
        """
        loose, firm = self.of_picture
        apart = (0.5 * np.log1p(self.loose**2))[:, loose:].sum(1) + (np.sqrt(1 + self.firm**2) - 1)[:, firm:].sum(1)
        known = self.noise_observations
        return known * np.log1p(self.picture_cost() / known) + apart + 0.5 * (self.prior**2).sum(1)

    def weights(self) -> Float[np.ndarray, "batch residuals"]:
        """Of the squares of `joined`: those whose sum has the cost's slope."""
        loose, firm = self.of_picture
        shared = 1 / (1 + self.picture_cost()[:, None] / self.noise_observations)
        by_logarithm, by_size = 1 / (1 + self.loose**2), 1 / np.sqrt(1 + self.firm**2)
        by_logarithm[:, :loose] *= shared
        by_size[:, :firm] *= shared
        return np.concatenate([by_logarithm, by_size, np.ones(self.prior.shape)], 1)

    def joined(self) -> Float[np.ndarray, "batch residuals"]:
        """All of them."""
        return np.concatenate([self.loose, self.firm, self.prior], 1)


@dataclass(frozen=True, slots=True, eq=False)
class FormFit:
    """One form at its best place."""

    form: Form
    values: Float[np.ndarray, "values"]
    """`POSE`, then logarithms of sizes."""
    log_evidence: float
    sigma: Float[np.ndarray, "values"]
    """Standard deviations of the values."""
    chamfer_m: float
    """Mean distance of the object's depth points, corrected, from its surface."""

    @property
    def T_world_object(self) -> Float[np.ndarray, "4 4"]:
        x, z, yaw, base = self.values[:4]
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([[c, 0, s, x], [0, 1, 0, base], [-s, 0, c, z], [0, 0, 0, 1.0]])

    @property
    def sizes_m(self) -> Float[np.ndarray, "sizes"]:
        return np.exp(self.values[len(POSE) :])

    def solids(self) -> tuple[tuple[str, ...], Solids]:
        """Names of the parts, and the solids in the object's frame."""
        return self.form.build(self.sizes_m[None])


class FormProblem:
    """Residuals of one form in units of their standard deviations, for a batch of values."""

    def __init__(
        self, form: Form, evidence: ObjectEvidence, base_m: float, sigmas: FitSigmas, samples_per_side: int
    ) -> None:
        self.form, self.evidence, self.sigmas, self.samples = form, evidence, sigmas, samples_per_side
        self.part_names, solids = form.build(form.usual_m[None])
        thick = zip(self.part_names, solids.shapes, strict=True)
        self.is_round = all(shape is CYLINDER for name, shape in thick if name not in THIN)
        known = np.isfinite(evidence.depth_m)
        self.point_rays, self.point_m = evidence.rays[known], evidence.depth_m[known]
        self.log_depth = np.log(self.point_m)
        self.center = float(np.median(self.log_depth)) if known.any() else 0.0
        self.pixel_m = float(np.exp(self.center)) / evidence.intrinsics.fx_px
        self.surface_noise_m = float(np.hypot(sigmas.outline_px * self.pixel_m, sigmas.form_m))
        self.outline_m = float(np.hypot(self.surface_noise_m, sigmas.outline_share * evidence.size_px * self.pixel_m))
        share = known.sum() / max(len(known), 1)
        self.point_weight = np.sqrt(sigmas.looks * share / max(known.sum(), 1))
        self.ray_weight = np.sqrt(sigmas.looks / max(len(known), 1))
        self.others_m = np.concatenate([evidence.others_m, evidence.body_m])
        other_m = np.linalg.norm(evidence.others_m - evidence.camera_m, axis=-1)
        other_noise_m = np.hypot(
            np.hypot(evidence.depth_errors.sigma, evidence.distance_sigma) * other_m, sigmas.form_m
        )
        self.others_weight = _weight(sigmas.looks, len(other_m)) / other_noise_m
        self.steps = np.concatenate([_STEP, np.full(len(form.sizes), _SIZE_STEP)])
        self.prior_sigma = np.concatenate([
            [np.inf, np.inf, np.inf, 0.15 if base_m > 0 else sigmas.base_m, evidence.distance_sigma,
             evidence.depth_errors.relief_sigma], form.spread,
        ])  # fmt: skip
        errors = evidence.depth_errors
        nearer = -errors.open_bias if form.name in OPEN else 0.0
        self.prior_mean = np.concatenate([[0, 0, 0, base_m, nearer, errors.relief - 1], np.log(form.usual_m)])

    def residuals(self, values: Float[np.ndarray, "batch values"]) -> Residuals:
        """Those of mask, depth, people, room and priors."""
        evidence, sigmas, batch = self.evidence, self.sigmas, len(values)
        _, solids = self.form.build(np.exp(values[:, len(POSE) :]))
        others = np.broadcast_to(self.others_m, (batch, *self.others_m.shape))
        points_m = np.concatenate([self._depth_points_m(values), others], 1)
        away_m = solids.distance_m(self._own(values, points_m)).min(1)
        seen, of_others = len(self.point_m), len(self.point_m) + len(evidence.others_m)
        noise_m = np.hypot(evidence.depth_errors.sigma * self.point_m, self.surface_noise_m)
        origin = self._own(values, np.broadcast_to(evidence.camera_m, (batch, 1, 3)))[:, 0]
        rays = _turned(values[:, 2:3], *evidence.rays.T)
        missed = self.ray_weight * solids.miss_m(origin, rays) / self.outline_m
        surface_m = self._surface_m(values, solids)
        outside, before = self._intrusion(values, surface_m)
        loose = [self.point_weight * np.abs(away_m[:, :seen]) / noise_m, before]
        firm = [missed, outside, self.others_weight * np.maximum(-away_m[:, seen:of_others], 0)]
        of_picture = (sum(part.shape[1] for part in loose), sum(part.shape[1] for part in firm))
        if count := len(evidence.rested):
            own_m = self._own(values, np.broadcast_to(evidence.rested.point_m, (batch, count, 3)))
            gap_m = self._rest_gap_m(solids, own_m)
            loose.append(_weight(sigmas.looks, count) * gap_m / sigmas.rest_m)
            loose.append(self._sat_askew(values[:, 2])[:, None])
        if (square := evidence.sides or evidence.walls) is not None:
            loose.append(self._askew(values[:, 2], square)[:, None])
        firm.append(np.maximum(_FLESH_M - away_m[:, of_others:], 0) / sigmas.body_m)
        prior = (values - self.prior_mean)[:, 3:] / self.prior_sigma[3:]
        return Residuals(
            np.concatenate(loose, 1), np.concatenate(firm, 1), prior, of_picture, sigmas.noise_observations
        )  # fmt: skip

    def _askew(self, yaw_rad: Float[np.ndarray, "batch"], square: Heading) -> Float[np.ndarray, "batch"]:
        """Deviation of the yaw from that of straight edges. On round forms each edge has a direction of its own."""
        sigmas, own = self.sigmas, self.evidence.sides is not None
        turn = 4 * (yaw_rad - square.yaw_rad)
        off_rad = np.arctan2(np.sin(turn), np.cos(turn)) / 4
        off = off_rad / np.hypot(square.sigma_rad, sigmas.edge_rad if own else sigmas.square_rad)
        cost = 0.5 * sigmas.square_observations * np.log1p(off**2)
        if self.is_round:
            cost = np.full_like(cost, square.log_odds if own else 0.0)
        return np.sqrt(np.expm1(2 * cost))

    def _sat_askew(self, yaw_rad: Float[np.ndarray, "batch"]) -> Float[np.ndarray, "batch"]:
        """Deviation of a seat's front from where people looked who sat on it; none of what has no back."""
        ahead = self.evidence.rested.ahead
        seated = ahead.any(1)
        if "back" not in self.part_names or not seated.any():
            return np.zeros_like(yaw_rad)
        x, _, z = ahead[seated].mean(0)
        cost = 0.5 * self.sigmas.forward_nats * (1 - np.sin(yaw_rad) * x - np.cos(yaw_rad) * z)
        return np.sqrt(np.expm1(2 * np.maximum(cost, 0)))

    def _rest_gap_m(
        self, solids: Solids, own_m: Float[np.ndarray, "batch rests 3"]
    ) -> Float[np.ndarray, "batch rests"]:
        """Distance of what rested from the parts that it may rest on; what bears weight rests on tops alone."""
        gap_m, carries = np.empty(own_m.shape[:2]), ~np.isin(self.part_names, BESIDE_SEATS)
        bearing = self.evidence.rested.bears & carries.any()
        tops, fronts = _tops(solids), _tops_and_fronts(self.part_names, solids)
        gap_m[:, bearing] = np.abs(tops.distance_m(own_m[:, bearing])[:, carries]).min(1, initial=np.inf)
        gap_m[:, ~bearing] = np.abs(fronts.distance_m(own_m[:, ~bearing]).min(1))
        return gap_m

    def _depth_points_m(self, values: np.ndarray) -> Float[np.ndarray, "batch points 3"]:
        """The object's depth points in the world, corrected."""
        depth_m = self.point_m * self._correction(values, self.log_depth)
        return self.evidence.camera_m + self.point_rays * depth_m[..., None]

    def _correction(self, values: np.ndarray, log_depth: np.ndarray) -> Float[np.ndarray, "batch points"]:
        """True over estimated depth."""
        return np.exp(values[:, 4:5] + values[:, 5:6] * (log_depth - self.center))

    def result(self, starts: Float[np.ndarray, "batch values"], log_prior: float) -> FormFit:
        """The best fit from some starts on, followed to the end."""
        ends = self.fitted(starts, _ROUNDS)
        log_evidence, information = self.laplace(ends)
        best = int(log_evidence.argmax())
        values, variance = ends[best : best + 1], np.diag(np.linalg.pinv(information[best]))
        _, solids = self.form.build(np.exp(values[:, len(POSE) :]))
        gap_m = np.abs(solids.distance_m(self._own(values, self._depth_points_m(values))).min(1))
        return FormFit(
            self.form, values[0], float(log_evidence[best]) + log_prior, np.sqrt(np.maximum(variance, 0)),
            float(gap_m.mean()) if gap_m.size else float("inf"),
        )  # fmt: skip

    def laplace(
        self, values: Float[np.ndarray, "batch values"]
    ) -> tuple[Float[np.ndarray, "batch"], Float[np.ndarray, "batch values values"]]:
        """Logarithm of the evidence, up to a constant that all forms share, and curvature of the cost, over steps as
        wide as errors are."""
        wide, count = _WIDE * np.diag(self.steps), len(self.steps)
        around = np.concatenate([np.zeros((1, count)), wide, -wide])
        residuals = self.residuals((values[:, None] + around).reshape(-1, count))
        found = residuals.joined().reshape(len(values), len(around), -1)[:, 1:]
        slope = (found[:, :count] - found[:, count:]) / (2 * _WIDE * self.steps[:, None])
        weight = residuals.weights()[:: len(around), None]
        information = (slope * weight) @ slope.swapaxes(1, 2) + 1e-9 * np.eye(count)
        _, determinant = np.linalg.slogdet(information)
        cost = residuals.cost()[:: len(around)]
        return -cost - float(np.log(self.form.spread).sum()) - 0.5 * determinant, information

    def _surface_m(self, values: np.ndarray, solids: Solids) -> Float[np.ndarray, "batch points 3"]:
        """Points of the form's surface in the world."""
        own = solids.surface_points_m(self.samples)
        c, s = np.cos(values[:, 2])[:, None], np.sin(values[:, 2])[:, None]
        return np.stack([
            c * own[..., 0] + s * own[..., 2] + values[:, 0:1], own[..., 1] + values[:, 3:4],
            c * own[..., 2] - s * own[..., 0] + values[:, 1:2],
        ], -1)  # fmt: skip

    def _intrusion(self, values: np.ndarray, surface_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far points of the surface are outside the outline, and before what the camera sees."""
        evidence = self.evidence
        camera = surface_m @ evidence.T_camera_world[:3, :3].T + evidence.T_camera_world[:3, 3]
        z, k = np.maximum(camera[..., 2], 0.05), evidence.intrinsics
        u, v = camera[..., 0] / z * k.fx_px + k.cx_px, camera[..., 1] / z * k.fy_px + k.cy_px
        weight = np.sqrt(self.sigmas.looks / surface_m.shape[1])
        height, width = evidence.free_m.shape
        within = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        at = (np.where(within, np.round(v), 0).astype(int), np.where(within, np.round(u), 0).astype(int))
        free = np.where(within, evidence.free_m[at], 0.0)
        free = free * self._correction(values, np.log(np.where(free > 0, free, 1.0)))
        before = np.log(np.maximum(free / z, 1.0)) / np.hypot(evidence.depth_errors.sigma, self.sigmas.form_m / z)
        outside = map_coordinates(evidence.outside_px, [v, u], order=1) * self.pixel_m / self.outline_m
        # Outlines lose what is thin.
        outside *= np.repeat(~np.isin(self.part_names, THIN), surface_m.shape[1] // len(self.part_names))
        return weight * outside, weight * before

    def _own(self, values: np.ndarray, points_m: np.ndarray) -> np.ndarray:
        return _turned(values[:, 2:3], *(points_m[..., k] - values[:, at, None] for k, at in enumerate((0, 3, 1))))

    def fitted(self, starts: Float[np.ndarray, "batch values"], rounds: int) -> Float[np.ndarray, "batch values"]:
        """Levenberg-Marquardt from every start."""
        values, damping, count = starts.copy(), np.full(len(starts), 1e-2), len(self.steps)
        best, active = self.residuals(values).cost(), np.arange(len(starts))
        around = np.concatenate([np.zeros((1, count)), np.diag(self.steps)])
        for _ in range(rounds):
            residuals = self.residuals((values[active, None] + around).reshape(-1, count))
            found = residuals.joined().reshape(len(active), count + 1, -1)
            weight = residuals.weights()[:: count + 1, None]
            slope = (found[:, 1:] - found[:, :1]) / self.steps[:, None]
            curvature = (slope * weight) @ slope.swapaxes(1, 2)
            down = slope @ (weight * found[:, :1]).swapaxes(1, 2)
            scale = np.einsum("bii->bi", curvature) + 1e-6
            damped = damping[active, None, None] * _DAMPINGS[:, None] * scale[:, None]
            tried = values[active, None] - np.linalg.solve(
                curvature[:, None] + damped[..., None] * np.eye(count), down[:, None]
            )[..., 0]  # fmt: skip
            tried[..., len(POSE) :] = np.clip(tried[..., len(POSE) :], np.log(0.01), np.log(20.0))
            costs = self.residuals(tried.reshape(-1, count)).cost().reshape(len(active), -1)
            k, rows = costs.argmin(1), np.arange(len(active))
            gain = best[active] - costs[rows, k]
            better = gain > 0
            values[active[better]], best[active[better]] = tried[rows, k][better], costs[rows, k][better]
            damping[active] *= np.where(better, 0.1 * _DAMPINGS[k], 100.0)
            damping = np.maximum(damping, 1e-4)
            active = active[np.where(better, gain >= _MIN_GAIN, damping[active] <= _MAX_DAMPING)]
            if not len(active):
                break
        return values


def _turned(yaw_rad: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Float[np.ndarray, "batch points 3"]:
    """Vectors along the axes of an object with that yaw; each axis in one piece of memory, which is faster."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    across, along = c * x - s * z, s * x + c * z
    return np.moveaxis(np.stack([across, np.broadcast_to(y, across.shape), along]), 0, -1)


def _weight(looks: float, count: int) -> float:
    """Of each of so many points that err together."""
    return float(np.sqrt(min(looks, count) / count)) if count else 0.0


def _tops(solids: Solids) -> Solids:
    """The solids, of boxes and cylinders the tops alone: skin that is lower is inside by error, or not on them."""
    center_m, half_m = solids.center_m.copy(), solids.half_m.copy()
    flat = np.array([shape in (CUBE, CYLINDER) for shape in solids.shapes])
    upward = np.stack([np.zeros_like(solids.tilt_rad), np.cos(solids.tilt_rad), -np.sin(solids.tilt_rad)], -1)
    center_m[:, flat] += (half_m[..., 1:2] * upward)[:, flat]
    half_m[:, flat, 1] = 0.0
    return replace(solids, center_m=center_m, half_m=half_m)


def _tops_and_fronts(names: Sequence[str], solids: Solids) -> Solids:
    """The solids as hands and backs meet them: by their tops and fronts, so they go on below and behind."""
    center_m, half_m = solids.center_m.copy(), solids.half_m.copy()
    leaning = np.isin(names, LEANED_ON)
    top_m = (center_m + half_m)[..., 1]
    center_m[..., 1] = half_m[..., 1] = 0.5 * top_m
    away = np.stack([np.zeros_like(top_m), np.sin(solids.tilt_rad), np.cos(solids.tilt_rad)], -1)
    center_m[:, leaning] = (solids.center_m - 0.5 * _BEHIND_M * away)[:, leaning]
    half_m[:, leaning] = solids.half_m[:, leaning] + [0.0, 0.0, 0.5 * _BEHIND_M]
    return replace(solids, center_m=center_m, half_m=half_m)
