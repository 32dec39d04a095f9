"""Boxes and upright cylinders, many sets of them at once: distances, rays, surface points, meshes.

A set is what one guess of an object's sizes gives; a fit compares a batch of guesses. All in the object's frame: +Y up,
resting on y = 0, front towards +Z.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

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

        The point looked at is the middle between entering and leaving the slabs of a box, which is inside the box if
        and only if the ray hits it.
        """
        start, along = self._from_center(origin_m[:, None]), self._own(ray)
        enter, leave = self._slabs(start, along)
        middle = 0.5 * (enter + leave)
        x, y, z = (a + middle * b for a, b in zip(start, along, strict=True))
        return np.maximum(self._signed((x, y, z)), 0).min(1)

    def first_hit(
        self, origin_m: Float[np.ndarray, "batch 3"], ray: Float[np.ndarray, "batch rays 3"]
    ) -> Float[np.ndarray, "batch rays"]:
        """Where along each ray (in its lengths) it enters a solid; infinite where it hits none. Cylinders count as the
        square boxes around them."""
        enter, leave = self._slabs(self._from_center(origin_m[:, None]), self._own(ray))
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

    def _slabs(self, start: _Axes, along: _Axes) -> tuple[np.ndarray, np.ndarray]:
        """Where rays are between all three pairs of a box's sides; of a cylinder those of the square around it."""
        enter: Any = -np.inf
        leave: Any = np.inf
        for axis in range(3):
            of = np.where(self.round, 0, axis) if axis == 2 else np.full(len(self.round), axis)
            half = np.take_along_axis(self.half_m, of[None, :, None], 2)
            steep = np.where(np.abs(along[axis]) < _FLAT, _FLAT, along[axis])
            first, second = (-half - start[axis]) / steep, (half - start[axis]) / steep
            enter, leave = np.maximum(enter, np.minimum(first, second)), np.minimum(leave, np.maximum(first, second))
        return enter, leave

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

    def meshes(
        self, cell_m: float
    ) -> list[tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]]:
        """A closed surface for every solid of the first set, divided into cells so that vertices can hold colors."""
        made = []
        for k in range(self.half_m.shape[1]):
            half = self.half_m[0, k]
            vertices, faces = _cylinder(half, cell_m) if self.round[k] else _box(half, cell_m)
            c, s = np.cos(self.tilt_rad[0, k]), np.sin(self.tilt_rad[0, k])
            turn = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
            made.append((vertices @ turn.T + self.center_m[0, k], faces))
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


def _box(half: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A box of grids that share their edges."""
    axes = [np.linspace(-h, h, max(1, round(2 * h / cell_m)) + 1) for h in half]
    shape = tuple(len(axis) for axis in axes)
    number = np.arange(np.prod(shape)).reshape(shape)
    quads = []
    for axis in range(3):
        for side, turned in ((0, True), (-1, False)):
            sheet = np.take(number, side, axis=axis)
            corners = np.stack([sheet[:-1, :-1], sheet[1:, :-1], sheet[1:, 1:], sheet[:-1, 1:]], -1).reshape(-1, 4)
            quads.append(corners[:, ::-1] if turned != (axis == 1) else corners)
    quad = np.concatenate(quads)
    used, faces = np.unique(np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]), return_inverse=True)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return grid[used], faces.reshape(-1, 3)


def _cylinder(half: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Rings from the middle of the lower end over the side to that of the upper end."""
    across = max(1, round(half[0] / cell_m))
    tall = max(1, round(2 * half[1] / cell_m))
    inner = half[0] * np.arange(1, across + 1) / across
    radius = np.concatenate([inner, np.full(tall - 1, half[0]), inner[::-1]])
    height = np.concatenate([np.full(across, -1.0), np.linspace(-1, 1, tall + 1)[1:-1], np.full(across, 1.0)]) * half[1]
    angle = 2 * np.pi * np.arange(_SEGMENTS) / _SEGMENTS
    rings = np.stack([
        radius[:, None] * np.sin(angle), np.repeat(height[:, None], _SEGMENTS, 1), radius[:, None] * np.cos(angle)
    ], -1)  # fmt: skip
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, -half[1], 0], [0, half[1], 0]]])
    count = len(radius)
    number = np.arange(count * _SEGMENTS).reshape(count, _SEGMENTS)
    right = np.roll(number, -1, axis=1)
    a, b, c, d = number[:-1].ravel(), right[:-1].ravel(), right[1:].ravel(), number[1:].ravel()
    side = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    low = np.stack([right[0], number[0], np.full(_SEGMENTS, count * _SEGMENTS)], -1)
    high = np.stack([number[-1], right[-1], np.full(_SEGMENTS, count * _SEGMENTS + 1)], -1)
    return vertices, np.concatenate([side, low, high])
