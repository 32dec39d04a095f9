"""Virtual cameras: looking at a set of points from a chosen side, as near as fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.types import Intrinsics

_MARGIN = 0.9
"""Share of the half picture that the points may fill."""
_MIN_DISTANCE_M = 0.5
"""From the middle of the points, which may be one."""


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """A camera somewhere in the world (OpenCV axes)."""

    T_world_camera: Float[np.ndarray, "4 4"]
    intrinsics: Intrinsics

    def to_camera(self, points_world_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the world in this camera's axes."""
        return transform_points(invert_rigid(self.T_world_camera), np.asarray(points_world_m, np.float64))


def looking(forward_world: Float[np.ndarray, "3"], elevation_rad: float) -> Float[np.ndarray, "3 3"]:
    """R_world_camera of a level camera that looks along the horizontal part of `forward_world`, tilted down.

    Falls back to looking along -Z where `forward_world` is vertical.
    """
    heading = np.array([forward_world[0], 0.0, forward_world[2]])
    length = np.linalg.norm(heading)
    heading = heading / length if length > 1e-6 else np.array([0.0, 0.0, -1.0])
    forward = np.cos(elevation_rad) * heading - np.sin(elevation_rad) * np.array([0.0, 1.0, 0.0])
    right = np.cross(heading, [0.0, 1.0, 0.0])
    down = np.cross(forward, right)
    return np.stack([right, down, forward], axis=1)


def fit_viewpoint(
    points_world_m: Float[np.ndarray, "points 3"],
    R_world_camera: Float[np.ndarray, "3 3"],
    *,
    width_px: int,
    height_px: int,
    fov_y_rad: float = 0.7,
) -> Viewpoint:
    """The nearest camera of this orientation, centered on the points, that has all of them in its picture."""
    intrinsics = Intrinsics.centered(0.5 * height_px / np.tan(0.5 * fov_y_rad), width_px, height_px)
    turned = points_world_m @ R_world_camera
    center = 0.5 * (turned.min(0) + turned.max(0))
    from_center = turned - center
    reach = np.abs(from_center[:, :2]) * [intrinsics.fx_px / (0.5 * width_px), intrinsics.fy_px / (0.5 * height_px)]
    distance_m = max(float((reach.max(1) / _MARGIN - from_center[:, 2]).max()), _MIN_DISTANCE_M)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = R_world_camera
    T_world_camera[:3, 3] = R_world_camera @ (center - [0.0, 0.0, distance_m])
    return Viewpoint(T_world_camera, intrinsics)
