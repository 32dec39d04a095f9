"""Where a thing meets the floor says how far away it is, better than a network's depth does."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.projection import pixel_rays
from video2anim.types.camera import Intrinsics

_DEPTH_SIGMA = 0.12
"""Error of depth from one thing to the next, as a share of it."""
_LEAST_UP_SIGMA_RAD = 0.005
"""Floors are no flatter and cameras no better known than this."""
_LEAST_COLUMNS = 6
_LEAST_SHARE = 0.15
"""Share of a thing's columns that must be seen to end on the floor."""
_FOOT_QUANTILE = 0.05
"""Between its legs a thing ends above the floor, which seems farther: the feet are the nearest of the ends."""
_OVERHANG_LOG = 0.08
"""So much farther than its depth a thing may seem because its lower edge is off the floor."""
_LARGEST_LOG = 0.7


def floor_factor(
    own: Bool[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    known: Bool[np.ndarray, "height width"],
    floor: Bool[np.ndarray, "height width"],
    T_world_camera: Float[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
    up_sigma_rad: float = 0.025,
) -> float:
    """By what a thing's depth is to be multiplied so that its feet are on the floor; 1 where they are not seen.

    The two estimates are weighed by their variances: near things are known best by their feet, far ones by depth, the
    farther the better gravity is known (`up_sigma_rad`, which tilts the floor).
    """
    inner = cv2.erode(own.astype(np.uint8), np.ones((2, 2), np.uint8)).astype(bool) & known
    columns = np.flatnonzero(own.any(0) & inner.any(0))
    if not len(columns):
        return 1.0
    rows = own.shape[0]
    lowest = rows - 1 - np.argmax(own[::-1, columns], axis=0)
    inside = rows - 1 - np.argmax(inner[::-1, columns], axis=0)
    below = np.minimum(lowest + 2, rows - 1)
    ray = pixel_rays(intrinsics)[lowest, columns] @ T_world_camera[:3, :3].T
    height_m = float(T_world_camera[1, 3])
    stands = (lowest < rows - 2) & floor[below, columns] & (ray[:, 1] < -0.02) & (lowest - inside < 4)
    if stands.sum() < max(_LEAST_COLUMNS, _LEAST_SHARE * len(columns)) or height_m <= 0.1:
        return 1.0
    ends_m = height_m / -ray[stands, 1]
    ratio = float(np.quantile(np.log(ends_m / depth_m[inside[stands], columns[stands]]), _FOOT_QUANTILE))
    cut = own[-1].any() or own[:, 0].any() or own[:, -1].any()
    # Farther than its depth: its feet may be outside the picture, or hidden under it.
    ratio = min(ratio, 0.0) + (0.0 if cut else max(ratio - _OVERHANG_LOG, 0.0))
    distance_m = float(np.median(ends_m))
    tilt_rad = max(up_sigma_rad, _LEAST_UP_SIGMA_RAD)
    floor_sigma = distance_m / height_m * tilt_rad + 1.5 * distance_m / (height_m * intrinsics.fy_px)
    weight = _DEPTH_SIGMA**2 / (_DEPTH_SIGMA**2 + floor_sigma**2)
    return float(np.exp(weight * np.clip(ratio, -_LARGEST_LOG, _LARGEST_LOG)))
