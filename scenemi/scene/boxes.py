"""Upright boxes turned about the vertical: exact distances, nearest points and voxels in a few array operations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scenemi.scene.voxels import DEFAULT_GRID, GridSpec


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Solid boxes; local axes x, z are those of the frame turned by `yaw_rad` about +Y."""

    center_m: Float[np.ndarray, "boxes 3"]
    half_m: Float[np.ndarray, "boxes 3"]
    yaw_rad: Float[np.ndarray, "boxes"]

    @classmethod
    def none(cls) -> Boxes:
        """No box."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    @classmethod
    def joined(cls, several: Iterable[Boxes]) -> Boxes:
        """All boxes in one."""
        several = [cls.none(), *several]
        return cls(
            np.concatenate([b.center_m for b in several]),
            np.concatenate([b.half_m for b in several]),
            np.concatenate([b.yaw_rad for b in several]),
        )

    def __len__(self) -> int:
        return len(self.yaw_rad)

    def offsets(
        self, points_m: Float[np.ndarray, "3 points"], floor_y_m: float
    ) -> tuple[Float[np.ndarray, "3 points"], Float[np.ndarray, "points"]]:
        """Vectors to the nearest solid point of boxes and floor, coordinates first, and their squared lengths."""
        best = np.zeros_like(points_m)
        best[1] = np.minimum(floor_y_m - points_m[1], 0.0)
        best_gap2 = best[1] ** 2
        for center_m, half_m, yaw in zip(self.center_m, self.half_m, self.yaw_rad, strict=True):
            local = _local(points_m, center_m, yaw)
            over = [np.clip(p, -h, h) - p for p, h in zip(local, half_m.astype(points_m.dtype), strict=True)]
            gap2 = over[0] * over[0] + over[1] * over[1] + over[2] * over[2]
            closer = np.flatnonzero(gap2 < best_gap2)
            if len(closer):
                cos, sin = (points_m.dtype.type(f(yaw)) for f in (np.cos, np.sin))
                u, w = over[0][closer], over[2][closer]
                best[0, closer], best[1, closer] = u * cos + w * sin, over[1][closer]
                best[2, closer] = w * cos - u * sin
                best_gap2[closer] = gap2[closer]
        return best, best_gap2

    def nearest_within(
        self, points_m: Float[np.ndarray, "points 3"], reach_m: float
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points"]]:
        """See `scenemi.scene.geometry.Solid`."""
        offset, gap2 = self.offsets(np.ascontiguousarray(points_m.T), -np.inf)
        gap_m = np.sqrt(gap2)
        near = gap_m <= reach_m
        return points_m + np.where(near, offset, 0.0).T, np.where(near, gap_m, np.inf)

    def signed_distance(self, points_m: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
        """Distance to the nearest box, negative inside: there the depth in the box it is deepest in."""
        flat = np.ascontiguousarray(points_m.reshape(-1, 3).T)
        best = np.full(flat.shape[1], np.inf)
        for center_m, half_m, yaw in zip(self.center_m, self.half_m, self.yaw_rad, strict=True):
            over = np.abs(_local(flat, center_m, yaw)) - half_m[:, None]
            outside = np.sqrt((np.maximum(over, 0.0) ** 2).sum(0))
            np.minimum(best, outside + np.minimum(over.max(0), 0.0), out=best)
        return best.reshape(points_m.shape[:-1])

    def occupancy(self, grid: GridSpec = DEFAULT_GRID) -> Bool[np.ndarray, "x y z"]:
        """Voxels of the boxes' own frame with a solid point within half a voxel."""
        occupied = np.zeros(grid.shape, bool)
        axes_m, within_m = grid.axes_m(), grid.within_m
        for center_m, half_m, yaw in zip(self.center_m, self.half_m, self.yaw_rad, strict=True):
            cos, sin = np.cos(yaw), np.sin(yaw)
            extent = np.array([abs(cos) * half_m[0] + abs(sin) * half_m[2], half_m[1]])
            extent = np.array([extent[0], extent[1], abs(sin) * half_m[0] + abs(cos) * half_m[2]]) + within_m
            cut = [
                slice(*np.searchsorted(ax, (c - e, c + e))) for ax, c, e in zip(axes_m, center_m, extent, strict=True)
            ]
            if any(s.stop <= s.start for s in cut):
                continue
            x, y, z = (ax[s] - c for ax, s, c in zip(axes_m, cut, center_m, strict=True))
            over_u = np.abs(x[:, None] * cos - z[None] * sin) - half_m[0]
            over_w = np.abs(x[:, None] * sin + z[None] * cos) - half_m[2]
            over_y = np.abs(y) - half_m[1]
            gap2 = np.maximum(over_u, 0.0) ** 2 + np.maximum(over_w, 0.0) ** 2
            near = gap2[:, None] + np.maximum(over_y, 0.0)[None, :, None] ** 2 <= within_m**2
            occupied[tuple(cut)] |= near
        return occupied


def _local(points_m: Float[np.ndarray, "3 points"], center_m: np.ndarray, yaw: float) -> np.ndarray:
    """Points in the frame of a box."""
    cos, sin = (points_m.dtype.type(f(yaw)) for f in (np.cos, np.sin))
    x, y, z = (points_m[k] - points_m.dtype.type(center_m[k]) for k in range(3))
    return np.stack([x * cos - z * sin, y, x * sin + z * cos])
