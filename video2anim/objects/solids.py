"""Solids of a few shapes, many sets of them at once: distances, rays, surface points, meshes.

A set is what one guess of an object's sizes gives; a fit compares a batch of guesses. All in the object's frame: +Y up,
resting on y = 0, front towards +Z.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from video2anim.objects.shapes import Axes, Shape


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """A batch of sets of `parts` solids each."""

    center_m: Float[np.ndarray, "batch parts 3"]
    half_m: Float[np.ndarray, "batch parts 3"]
    """Half extents."""
    tilt_rad: Float[np.ndarray, "batch parts"]
    """Turn about the object's x axis through the solid's center: positive leans its top towards -Z."""
    shapes: tuple[Shape, ...]
    """One for each part; parts of the same shape share one."""

    def _own(self, v: np.ndarray) -> Axes:
        """Vectors (batch, n, 3) along the axes of every solid: x, y, z of shape (batch, parts, n)."""
        c, s = np.cos(self.tilt_rad)[..., None], np.sin(self.tilt_rad)[..., None]
        x, y, z = (v[:, None, :, k] for k in range(3))
        if not self.tilt_rad.any():
            every = (len(self.half_m), len(self.shapes), v.shape[1])
            return np.broadcast_to(x, every), np.broadcast_to(y, every), np.broadcast_to(z, every)
        return np.broadcast_to(x, (*c.shape[:2], v.shape[1])), c * y - s * z, s * y + c * z

    def _from_center(self, points_m: np.ndarray) -> Axes:
        x, y, z = self._own(points_m)
        u, v, w = (part[..., 0] for part in self._own_center())
        return x - u[..., None], y - v[..., None], z - w[..., None]

    def _own_center(self) -> Axes:
        c, s = np.cos(self.tilt_rad)[..., None], np.sin(self.tilt_rad)[..., None]
        x, y, z = (self.center_m[..., k, None] for k in range(3))
        return x, c * y - s * z, s * y + c * z

    def _groups(self) -> Iterator[tuple[Shape, np.ndarray | slice, np.ndarray]]:
        """Every shape, the parts that have it, and their half extents."""
        kinds = {id(shape): shape for shape in self.shapes}
        for shape in kinds.values():
            which = slice(None) if len(kinds) == 1 else np.array([other is shape for other in self.shapes])
            yield shape, which, self.half_m[:, which, :, None]

    def distance_m(self, points_m: Float[np.ndarray, "batch points 3"]) -> Float[np.ndarray, "batch parts points"]:
        """Signed distance to every solid, negative inside."""
        own = self._from_center(points_m)
        found = np.empty(own[0].shape)
        for shape, which, half_m in self._groups():
            found[:, which] = shape.signed_m(_some(own, which), half_m)
        return found

    def miss_m(
        self, origin_m: Float[np.ndarray, "batch 3"], ray: Float[np.ndarray, "batch rays 3"]
    ) -> Float[np.ndarray, "batch rays"]:
        """About how far each ray passes the nearest solid; 0 for rays that hit one.

        The point looked at is the middle between entering and leaving, which is inside if and only if the ray hits. Of
        a ray along a side both may be far away; no point of the solid is farther along the ray than its extent.
        """
        every_start, every_along = self._from_center(origin_m[:, None]), self._own(ray)
        missed = []
        for shape, which, half_m in self._groups():
            start, along = _some(every_start, which), _some(every_along, which)
            enter, leave = shape.spans(start, along, half_m)
            square = sum(part**2 for part in along)
            beside = -sum(a * b for a, b in zip(start, along, strict=True)) / square
            across = np.abs(along[0]) * half_m[:, :, 0] + np.abs(along[2]) * half_m[:, :, 2]
            extent = (across + np.abs(along[1]) * half_m[:, :, 1]) / square
            center = np.clip(0.5 * (enter + leave), beside - extent, beside + extent)
            x, y, z = (a + center * b for a, b in zip(start, along, strict=True))
            missed.append(np.maximum(shape.signed_m((x, y, z), half_m), 0).min(1))
        return np.minimum.reduce(missed)

    def first_hit(
        self, origin_m: Float[np.ndarray, "batch 3"], ray: Float[np.ndarray, "batch rays 3"]
    ) -> Float[np.ndarray, "batch rays"]:
        """Where along each ray (in its lengths) it enters a solid; infinite where it hits none."""
        start, along = self._from_center(origin_m[:, None]), self._own(ray)
        hits = []
        for shape, which, half_m in self._groups():
            enter, leave = shape.spans(_some(start, which), _some(along, which), half_m)
            hits.append(np.where((enter <= leave) & (enter > 0), enter, np.inf).min(1))
        return np.minimum.reduce(hits)

    def surface_points_m(self, per_side: int) -> Float[np.ndarray, "batch points 3"]:
        """As many points on the surface of every solid as a lattice has on the sides of a cube."""
        shape = (len(self.half_m), len(self.shapes), per_side**3 - (per_side - 2) ** 3, 3)
        own = np.empty(shape)
        for one, which, half_m in self._groups():
            lattice = one.lattice(per_side)
            own[:, which] = lattice.reshape(-1, 1, *shape[2:]) * half_m[..., 0][:, :, None]
        c, s = np.cos(self.tilt_rad)[..., None], np.sin(self.tilt_rad)[..., None]
        turned = np.stack([own[..., 0], c * own[..., 1] + s * own[..., 2], -s * own[..., 1] + c * own[..., 2]], -1)
        return (turned + self.center_m[:, :, None]).reshape(len(turned), -1, 3)

    def meshes(self) -> list[tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]]:
        """A closed surface of fewer than 300 faces for every solid of the first set."""
        made = []
        for k, shape in enumerate(self.shapes):
            vertices, faces = shape.mesh()
            c, s = np.cos(self.tilt_rad[0, k]), np.sin(self.tilt_rad[0, k])
            turn = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
            made.append(((vertices * self.half_m[0, k]) @ turn.T + self.center_m[0, k], faces))
        return made


def _some(axes: Axes, which: np.ndarray | slice) -> Axes:
    x, y, z = axes
    return x[:, which], y[:, which], z[:, which]
