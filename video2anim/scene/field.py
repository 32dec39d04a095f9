"""Extent and spacing of the distance field of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
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


def solid_field(
    solids: Sequence[Mesh],
    motion_m: Float[np.ndarray, "2 3"],
    margin_m: float,
    reach_m: float,
    spacing_m: float,
    max_nodes: int,
) -> tuple[SdfGrid, int]:
    """Distance field of the solids and the floor around the motion, and how many solids are in it.

    Args:
        solids: meshes in the world.
        motion_m: lowest and highest corner of the motion.
        margin_m: of the field around the motion.
        reach_m: solids this near the motion lie wholly in the field.
        spacing_m: of the nodes; wider where there would be more than `max_nodes`.
        max_nodes: see `spacing_m`.
    """
    bounds_m = field_bounds(motion_m, solids, margin_m, reach_m)
    near = [solid for solid in solids if overlaps(solid, bounds_m)]
    return build_sdf_grid(near, bounds_m, field_spacing(bounds_m, spacing_m, max_nodes), floor_y_m=0.0), len(near)


def overlaps(solid: Mesh, bounds_m: Float[np.ndarray, "2 3"]) -> bool:
    """Whether a solid reaches into the bounds."""
    if not len(solid.faces):
        return False
    low, high = solid.vertices_m.min(0), solid.vertices_m.max(0)
    return bool((low <= bounds_m[1]).all() and (high >= bounds_m[0]).all())
