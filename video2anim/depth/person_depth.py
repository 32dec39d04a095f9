"""Distance of a standing person from where the outline meets the floor, without use of the fitted body's position."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.gravity_view import GravityView
from video2anim.types.motion import BodyMotion
from video2anim.types.skeleton import FEET

_ON_FLOOR_M = 0.2
"""Foot joints lower than this can stand on the floor."""
_SOLE_M = 0.3
"""The outline must end this close to the foot it is taken for."""


def standing_feet(
    motion: BodyMotion, contact_threshold: float
) -> tuple[Float[np.ndarray, "frames 4 3"], Bool[np.ndarray, "frames 4"]]:
    """Foot joints in the world, and which of them stand on the floor in which frame."""
    feet_world_m = motion.joints_world_m[:, FEET]
    touching = motion.contact[:, FEET] >= contact_threshold
    low = np.abs(feet_world_m[..., 1]) < _ON_FLOOR_M
    return feet_world_m, touching & low & motion.valid[:, None]


def person_distance(
    view: GravityView, mask: Bool[np.ndarray, "height width"], feet_world_m: Float[np.ndarray, "feet 3"]
) -> tuple[float, float] | None:
    """Horizontal distance of the floor under a figure and its standard deviation, in meters.

    The lowest pixels of the outline near a standing foot lie on the floor, whose plane is known. The feet tell where to
    look and whether the outline ends there; the distance comes from the outline. None where the outline ends elsewhere
    (feet hidden, or cut by the picture's edge).
    """
    if not mask.any() or not len(feet_world_m):
        return None
    height, width = mask.shape
    rows, columns = np.nonzero(mask)
    grid = view.locate(view.center_world_m + view.ray_world[rows, columns])
    feet = view.locate(feet_world_m * np.array([1.0, 0.0, 1.0]))
    far = np.hypot(*(feet_world_m - view.center_world_m)[:, [0, 2]].T)
    found = []
    for foot, distance in zip(feet, np.maximum(far, 0.3), strict=True):
        half = max(0.12 / distance / view.step_rad, 1.5)
        near = np.abs(grid[:, 0] - foot[0]) < half
        if near.sum() < 3:
            continue
        lowest = np.argmax(np.where(near, grid[:, 1], -np.inf))
        cut = rows[lowest] >= height - 2 or columns[lowest] <= 1 or columns[lowest] >= width - 2
        if not cut and abs(grid[lowest, 1] - foot[1]) * view.step_rad * distance < _SOLE_M:
            found.append(grid[lowest, 1])
    if not found:
        return None
    row = float(max(found))
    distance_m = float(view.floor_distance_m(np.array(row + 0.5)))
    if not np.isfinite(distance_m):
        return None
    slope = (view.camera_height_m**2 + distance_m**2) / view.camera_height_m * view.step_rad
    return distance_m, float(np.hypot(1.5 * slope, 0.1))
