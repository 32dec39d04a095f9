"""Collision resolution: objects rest on each other and do not overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from video2anim.geometry.sdf import SdfGrid, build_sdf_grid, surface_samples
from video2anim.types.scene import Mesh

_SAMPLE_M = 0.04
"""Spacing of the surface points that are tested, besides inner points."""
_MAX_SHIFT_M = 0.3
"""Maximum displacement of an object."""
_ROUNDS = 12
_DIRECTIONS = 12
"""Number of horizontal directions that are tested."""
_STEPS_M = (0.04, 0.08, 0.12, 0.17, 0.23, 0.3, 0.4, 0.5, 0.6)
"""Distances tested along each, up to the sum of both maximum displacements."""
_FREER = 0.8
"""Another direction is used only if its distance is below this share of that along the gradient."""
_MAX_POINTS = 600
"""Points of each object for testing directions."""
_SAME_SHARE = 0.6
"""Mutual overlap from which two objects are duplicates of one."""
UNDER_M = 0.25
"""Maximum vertical displacement to rest on what is below."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSolid:
    """One object in the world."""

    mesh: Mesh
    """World coordinates."""
    sigma_m: float
    """Standard deviation of its position; of two that overlap the less certain one moves more."""
    raised: bool = False
    """Whether it rests on something other than the floor."""


@dataclass(frozen=True, slots=True, eq=False)
class ResolvedPlacement:
    """Displacement of an object, and the overlap that is left."""

    shift_m: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    rests_on: int | None = None
    """Number of the object under it."""
    overlap_before_m: float = 0.0
    """Deepest point inside another object."""
    overlap_after_m: float = 0.0
    inside_of: int | None = None
    """Number of the object that it still overlaps most."""


def resolve_collisions(objects: Sequence[PlacedSolid], tolerance_m: float = 0.03) -> list[ResolvedPlacement]:
    """Put raised objects onto what is under them, then separate those that overlap by more than the tolerance.

    Objects move horizontally, away from each other, each in proportion to the variance of its place.
    """
    done = [ResolvedPlacement() for _ in objects]
    lowest = [float(item.mesh.vertices_m[:, 1].min()) if len(item.mesh.vertices_m) else 0.0 for item in objects]
    for number in np.argsort(lowest):
        if objects[number].raised:
            done[number] = _put_down(int(number), objects, done)
    pairs = [pair for pair in _pairs(objects, done) if not _stacked(pair, done)]
    at_first = [pair.depth(done)[0] for pair in pairs]
    for pair in pairs:
        depth_m, _ = pair.depth(done)
        done[pair.one] = replace(done[pair.one], overlap_before_m=max(done[pair.one].overlap_before_m, depth_m))
        done[pair.other] = replace(done[pair.other], overlap_before_m=max(done[pair.other].overlap_before_m, depth_m))
    # Duplicates of one object stay where they are and are reported.
    apart = [pair for pair in pairs if not pair.is_same_object(done)]
    for _ in range(_ROUNDS):
        moved = False
        for pair in apart:
            depth_m, away = pair.depth(done)
            if depth_m <= tolerance_m:
                continue
            away = pair.way_out(done, away, tolerance_m)
            one, other = objects[pair.one].sigma_m ** 2, objects[pair.other].sigma_m ** 2
            share = one / max(one + other, 1e-12) if one + other > 0 else 0.5
            step = away * (0.7 * depth_m)
            moved |= _move(done, pair.one, share * step) | _move(done, pair.other, -(1 - share) * step)
        if not moved:
            break
    _undo_useless(pairs, at_first, done, tolerance_m)
    _carry_along(done)
    for pair in pairs:
        depth_m, _ = pair.depth(done)
        if depth_m > tolerance_m:
            for number, partner in ((pair.one, pair.other), (pair.other, pair.one)):
                if depth_m > done[number].overlap_after_m:
                    done[number] = replace(done[number], overlap_after_m=depth_m, inside_of=partner)
    return done


def _stacked(pair: _Pair, done: Sequence[ResolvedPlacement]) -> bool:
    return done[pair.one].rests_on == pair.other or done[pair.other].rests_on == pair.one


def _undo_useless(
    pairs: Sequence[_Pair], at_first: Sequence[float], done: list[ResolvedPlacement], tolerance_m: float
) -> None:
    """Objects whose overlap did not shrink by at least 30 % are moved back."""
    for pair, before_m in zip(pairs, at_first, strict=True):
        after_m, _ = pair.depth(done)
        if after_m > max(tolerance_m, 0.7 * before_m):
            for number in (pair.one, pair.other):
                done[number] = replace(done[number], shift_m=done[number].shift_m * np.array([0.0, 1.0, 0.0]))


