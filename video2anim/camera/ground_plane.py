"""The ground that a traveling camera passes, as evidence of gravity: a plane that holds many background points."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

_TILT_RAD = math.radians(25)
"""Largest angle between the ground's normal and the up direction of the other sources."""
_NEAR_RATIO = 0.01
"""Points of the plane are this near to it, as a share of their distance."""
_BELOW_RATIO = 0.03
"""Points this far beneath it, as a share of their distance, show that it is not the ground."""
_MIN_SHARE = 0.4
"""Least share of the points that the ground holds. It holds 0.55 and 0.69 where it is right (`02_follow_walk`,
`glamr_pexels_walking`), and planes of shorter paths, up to 17 degrees off, 0.03 to 0.25 (nine other clips of
`benchmarks/moving_cameras.py` and `real_clips.py`)."""
_DRAWS = 2000
"""Triples of points, which find a plane of that share with near certainty."""


def ground_up(
    points: Float[np.ndarray, "points 3"], up_camera: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"] | None:
    """Normal of the ground in the first camera's axes.

    Args:
        points: Of the background, in the first camera's axes and any unit, with known depth.
        up_camera: Up direction by other sources.

    Returns:
        None if no plane that is about level holds enough of the points, with hardly any beneath it.
    """
    if len(points) < 3:
        return None
    a, b, c = points[np.random.default_rng(0).integers(0, len(points), (3, _DRAWS))]
    normal = np.cross(b - a, c - a)
    normal *= (np.sign(normal @ up_camera) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12))[:, None]
    height = -(a * normal).sum(1)
    level = (normal @ up_camera > math.cos(_TILT_RAD)) & (height > 0)
    if not level.any():
        return None
    off = _off(points, normal[level], height[level])
    near, below = (np.abs(off) < _NEAR_RATIO).sum(1), (off < -_BELOW_RATIO).sum(1)
    best = int(np.argmax(near - below))
    if near[best] - below[best] < _MIN_SHARE * len(points):
        return None
    own = points[np.abs(off[best]) < _NEAR_RATIO]
    # Nearer points are known better: planes n . x = -1 by least squares over the distance.
    weight = 1 / np.linalg.norm(own, axis=1)
    fitted = np.linalg.lstsq(own * weight[:, None], -weight, rcond=None)[0]
    return fitted / np.linalg.norm(fitted)


def _off(points: np.ndarray, normal: np.ndarray, height: np.ndarray) -> Float[np.ndarray, "planes points"]:
    """Height of points above planes, as a share of their distance."""
    return (normal @ points.T + height[:, None]) / np.linalg.norm(points, axis=1)
