"""Solids where somebody who sees no scene would go, and the true body does not: only such a scene decides something.

A scene-blind filler of the same keyframes (interpolation, or a model's own sample) gives a path; where it leaves the
true body's sweep, boxes are put on it that stay clear of that sweep.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from scenemi.scene.boxes import Boxes
from scenemi.scene.sliding import SweptBody

_MIN_GAP_M = 0.03
"""Blind joints nearer than this to the true sweep leave no room for a solid."""
_FRAME_STEP = 2
"""Of the blind path every so many frames are candidates."""
_NEIGHBORS = 8
"""Sphere centers looked at for the distance to the sweep: spheres differ in size, the nearest center is not enough."""
_TRIES = 18
"""Places tried for a solid; it shrinks after every four."""
_CLEARANCE_M = (0.01, 0.06)
"""Least gap to the body, from and to: from touching to the thickness of clothes (not measured)."""
_FORMS: tuple[tuple[str, float, tuple[float, float]], ...] = (
    ("post", 0.3, (0.03, 0.15)), ("cabinet", 0.3, (0.15, 0.45)), ("carton", 0.2, (0.08, 0.3)),
    ("board", 0.2, (0.05, 0.35)),
)  # fmt: skip
"""Name, share, and half of the horizontal extent from and to (m)."""


class TrueSweep:
    """Where the true body was, for questions about points and boxes."""

    def __init__(self, body: SweptBody) -> None:
        self.center_m = body.center_m.reshape(3, -1)
        self.radius_m = np.broadcast_to(body.radius_m, body.center_m[0].shape).ravel()
        self._tree = KDTree(self.center_m.T, balanced_tree=False, compact_nodes=False)

    def gap_m(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        """Distance to the sweep, negative inside; too large where a far big sphere is nearer than eight small ones."""
        distance_m, sphere = self._tree.query(points_m, k=min(_NEIGHBORS, len(self.radius_m)))
        return (distance_m - self.radius_m[sphere]).min(-1)

    def clear_of(self, box: Boxes, clearance_m: float) -> bool:
        """Whether no sphere comes nearer to a box than the clearance."""
        x, y, z = (self.center_m[a] - np.float32(box.center_m[0, a]) for a in range(3))
        cos, sin = np.float32(np.cos(box.yaw_rad[0])), np.float32(np.sin(box.yaw_rad[0]))
        half, reach = box.half_m[0].astype(np.float32), self.radius_m + np.float32(clearance_m)
        u = np.maximum(np.abs(x * cos - z * sin) - half[0], 0)
        w = np.maximum(np.abs(x * sin + z * cos) - half[2], 0)
        v = np.maximum(np.abs(y) - half[1], 0)
        return not (u * u + v * v + w * w < reach * reach).any()


def telling_solids(
    rng: np.random.Generator, body: SweptBody, blind_m: Float[np.ndarray, "frames 22 3"], count: int
) -> list[tuple[str, Boxes]]:
    """Up to `count` solids on the blind path and off the true one; fewer where they are too near each other.

    Args:
        rng: source of everything random.
        body: the true body's spheres, canonical frame, floor at y = 0.
        blind_m: joints of the scene-blind filling.
        count: how many are tried.
    """
    sweep = TrueSweep(body)
    points_m = blind_m[::_FRAME_STEP].reshape(-1, 3)
    gap_m = sweep.gap_m(points_m)
    chance = np.maximum(gap_m - _MIN_GAP_M, 0.0)
    if not chance.sum() > 0:
        return []
    found: list[tuple[str, Boxes]] = []
    for _ in range(count):
        for attempt, row in enumerate(rng.choice(len(points_m), _TRIES, p=chance / chance.sum())):
            # What does not fit at its full size is tried smaller.
            name, box = _around(rng, points_m[row], scale=0.6 ** (attempt // 4))
            if sweep.clear_of(box, float(rng.uniform(*_CLEARANCE_M))):
                found.append((name, box))
                break
    return found


def _around(rng: np.random.Generator, at_m: Float[np.ndarray, "3"], scale: float) -> tuple[str, Boxes]:
    """A solid of random form with the point inside."""
    form = rng.choice(len(_FORMS), p=[share for _, share, _ in _FORMS])
    name, _, (least, most) = _FORMS[form]
    half = rng.uniform(least, most, 3) * scale
    over = scale * rng.uniform(0.03, 0.3)
    low, high = 0.0, max(at_m[1] + over, 0.08)
    if name == "post":
        high = max(high, rng.uniform(1.2, 2.4))
    elif name == "board":
        low = max(at_m[1] - scale * rng.uniform(0.03, 0.3), 0.0)
    half[1] = 0.5 * max(high - low, 0.02)
    yaw = rng.uniform(0.0, np.pi / 2) if rng.random() < 0.5 else float(rng.normal(0.0, 0.1))
    aside = rng.uniform(-0.9, 0.9, 2) * half[[0, 2]]
    cos, sin = np.cos(yaw), np.sin(yaw)
    center = np.array(
        [at_m[0] + aside[0] * cos + aside[1] * sin, low + half[1], at_m[2] + aside[1] * cos - aside[0] * sin]
    )
    return name, Boxes(center[None], half[None], np.array([yaw]))