def _carry_along(done: list[ResolvedPlacement]) -> None:
    """Objects move with what they rest on."""
    for number, state in enumerate(done):
        under, seen = state.rests_on, {number}
        while under is not None and under not in seen:
            flat_m = done[under].shift_m * np.array([1.0, 0.0, 1.0])
            done[number] = replace(done[number], shift_m=done[number].shift_m + flat_m)
            seen.add(under)
            under = done[under].rests_on


@dataclass(frozen=True, slots=True, eq=False)
class _Solid:
    """An object at its initial place."""

    field: SdfGrid
    points_m: np.ndarray
    """On its surface and within."""
    inner_m: np.ndarray
    """Those within."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two objects that may overlap, by number."""

    one: int
    other: int
    first: _Solid
    second: _Solid

    def is_same_object(self, done: list[ResolvedPlacement]) -> bool:
        """Whether both are mostly inside each other."""
        apart_m = done[self.one].shift_m - done[self.other].shift_m
        if not len(self.first.inner_m) or not len(self.second.inner_m):
            return False
        one = (self.second.field.sample(self.first.inner_m + apart_m) < 0).mean()
        other = (self.first.field.sample(self.second.inner_m - apart_m) < 0).mean()
        return bool(min(one, other) > _SAME_SHARE)

    def depth(self, done: list[ResolvedPlacement]) -> tuple[float, np.ndarray]:
        """Deepest point of one in the other, and the horizontal way out for `one`."""
        apart_m = done[self.one].shift_m - done[self.other].shift_m
        deep_one, way_one = _deepest(self.second.field, self.first.points_m + apart_m)
        deep_other, way_other = _deepest(self.first.field, self.second.points_m - apart_m)
        away = deep_one * way_one - deep_other * way_other
        length = float(np.linalg.norm(away))
        if length < 1e-6:
            away = (self.first.points_m.mean(0) + apart_m - self.second.points_m.mean(0)) * np.array([1.0, 0.0, 1.0])
            length = max(float(np.linalg.norm(away)), 1e-6)
        return max(deep_one, deep_other), away / length

    def way_out(self, done: list[ResolvedPlacement], away: np.ndarray, tolerance_m: float) -> np.ndarray:
        """The horizontal direction in which `one` leaves: `away`, unless another is clearly shorter.

        `away` may point inward where one object reaches through the edge of the other.
        """
        apart_m = done[self.one].shift_m - done[self.other].shift_m
        one_m = _some_near(self.first.points_m + apart_m, self.second.field)
        other_m = _some_near(self.second.points_m - apart_m, self.first.field)

        def length_m(way: np.ndarray) -> float:
            for step_m in _STEPS_M:
                deep_m = max(
                    _depth(self.second.field, one_m + step_m * way), _depth(self.first.field, other_m - step_m * way)
                )
                if deep_m <= tolerance_m:
                    return step_m
            return np.inf

        usual_m = length_m(away)
        if usual_m <= _STEPS_M[1]:
            return away
        angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        around = np.stack([np.cos(angle), np.zeros(_DIRECTIONS), np.sin(angle)], -1)
        lengths_m = np.array([length_m(way) for way in around])
        # Among equally short directions the one closest to `away`.
        best = np.lexsort((-(around @ away), lengths_m))[0]
        return around[best] if lengths_m[best] < _FREER * usual_m else away


def _some_near(points_m: np.ndarray, solid: SdfGrid) -> np.ndarray:
    """At most `_MAX_POINTS` of those that may be inside once the objects have moved."""
    near = points_m[solid.sample(points_m) < _STEPS_M[-1]]
    return near[np.linspace(0, len(near) - 1, min(len(near), _MAX_POINTS)).round().astype(int)]


def _depth(solid: SdfGrid, points_m: np.ndarray) -> float:
    return max(0.0, float(-solid.sample(points_m).min(initial=np.inf)))


