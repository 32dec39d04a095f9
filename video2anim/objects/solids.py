"""Boxes and upright cylinders, many sets of them at once: distances, rays, surface points, meshes.

A set is what one guess of an object's sizes gives; a fit compares a batch of guesses. All in the object's frame: +Y up,
resting on y = 0, front towards +Z.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_Axes = tuple[np.ndarray, np.ndarray, np.ndarray]
_FLAT = 1e-9
"""Keeps rays along a side from dividing by nothing."""
_SEGMENTS = 24
"""Sides of a cylinder's mesh."""


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """A batch of sets of `parts` solids each."""

    center_m: Float[np.ndarray, "batch parts 3"]
    half_m: Float[np.ndarray, "batch parts 3"]
    """Half extents; of a cylinder x is the radius and z is not used."""
    tilt_rad: Float[np.ndarray, "batch parts"]
    """Turn about the object's x axis through the solid's center: positive leans its top towards -Z."""
    round: Bool[np.ndarray, "parts"]
    """Which are upright cylinders."""

    def _own(self, v: np.ndarray) -> _Axes:
        """Vectors (batch, n, 3) along the axes of every solid: x, y, z of shape (batch, parts, n)."""
        c, s = np.cos(self.tilt_rad)[..., None], np.sin(self.tilt_rad)[..., None]
        x, y, z = (v[:, None, :, k] for k in range(3))
        if not self.tilt_rad.any():
            return x, y, z
        return x, c * y - s * z, s * y + c * z

    def _from_center(self, points_m: np.ndarray) -> _Axes:
        x, y, z = self._own(points_m)
        u, v, w = (part[..., 0] for part in self._own_center())
        return x - u[..., None], y - v[..., None], z - w[..., None]

    def _own_center(self) -> _Axes:
        c, s = np.cos(self.tilt_rad)[..., None], np.sin(self.tilt_rad)[..., None]
        x, y, z = (self.center_m[..., k, None] for k in range(3))
        return x, c * y - s * z, s * y + c * z

    def distance_m(self, points_m: Float[np.ndarray, "batch points 3"]) -> Float[np.ndarray, "batch parts points"]:
        """Signed distance to every solid, negative inside."""
        return self._signed(self._from_center(points_m))

    def miss_m(
        self, origin_m: Float[np.ndarray, "batch 3"], ray: Float[np.ndarray, "batch rays 3"]
    ) -> Float[np.ndarray, "batch rays"]:
        """About how far each ray passes the nearest solid; 0 for rays that hit one.

        The point looked at is the middle between entering and leaving, which is inside if and only if the ray hits. Of
        a ray along a side both may be far away; no point of the solid is farther along the ray than its extent.
        """
        start, along = self._from_center(origin_m[:, None]), self._own(ray)
        enter, leave = self._spans(start, along)
        square = sum(part**2 for part in along)
        beside = -sum(a * b for a, b in zip(start, along, strict=True)) / square
        half = self.half_m[:, :, :, None]
        deep = np.where(self.round[:, None], half[:, :, 0], half[:, :, 2])
        across = np.abs(along[0]) * half[:, :, 0] + np.abs(along[2]) * deep
        extent = (across + np.abs(along[1]) * half[:, :, 1]) / square
        center = np.clip(0.5 * (enter + leave), beside - extent, beside + extent)
        x, y, z = (a + center * b for a, b in zip(start, along, strict=True))
        return np.maximum(self._signed((x, y, z)), 0).min(1)

    def first_hit(
        self, origin_m: Float[np.ndarray, "batch 3"], ray: Float[np.ndarray, "batch rays 3"]
    ) -> Float[np.ndarray, "batch rays"]:
        """Where along each ray (in its lengths) it enters a solid; infinite where it hits none."""
        enter, leave = self._spans(self._from_center(origin_m[:, None]), self._own(ray))
        return np.where((enter <= leave) & (enter > 0), enter, np.inf).min(1)

    def _signed(self, own: _Axes) -> np.ndarray:
        """Signed distance of points that are given from the solids' centers, along their axes."""
        half = self.half_m[:, :, :, None]
        x, y, z = (np.abs(part) - half[:, :, k] for k, part in enumerate(own))
        inside = np.minimum(np.maximum(np.maximum(x, y), z), 0)
        box = np.sqrt(np.maximum(x, 0) ** 2 + np.maximum(y, 0) ** 2 + np.maximum(z, 0) ** 2) + inside
        if not self.round.any():
            return box
        aside = np.sqrt(own[0] ** 2 + own[2] ** 2) - half[:, :, 0]
        disk = np.sqrt(np.maximum(aside, 0) ** 2 + np.maximum(y, 0) ** 2) + np.minimum(np.maximum(aside, y), 0)
        return np.where(self.round[None, :, None], disk, box)

    def _spans(self, start: _Axes, along: _Axes) -> tuple[np.ndarray, np.ndarray]:
        """Where rays enter and leave: a box is between its three pairs of sides, a cylinder between its ends and within
        its circle. They leave before they enter what they miss."""
        half = self.half_m[:, :, :, None]
        low, high = [], []
        for axis in range(3):
            steep = np.where(np.abs(along[axis]) < _FLAT, np.where(along[axis] < 0, -_FLAT, _FLAT), along[axis])
            first, second = (-half[:, :, axis] - start[axis]) / steep, (half[:, :, axis] - start[axis]) / steep
            low.append(np.minimum(first, second))
            high.append(np.maximum(first, second))
        enter = np.maximum(np.maximum(low[0], low[1]), low[2])
        leave = np.minimum(np.minimum(high[0], high[1]), high[2])
        if not self.round.any():
            return enter, leave
        square = np.maximum(along[0] ** 2 + along[2] ** 2, _FLAT**2)
        nearest = -(start[0] * along[0] + start[2] * along[2]) / square
        apart = (start[0] + nearest * along[0]) ** 2 + (start[2] + nearest * along[2]) ** 2
        inner = half[:, :, 0] ** 2 - apart
        reach = np.sign(inner) * np.sqrt(np.abs(inner) / square)
        round_ = self.round[None, :, None]
        enter = np.where(round_, np.maximum(nearest - reach, low[1]), enter)
        return enter, np.where(round_, np.minimum(nearest + reach, high[1]), leave)

    def surface_points_m(self, per_side: int) -> Float[np.ndarray, "batch points 3"]:
        """The same lattice of points on the sides of every solid, per_side^2 on each side."""
        lattice = _lattice(per_side)
        round_ = lattice.copy()
        across = np.maximum(np.abs(lattice[:, [0, 2]]).max(1), _FLAT)
        length = np.maximum(np.hypot(lattice[:, 0], lattice[:, 2]), _FLAT)
        # Squares to circles, ring by ring.
        round_[:, [0, 2]] *= (across / length)[:, None]
        unit = np.where(self.round[:, None, None], round_, lattice)
        half = np.where(self.round[:, None], self.half_m[..., [0, 1, 0]], self.half_m)
        own = unit[None] * half[:, :, None]
        c, s = np.cos(self.tilt_rad)[..., None], np.sin(self.tilt_rad)[..., None]
        turned = np.stack([own[..., 0], c * own[..., 1] + s * own[..., 2], -s * own[..., 1] + c * own[..., 2]], -1)
        return (turned + self.center_m[:, :, None]).reshape(len(turned), -1, 3)

    def meshes(self) -> list[tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]]:
        """A closed surface for every solid of the first set: 12 faces of a box, 96 of a cylinder."""
        made = []
        for k in range(self.half_m.shape[1]):
            vertices, faces = _CYLINDER if self.round[k] else _BOX
            c, s = np.cos(self.tilt_rad[0, k]), np.sin(self.tilt_rad[0, k])
            turn = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
            half = self.half_m[0, k, [0, 1, 0]] if self.round[k] else self.half_m[0, k]
            made.append(((vertices * half) @ turn.T + self.center_m[0, k], faces))
        return made


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


def _unit_box() -> tuple[np.ndarray, np.ndarray]:
    """From -1 to 1; corner 4 i + 2 j + k has x, y, z high where i, j, k are 1."""
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), -1).reshape(-1, 3)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _unit_cylinder() -> tuple[np.ndarray, np.ndarray]:
    """Radius 1, y from -1 to 1."""
    angle = 2 * np.pi * np.arange(_SEGMENTS) / _SEGMENTS
    ring = np.stack([np.sin(angle), np.zeros(_SEGMENTS), np.cos(angle)], -1)
    up = np.array([0.0, 1.0, 0.0])
    vertices = np.concatenate([ring - up, ring + up, [-up, up]])
    a = np.arange(_SEGMENTS)
    b = np.roll(a, -1)
    c, d, low, high = b + _SEGMENTS, a + _SEGMENTS, np.full_like(a, 2 * _SEGMENTS), np.full_like(a, 2 * _SEGMENTS + 1)
    faces = [np.stack(corners, -1) for corners in ((a, b, c), (a, c, d), (b, a, low), (d, c, high))]
    return vertices, np.concatenate(faces)


_BOX, _CYLINDER = _unit_box(), _unit_cylinder()
