"""Shapes of the solids that forms are made of: box, upright cylinder, and a polygon with a thickness.

A shape fills the cube from -1 to 1; a solid stretches it to its half extents. All functions take many solids of one
shape at once: coordinates (batch, parts, n) along the axes of every solid, from its center, and half extents
(batch, parts, 3, 1).
"""

from __future__ import annotations

import functools
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from mapbox_earcut import triangulate_float64

Axes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""x, y, z."""
UnitMesh = tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]
FLAT = 1e-9
"""Keeps rays along a side from dividing by nothing."""
_SEGMENTS = 24
"""Sides of a round mesh."""


@runtime_checkable
class Shape(Protocol):
    """What a solid asks of its shape."""

    def signed_m(self, own: Axes, half_m: np.ndarray) -> Float[np.ndarray, "batch parts n"]:
        """Signed distance of points, negative inside."""
        ...

    def spans(self, start: Axes, along: Axes, half_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays enter and leave each convex piece, (batch, pieces, n); they leave before they enter what they
        miss."""
        ...

    def lattice(self, per_side: int) -> Float[np.ndarray, "*batch points 3"]:
        """per_side^3 - (per_side - 2)^3 points of the surface."""
        ...

    def mesh(self) -> UnitMesh:
        """A closed surface; of the first of a batch, where the shape itself has one."""
        ...


