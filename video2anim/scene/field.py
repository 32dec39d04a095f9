"""Where the distance field of a scene lies, and how fine it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from video2anim.types import BodyTracks, Mesh


def motion_bounds(bodies: BodyTracks) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of all joints in valid frames, meters, world.

    Raises:
        StageError: no body has a valid frame.
    """
    people = (bodies.main, *bodies.people[1:])
    points = np.concatenate([body.joints_world_m[body.valid].reshape(-1, 3) for body in people])
    return np.stack([points.min(0), points.max(0)])


def field_bounds(
    motion_m: Float[np.ndarray, "2 3"], solids: Sequence[Mesh], margin_m: float, reach_m: float
) -> Float[np.ndarray, "2 3"]:
    """Motion with a margin, and the objects within reach of it; from under the floor to above the highest joint."""
    low, high = motion_m[0] - margin_m, motion_m[1] + margin_m
    for solid in solids:
        box_low, box_high = solid.vertices_m.min(0).astype(float), solid.vertices_m.max(0).astype(float)
        gap = np.maximum(np.maximum(box_low - motion_m[1], motion_m[0] - box_high), 0)[[0, 2]]
        if np.hypot(*gap) <= reach_m:
            low, high = np.minimum(low, box_low - 0.2), np.maximum(high, box_high + 0.2)
    low[1] = -0.3
    high[1] = max(high[1], 2.0)
    return np.stack([low, high])


def field_spacing(bounds_m: Float[np.ndarray, "2 3"], wanted_m: float, max_nodes: int) -> float:
    """The wanted spacing, or the finest that stays within the limit of nodes."""
    spacing_m = wanted_m
    while np.prod(np.ceil(np.ptp(bounds_m, axis=0) / spacing_m) + 1) > max_nodes:
        spacing_m *= 1.05
    return spacing_m


def overlaps(solid: Mesh, bounds_m: Float[np.ndarray, "2 3"]) -> bool:
    """Whether a solid reaches into the bounds."""
    if not len(solid.faces):
        return False
    low, high = solid.vertices_m.min(0), solid.vertices_m.max(0)
    return bool((low <= bounds_m[1]).all() and (high >= bounds_m[0]).all())
