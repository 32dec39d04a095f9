"""A box that stands upright around the points that one camera sees of an object.

Furniture has right angles: the box is turned so that its footprint is small and the seen faces lie along it. How far it
reaches where nothing was seen is an assumption; the box says which of its axes are measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

_ANGLES = 60
"""Turns tried in a quarter circle."""
_TRIM_PERCENT = 0.5
"""Outermost points on each side that do not stretch the box."""
_ALONG = 0.55
"""A surface lies along an axis where its unit normal has less than this of it."""
_MIN_SHARE = 0.08
"""An axis is measured where at least this share of the points lies on surfaces along it."""


@dataclass(frozen=True, slots=True, eq=False)
class UprightBox:
    """Own frame: +y up from the floor, x and z along the sides."""

    R_world_box: Float[np.ndarray, "3 3"]
    low_m: Float[np.ndarray, "3"]
    """Lowest corner in axes of the box, world origin."""
    high_m: Float[np.ndarray, "3"]
    measured: Bool[np.ndarray, "3"]
    """Axes whose extent was seen and not assumed."""

    @property
    def center_m(self) -> Float[np.ndarray, "3"]:
        return 0.5 * (self.low_m + self.high_m)

    @property
    def size_m(self) -> Float[np.ndarray, "3"]:
        return self.high_m - self.low_m

    def holds(self, points_world_m: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
        """Points inside."""
        own_m = points_world_m @ self.R_world_box
        return np.asarray(((own_m > self.low_m) & (own_m < self.high_m)).all(-1))

    def with_bounds(self, low_m: np.ndarray, high_m: np.ndarray) -> UprightBox:
        """The same axes, other corners."""
        return UprightBox(self.R_world_box, low_m, high_m, self.measured)


def fit_upright_box(
    points_world_m: Float[np.ndarray, "points 3"],
    normals_world: Float[np.ndarray, "points 3"],
    yaw_rad: float | None = None,
) -> UprightBox:
    """The box around seen points; +z of its frame is not yet the side that faces the camera.

    `yaw_rad`: that of its sides, where it is known.

    Raises:
        ValueError: there are no points.
    """
    if not len(points_world_m):
        raise ValueError("fit_upright_box: want at least one point, got none")
    if yaw_rad is None:
        yaw_rad = _smallest(points_world_m, normals_world)
    return box_at(yaw_rad, points_world_m, normals_world)


def _smallest(points_world_m: Float[np.ndarray, "points 3"], normals_world: Float[np.ndarray, "points 3"]) -> float:
    """Yaw of the box with a small footprint along which most normals are."""
    upright = np.abs(normals_world[:, 1]) < _ALONG
    heading = np.arctan2(normals_world[upright, 0], normals_world[upright, 2])
    flat = points_world_m[:, [0, 2]]
    best, yaw_rad = np.inf, 0.0
    for angle in np.arange(_ANGLES) * (0.5 * np.pi / _ANGLES):
        c, s = np.cos(angle), np.sin(angle)
        spread = flat @ np.array([[c, s], [-s, c]])
        size = np.ptp(np.percentile(spread, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0), axis=0) + 0.05
        aside = np.mean(0.5 * (1 - np.cos(4 * (heading - angle)))) if len(heading) else 0.0
        cost = size.prod() * (1 + aside * upright.mean())
        if cost < best:
            best, yaw_rad = cost, float(angle)
    return yaw_rad


def box_at(yaw_rad: float, points_world_m: np.ndarray, normals_world: np.ndarray) -> UprightBox:
    """The box of one yaw, from the lowest to the highest seen point."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    R_world_box = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    own = points_world_m @ R_world_box
    low, high = np.percentile(own, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0)
    along = (np.abs(normals_world @ R_world_box) < _ALONG).mean(0)
    return UprightBox(R_world_box, low, high, along >= _MIN_SHARE)


def turned_to(box: UprightBox, camera_world_m: Float[np.ndarray, "3"]) -> UprightBox:
    """The same box with +z of its frame on the side that faces the camera most."""
    towards = box.R_world_box.T @ camera_world_m - box.center_m
    away = np.abs(towards) - 0.5 * box.size_m
    axis = 2 if away[2] >= away[0] else 0
    z = box.R_world_box[:, axis] * (1.0 if towards[axis] >= 0 else -1.0)
    y = np.array([0.0, 1.0, 0.0])
    R_world_box = np.stack([np.cross(y, z), y, z], -1)
    change = box.R_world_box.T @ R_world_box
    corners = np.stack([box.low_m @ change, box.high_m @ change])
    measured = np.abs(change).T @ box.measured > 0.5
    return UprightBox(R_world_box, corners.min(0), corners.max(0), measured)