class Cube:
    """The cube itself."""

    def signed_m(self, own: Axes, half_m: np.ndarray) -> np.ndarray:
        """Exact."""
        x, y, z = (np.abs(part) - half_m[:, :, k] for k, part in enumerate(own))
        inside = np.minimum(np.maximum(np.maximum(x, y), z), 0)
        return np.sqrt(np.maximum(x, 0) ** 2 + np.maximum(y, 0) ** 2 + np.maximum(z, 0) ** 2) + inside

    def spans(self, start: Axes, along: Axes, half_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Between three pairs of sides."""
        sides = [_between(start[k], along[k], half_m[:, :, k]) for k in range(3)]
        enter = np.maximum(np.maximum(sides[0][0], sides[1][0]), sides[2][0])
        return enter, np.minimum(np.minimum(sides[0][1], sides[1][1]), sides[2][1])

    def lattice(self, per_side: int) -> np.ndarray:
        """Of the cube."""
        return _lattice(per_side)

    def mesh(self) -> UnitMesh:
        """12 faces."""
        import trimesh

        box = trimesh.creation.box(extents=(2, 2, 2))
        return box.vertices, box.faces


class Cylinder:
    """Upright; its half extents along x and z are the same."""

    def signed_m(self, own: Axes, half_m: np.ndarray) -> np.ndarray:
        """Exact."""
        aside, y = np.sqrt(own[0] ** 2 + own[2] ** 2) - half_m[:, :, 0], np.abs(own[1]) - half_m[:, :, 1]
        return np.sqrt(np.maximum(aside, 0) ** 2 + np.maximum(y, 0) ** 2) + np.minimum(np.maximum(aside, y), 0)

    def spans(self, start: Axes, along: Axes, half_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Between the ends and within the circle."""
        low, high = _between(start[1], along[1], half_m[:, :, 1])
        enter, leave = _within((start[0], start[2]), (along[0], along[2]), half_m[:, :, 0] ** 2)
        return np.maximum(enter, low), np.minimum(leave, high)

    def lattice(self, per_side: int) -> np.ndarray:
        """Squares to circles, ring by ring."""
        points = _lattice(per_side).copy()
        across = np.maximum(np.abs(points[:, [0, 2]]).max(1), FLAT)
        points[:, [0, 2]] *= (across / np.maximum(np.hypot(points[:, 0], points[:, 2]), FLAT))[:, None]
        return points

    def mesh(self) -> UnitMesh:
        """96 faces."""
        import trimesh

        upright = trimesh.creation.cylinder(1.0, 2.0, sections=_SEGMENTS)
        # Its axis is z; cyclic exchange of the axes keeps outsides outside.
        return upright.vertices[:, [1, 2, 0]], upright.faces


class Prism:
    """A polygon across x and y, with a thickness along z."""

    def __init__(
        self, corners: Float[np.ndarray, "batch corners 2"], triangles: Int[np.ndarray, "triangles 3"] | None = None
    ) -> None:
        """Corners run counter-clockwise and fill the square from -1 to 1. `triangles`: those of the polygon, if they
        are known."""
        self.corners = corners
        self.triangles = triangulated(corners[0]) if triangles is None else triangles

    def signed_m(self, own: Axes, half_m: np.ndarray) -> np.ndarray:
        """Exact."""
        corners_m = self.corners[:, :, :, None] * half_m[:, :, :2]
        x, y = own[0], own[1]
        nearest, inside = np.full(x.shape, np.inf), np.zeros(x.shape, bool)
        for k in range(corners_m.shape[1]):
            ax, ay = (corners_m[:, k, axis, None] for axis in (0, 1))
            bx, by = (corners_m[:, k - 1, axis, None] for axis in (0, 1))
            ex, ey, px, py = bx - ax, by - ay, x - ax, y - ay
            t = np.clip((px * ex + py * ey) / np.maximum(ex**2 + ey**2, FLAT**2), 0, 1)
            nearest = np.minimum(nearest, (px - t * ex) ** 2 + (py - t * ey) ** 2)
            # Counted are the edges that a line towards +x crosses.
            steep = np.where(np.abs(ey) < FLAT, FLAT, ey)
            inside ^= ((ay > y) != (by > y)) & (px < ex * py / steep)
        aside = np.where(inside, -1.0, 1.0) * np.sqrt(nearest)
        deep = np.abs(own[2]) - half_m[:, :, 2]
        return np.sqrt(np.maximum(aside, 0) ** 2 + np.maximum(deep, 0) ** 2) + np.minimum(np.maximum(aside, deep), 0)

    def spans(self, start: Axes, along: Axes, half_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Between front and rear and within each triangle."""
        corners_m = (self.corners * half_m[:, 0, :2, 0][:, None])[:, self.triangles]
        edge = np.roll(corners_m, -1, 2) - corners_m
        # Towards the inside, also where a fit has turned a triangle over.
        turn = edge[:, :, 0, 0] * edge[:, :, 1, 1] - edge[:, :, 0, 1] * edge[:, :, 1, 0]
        inward = np.stack([-edge[..., 1], edge[..., 0]], -1) * np.where(turn < 0, -1.0, 1.0)[:, :, None, None]
        enter, leave = _between(start[2], along[2], half_m[:, :, 2])
        for k in range(3):
            nx, ny = (inward[:, :, k, axis, None] for axis in (0, 1))
            cx, cy = (corners_m[:, :, k, axis, None] for axis in (0, 1))
            rate = nx * along[0] + ny * along[1]
            rate = np.where(np.abs(rate) < FLAT, np.where(rate < 0, -FLAT, FLAT), rate)
            at = -(nx * (start[0] - cx) + ny * (start[1] - cy)) / rate
            enter = np.where(rate > 0, np.maximum(enter, at), enter)
            leave = np.where(rate < 0, np.minimum(leave, at), leave)
        return enter, leave

    def lattice(self, per_side: int) -> np.ndarray:
        """Steps along the border, from front to rear, and points of front and rear within."""
        ring, inner = (w @ self.corners for w in _spread(self._key(), per_side))
        depth = np.linspace(-1, 1, per_side)
        layers = [_at_depth(ring, z) for z in depth] + [_at_depth(inner, z) for z in (-1.0, 1.0)]
        return np.concatenate(layers, 1)

    def _key(self) -> tuple[int, tuple[tuple[int, ...], ...]]:
        return self.corners.shape[1], tuple(tuple(int(k) for k in row) for row in self.triangles)

    def mesh(self) -> UnitMesh:
        """Two faces for each triangle and for each side."""
        import trimesh

        prism = trimesh.creation.extrude_triangulation(self.corners[0], self.triangles, 2.0)
        return prism.vertices - [0.0, 0.0, 1.0], prism.faces


def triangulated(corners: Float[np.ndarray, "corners 2"]) -> Int[np.ndarray, "triangles 3"]:
    """Counter-clockwise triangles of a polygon."""
    found = triangulate_float64(np.ascontiguousarray(corners), np.array([len(corners)], np.uint32))
    return found.reshape(-1, 3).astype(int)


def _between(start: np.ndarray, along: np.ndarray, half_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave what is between two sides."""
    steep = np.where(np.abs(along) < FLAT, np.where(along < 0, -FLAT, FLAT), along)
    first, second = (-half_m - start) / steep, (half_m - start) / steep
    return np.minimum(first, second), np.maximum(first, second)


def _within(
    start: tuple[np.ndarray, ...], along: tuple[np.ndarray, ...], square: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave a circle of this squared radius."""
    length = np.maximum(sum(part**2 for part in along), FLAT**2)
    nearest = -sum(a * b for a, b in zip(start, along, strict=True)) / length
    inner = square - sum((a + nearest * b) ** 2 for a, b in zip(start, along, strict=True))
    reach = np.sign(inner) * np.sqrt(np.abs(inner) / length)
    return nearest - reach, nearest + reach


@functools.cache
def _lattice(per_side: int) -> np.ndarray:
    """Points on the sides of the cube from -1 to 1."""
    steps = np.linspace(-1, 1, per_side)
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    sides = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            points = np.empty((len(a), 3))
            points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = side, a, b
            sides.append(points)
    return np.unique(np.round(np.concatenate(sides), 9), axis=0)


def _at_depth(flat: np.ndarray, z: float) -> np.ndarray:
    return np.concatenate([flat, np.full((*flat.shape[:2], 1), z)], -1)


@functools.cache
def _spread(key: tuple[int, tuple[tuple[int, ...], ...]], per_side: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the border and inside of a polygon, as many as a cube's lattice has in a ring and within a side: their
    shares of the corners."""
    corners, triangles = key
    step = np.arange(4 * (per_side - 1)) * corners / (4 * (per_side - 1))
    first, on = step.astype(int), step % 1.0
    ring = np.zeros((len(step), corners))
    np.add.at(ring, (np.arange(len(step)), first), 1 - on)
    np.add.at(ring, (np.arange(len(step)), (first + 1) % corners), on)
    inner = np.zeros(((per_side - 2) ** 2, corners))
    weight = np.random.default_rng(0).dirichlet(np.ones(3), len(inner))
    for k, row in enumerate(inner):
        row[list(triangles[k % len(triangles)])] = weight[k]
    return ring, inner


CUBE, CYLINDER = Cube(), Cylinder()
WEDGE = Prism(np.array([[[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]]]))
"""A slope that falls towards +x."""