def _deepest(solid: SdfGrid, points_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Depth of the deepest point, and the mean horizontal way to the surface from all points inside."""
    inside_m = -solid.sample(points_m)
    within = inside_m > 0
    if not within.any():
        return 0.0, np.zeros(3)
    at, h = points_m[within], 0.5 * solid.spacing_m
    way = np.zeros((len(at), 3))
    for axis in (0, 2):
        step = np.eye(3)[axis] * h
        way[:, axis] = solid.sample(at + step) - solid.sample(at - step)
    mean = (way * inside_m[within, None]).sum(0)
    return float(inside_m.max()), mean / max(float(np.linalg.norm(mean)), 1e-9)


def _pairs(objects: Sequence[PlacedSolid], done: Sequence[ResolvedPlacement]) -> list[_Pair]:
    bounds = [_bounds(item.mesh, state.shift_m) for item, state in zip(objects, done, strict=True)]
    near = [
        (i, j)
        for i in range(len(objects))
        for j in range(i)
        if bounds[i] is not None and bounds[j] is not None and _meet(bounds[i], bounds[j])
    ]
    fields: dict[int, _Solid] = {}
    for number in {k for pair in near for k in pair}:
        own = bounds[number]
        assert own is not None
        own_m = own - done[number].shift_m
        margin = _MAX_SHIFT_M + 0.1
        spacing_m = max(0.02, float(np.ptp(own_m, axis=0).max()) / 40)
        grid_bounds = np.stack([own_m[0] - margin, own_m[1] + margin])
        grid = build_sdf_grid([objects[number].mesh], grid_bounds, spacing_m, floor_y_m=None)
        triangles_m = objects[number].mesh.vertices_m.astype(np.float64)[objects[number].mesh.faces]
        # Inner points besides: the surface of a duplicate lies on that of the other.
        inner_m = _inner_points(grid)
        points_m = np.concatenate([surface_samples(triangles_m, _SAMPLE_M)[0], inner_m])
        fields[number] = _Solid(grid, points_m, inner_m)
    return [_Pair(i, j, fields[i], fields[j]) for i, j in near]


def _inner_points(grid: SdfGrid) -> Float[np.ndarray, "points 3"]:
    """Nodes of a field that are inside, thinned to about `_MAX_POINTS`."""
    inside = np.argwhere(grid.sdf_m < 0)
    step = max(1, len(inside) // _MAX_POINTS)
    return grid.origin_m + grid.spacing_m * inside[::step]


def _bounds(mesh: Mesh, shift_m: np.ndarray) -> Float[np.ndarray, "2 3"] | None:
    if not len(mesh.faces):
        return None
    return np.stack([mesh.vertices_m.min(0), mesh.vertices_m.max(0)]).astype(np.float64) + shift_m


def _meet(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    """Whether two boxes overlap or may overlap after moving."""
    reach = 2 * _MAX_SHIFT_M * np.array([1.0, 0.0, 1.0])
    return a is not None and b is not None and bool((a[0] < b[1] + reach).all() and (b[0] < a[1] + reach).all())


def _move(done: list[ResolvedPlacement], number: int, step_m: np.ndarray) -> bool:
    """Move one object within the limit; whether it moved."""
    before = done[number].shift_m
    flat = (before + step_m) * np.array([1.0, 0.0, 1.0])
    length = float(np.linalg.norm(flat))
    flat = flat * min(1.0, _MAX_SHIFT_M / max(length, 1e-9))
    after = np.array([flat[0], before[1], flat[2]])
    if np.linalg.norm(after - before) < 1e-4:
        return False
    done[number] = replace(done[number], shift_m=after)
    return True


def _put_down(number: int, objects: Sequence[PlacedSolid], done: Sequence[ResolvedPlacement]) -> ResolvedPlacement:
    """The object on the highest surface under its footprint near its lower end."""
    import trimesh

    vertices_m = objects[number].mesh.vertices_m.astype(np.float64)
    if not len(vertices_m):
        return ResolvedPlacement()
    low, high = vertices_m.min(0), vertices_m.max(0)
    center, half = 0.5 * (low + high), 0.3 * (high - low)
    starts = np.array([[center[0] + a * half[0], low[1] + UNDER_M, center[2] + b * half[2]]
                       for a in (-1, 0, 1) for b in (-1, 0, 1)])  # fmt: skip
    best, under = -np.inf, None
    for other, item in enumerate(objects):
        if other == number or not len(item.mesh.faces):
            continue
        mesh = trimesh.Trimesh(item.mesh.vertices_m + done[other].shift_m, item.mesh.faces, process=False)
        hits, _, faces = mesh.ray.intersects_location(
            starts, np.tile([0.0, -1.0, 0.0], (len(starts), 1)), multiple_hits=False
        )
        hits = hits[mesh.face_normals[faces, 1] > 0.5]
        if len(hits) >= 0.3 * len(starts):
            top_m = float(np.median(hits[:, 1]))
            if abs(top_m - low[1]) <= UNDER_M and top_m > best:
                best, under = top_m, other
    if under is None:
        return ResolvedPlacement()
    return ResolvedPlacement(shift_m=np.array([0.0, best - low[1], 0.0]), rests_on=under)
