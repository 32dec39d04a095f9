"""What one camera and the people show of the objects, for their fit."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.heading import EdgeHeadings
from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import invert_rigid, surface_normals
from video2anim.objects.backproject import BackprojectedObject, ObjectBackprojector
from video2anim.objects.foreground import floor_band_m
from video2anim.objects.form_fit import FitSigmas
from video2anim.objects.observed import DepthErrors, ObjectEvidence
from video2anim.objects.upright_box import UprightBox, fit_upright_box, turned_to
from video2anim.types import CompletedObject, InstanceMasks, MetricDepth
from video2anim.types.contact import RestedSkin

_POINTS = 160
"""Pixels of an object that are looked at; the time of a fit grows with them."""
_RAISED_M = 0.15
"""What ends so far above the floor, where the picture goes on below it, stands on something else."""
_LOWER_END, _REACH = 0.2, 3.0
"""Unless there is floor below most of the lowest fifth of its height, within so many standard deviations of its
outline. Looked at on six real clips; with all of its columns or two deviations the reflectors of `ocv_walk` hover."""
_STEP, _STEP_M = 0.1, 0.02
"""What carries an object is as far and as high as its lower end; what hides that is nearer by this share, or higher."""
_NEAR_M = 0.3
"""Skin so near to the box of an object's depth points may have touched it: the error of its place across the view."""
_FARTHEST, _DISTANCES = 3.0, 9
"""That may be at each of so many distances, up to so many standard deviations off."""
_AROUND_M = 1.5
"""Walls, objects and bodies so near to it may be reached by its hidden part: the length of a bed less what is seen of
it."""
_OFF_FLOOR_M = 0.1
"""Depth of the floor is off by so much."""
_MIN_DISTANCE_SIGMA = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class PeopleEvidence:
    """Where people were, in the world."""

    rested: RestedSkin
    """Above the floor."""
    body_m: Float[np.ndarray, "inner 3"]
    """Joints deep in the body: no object is there."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenObject:
    """One object with what is known of it."""

    evidence: ObjectEvidence
    points_m: Float[np.ndarray, "points 3"]
    """Its depth points in the world, with the relief that objects have on average."""
    normals: Float[np.ndarray, "points 3"]
    """Of those points."""
    own: Bool[np.ndarray, "height width"]
    """Its visible pixels."""
    outline: Bool[np.ndarray, "height width"]
    """Those and the hidden ones that were completed."""

    def rested_at(self, places: Collection[int]) -> SeenObject:
        """The same if only what rested at these places rested on it."""
        return replace(self, evidence=self.evidence.rested_at(places))

    def box(self, distance_log: float = 0.0) -> UprightBox:
        """The box around them, down to the floor if it stands there; +z of its frame faces the camera.

        `distance_log`: logarithm of a correction of their distance.
        """
        camera_m = self.evidence.camera_m
        points_m = camera_m + np.exp(distance_log) * (self.points_m - camera_m)
        yaw_rad = None if self.evidence.sides is None else self.evidence.sides.yaw_rad
        box = turned_to(fit_upright_box(points_m, self.normals, yaw_rad), camera_m)
        if self.evidence.raised:
            return box
        # The lowest of its pixels are left to the floor, or hidden.
        low_m = box.low_m * np.array([1.0, 0.0, 1.0])
        return box.with_bounds(low_m, np.maximum(box.high_m, low_m))


class ObjectViews:
    """The objects of one picture."""

    def __init__(
        self,
        masks: InstanceMasks,
        depth: MetricDepth,
        unseen: Bool[np.ndarray, "height width"],
        people: PeopleEvidence,
        depth_errors: DepthErrors,
        edges: EdgeHeadings,
    ) -> None:
        """`unseen`: pixels that people always covered."""
        self._edges, self._walls = edges, edges.of_room()
        self._lifter, self._depth, self._unseen = ObjectBackprojector(masks, depth), depth, unseen
        self._people, self._depth_errors = people, depth_errors
        self._lifted = {i.object_id: self._lifter.lift(i.object_id) for i in masks.instances}
        self._distance_m = {
            number: float(np.median(one.depth_m[one.shows])) if one.shows.any() else np.inf
            for number, one in self._lifted.items()
        }
        self._world_m = self._lifter.world_m()
        self._normals = surface_normals(self._world_m)

    def object(self, found: CompletedObject, rng: np.random.Generator) -> SeenObject | None:
        """None if none of its pixels has reliable depth."""
        obj, lifter = self._lifted[found.object_id], self._lifter
        own, known = obj.own, lifter.known
        if not obj.shows.any():
            return None
        nearer = self._nearer(found.object_id)
        outline, k = self._outline(found, obj), lifter.view.intrinsics
        outside = _outside_px(outline | self._unseen | nearer)
        row, column = _spread(own & (obj.shows | ~known), rng)
        local = np.stack([(column - k.cx_px) / k.fx_px, (row - k.cy_px) / k.fy_px, np.ones(len(row))], -1)
        points_m = self._expected_m(obj)
        people, sides = self._people, self._edges.within(own)
        sigma = max(self._depth.object_sigma.get(str(found.object_id), _MIN_DISTANCE_SIGMA), _MIN_DISTANCE_SIGMA)
        here = self._may_have_rested(points_m, sigma)
        evidence = ObjectEvidence(
            camera_m=lifter.view.T_world_camera[:3, 3].copy(),
            T_camera_world=invert_rigid(lifter.view.T_world_camera),
            intrinsics=k,
            rays=local @ lifter.view.T_world_camera[:3, :3].T,
            depth_m=np.where(obj.shows[row, column], obj.depth_m[row, column], np.nan),
            outside_px=outside,
            free_m=np.where(own & known, obj.depth_m, 0.0),
            size_px=float(np.sqrt(own.sum())),
            depth_errors=self._depth_errors,
            distance_sigma=sigma,
            raised=self._is_raised(own, points_m, nearer),
            rested=people.rested.only(here),
            body_m=people.body_m[_within(people.body_m, points_m, _AROUND_M)],
            others_m=self._others_m(own, points_m, rng),
            sides=sides,
            walls=self._walls if sides is None else None,
        )
        return SeenObject(evidence, points_m, self._normals[obj.shows], own, outline)

    def _may_have_rested(self, points_m: Float[np.ndarray, "points 3"], sigma: float) -> Bool[np.ndarray, "rests"]:
        """What rested at places of which most is near the object: where it is seen, or as far away as it may be if the
        part bears weight. Hands and backs are also still in the air."""
        camera_m, rested = self._lifter.view.T_world_camera[:3, 3], self._people.rested
        nearest = -_FARTHEST * sigma - self._depth_errors.open_bias
        near = _within(rested.point_m, points_m, _NEAR_M)
        for factor in np.exp(np.linspace(nearest, _FARTHEST * sigma, _DISTANCES)):
            near |= rested.bears & _within(rested.point_m, camera_m + factor * (points_m - camera_m), _NEAR_M)
        _, place = np.unique(rested.place, return_inverse=True)
        return (np.bincount(place, near) > 0.5 * np.bincount(place))[place]

    def _expected_m(self, obj: BackprojectedObject) -> Float[np.ndarray, "points 3"]:
        """Its depth points in the world, with the mean relief of objects."""
        camera_m, log_depth = self._lifter.view.T_world_camera[:3, 3], np.log(obj.depth_m[obj.shows])
        change = np.exp((self._depth_errors.relief - 1) * (log_depth - np.median(log_depth)))
        return camera_m + change[:, None] * (self._world_m[obj.shows] - camera_m)

    def _others_m(
        self, own: np.ndarray, points_m: np.ndarray, rng: np.random.Generator
    ) -> Float[np.ndarray, "others 3"]:
        """Seen points around the object that are not its own, nor the floor's."""
        near = self._lifter.known & ~own & ~self._lifter.floor & (self._world_m[..., 1] > _OFF_FLOOR_M)
        near &= _within(self._world_m, points_m, _AROUND_M)
        return self._world_m[_spread(near, rng)]

    def _outline(self, found: CompletedObject, obj: BackprojectedObject) -> Bool[np.ndarray, "h w"]:
        """Where the object is, hidden or not."""
        allowed = shrunk(found.amodal_mask, obj.own.shape) | obj.own
        # Between a mask's pixels, what is seen to be background does not belong to the object.
        return allowed & (~(obj.own & self._lifter.known & ~obj.shows) | self._foot(obj))

    def _foot(self, obj: BackprojectedObject) -> Bool[np.ndarray, "height width"]:
        """What is too low to be told from the floor by depth, right below what shows the object."""
        distance_m = np.linalg.norm(self._world_m - self._lifter.view.T_world_camera[:3, 3], axis=-1)
        low = self._world_m[..., 1] < floor_band_m(distance_m)
        away_m = np.median(distance_m[obj.shows])
        down_px = int(np.ceil(floor_band_m(away_m) / away_m * self._lifter.view.intrinsics.fy_px))
        below = cv2.dilate(obj.shows.astype(np.uint8), np.ones((down_px + 1, 1), np.uint8), anchor=(0, down_px))
        return obj.own & low & (below > 0)

    def _nearer(self, object_id: int) -> Bool[np.ndarray, "height width"]:
        """Pixels of objects that are nearer to the camera."""
        hides = np.zeros(self._lifter.known.shape, bool)
        for number, other in self._lifted.items():
            if number != object_id and self._distance_m[number] < self._distance_m[object_id]:
                hides |= other.own
        return hides

    def _is_raised(self, own: np.ndarray, points_m: np.ndarray, nearer: np.ndarray) -> bool:
        """Whether it ends high above the floor, though nothing hides its lower end and the picture shows no floor
        there."""
        if np.percentile(points_m[:, 1], 2) < _RAISED_M:
            return False
        rows, columns = np.flatnonzero(own.any(1)), np.flatnonzero(own.any(0))
        below = len(own) + 1 - np.argmax(own[::-1, columns], axis=0)
        lowest = below - 2 >= rows[-1] - _LOWER_END * (rows[-1] - rows[0])
        columns, below = columns[lowest], below[lowest]
        inside = below < len(own)
        at, end = (np.minimum(below, len(own) - 1), columns), (np.minimum(below, len(own)) - 2, columns)
        depth_m, up_m = self._depth.background_depth_m, self._world_m[..., 1]
        carries = (depth_m[at] > (1 - _STEP) * depth_m[end]) & (up_m[at] < up_m[end] + _STEP_M)
        hidden = self._unseen[at] | (nearer[at] & ~carries)
        sigmas = FitSigmas()
        reach_px = int(_REACH * np.hypot(sigmas.outline_px, sigmas.outline_share * np.sqrt(own.sum())))
        floor = cv2.dilate(self._lifter.floor.astype(np.uint8), np.ones((reach_px + 1, 1), np.uint8), anchor=(0, 0)) > 0
        return bool((inside & ~hidden & ~floor[at]).mean() > 0.5)


def _within(
    some_m: Float[np.ndarray, "... 3"], points_m: Float[np.ndarray, "points 3"], margin_m: float
) -> Bool[np.ndarray, "..."]:
    """Which are in the box around points with a margin."""
    return ((some_m > points_m.min(0) - margin_m) & (some_m < points_m.max(0) + margin_m)).all(-1)


def _spread(mask: Bool[np.ndarray, "h w"], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of one pixel of each cell of a grid of about `_POINTS` cells.

    Averages over them vary less than those over pixels drawn from the whole mask.
    """
    row, column = np.nonzero(mask)
    step = max(1.0, float(np.sqrt(len(row) / _POINTS)))
    order, offset = rng.permutation(len(row)), rng.uniform(0, step, 2)
    cell = np.stack([(row[order] + offset[0]) // step, (column[order] + offset[1]) // step])
    _, first = np.unique(cell, axis=1, return_index=True)
    return row[order[first]], column[order[first]]


def _outside_px(allowed: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance of pixels from where the object may be."""
    closed = cv2.morphologyEx(allowed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return cv2.distanceTransform(1 - closed, cv2.DIST_L2, 5).astype(np.float64)
