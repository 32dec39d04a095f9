"""Bring an object under the feet that rested on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.types.scene import PlacedObject

FITTED = "top and place fitted to the feet that rested on it"
_HEIGHT_SLACK = 0.25
"""Largest relative change of height."""
_LARGEST_SHIFT_M = 1.0
_UNEVEN_M = 0.25
"""How far a made top may lie below the soles on it: a level top that is seen at a flat angle bends so much."""


def fit_under_feet(
    item: PlacedObject,
    low_xz_m: Float[np.ndarray, "2"],
    high_xz_m: Float[np.ndarray, "2"],
    top_m: float,
    camera_xz_m: Float[np.ndarray, "2"],
) -> PlacedObject | None:
    """The object with its top at the height of the feet and its footprint under theirs; None if it is not near that.

    Seen from the camera, nothing of the object may rise above the soles where the feet stood: what does (a tree behind
    taken for the object, say) is cut down in those columns of the picture. Then the object is moved by the smallest
    horizontal shift, and its height is scaled, so that it meets the soles. Under them its top is level.
    """
    vertices_m = item.mesh.vertices_m * item.scale
    world_m = vertices_m @ item.T_world_object[:3, :3].T + item.T_world_object[:3, 3]
    corners = np.array([[x, z] for x in (low_xz_m[0], high_xz_m[0]) for z in (low_xz_m[1], high_xz_m[1])])
    column = _same_columns(world_m[:, [0, 2]], corners, camera_xz_m)
    if not column.any():
        return None
    reached_m = min(float(world_m[column, 1].max()), top_m)
    if reached_m <= 0 or abs(top_m / reached_m - 1) > _HEIGHT_SLACK:
        return None
    box_low, box_high = world_m[:, [0, 2]].min(0), world_m[:, [0, 2]].max(0)
    shift_m = np.maximum(0, high_xz_m - box_high) + np.minimum(0, low_xz_m - box_low)
    if np.linalg.norm(shift_m) > _LARGEST_SHIFT_M:
        return None
    new_height_m = np.where(column, np.minimum(world_m[:, 1], reached_m), world_m[:, 1]) * (top_m / reached_m)
    places_m = world_m[:, [0, 2]] + shift_m
    trodden = (places_m >= low_xz_m).all(1) & (places_m <= high_xz_m).all(1) & (new_height_m > top_m - _UNEVEN_M)
    new_height_m[trodden] = top_m
    mesh_m = item.mesh.vertices_m.astype(np.float64).copy()
    mesh_m[:, 1] = (new_height_m - item.T_world_object[1, 3]) / item.scale
    T_world_object = item.T_world_object.copy()
    T_world_object[[0, 2], 3] += shift_m
    mesh = replace(item.mesh, vertices_m=mesh_m)
    return replace(item, mesh=mesh, T_world_object=T_world_object, reason=f"{item.reason}; {FITTED}".lstrip("; "))


def _same_columns(
    points_xz_m: np.ndarray, corners_xz_m: np.ndarray, camera_xz_m: np.ndarray
) -> Bool[np.ndarray, "points"]:
    """Points seen from the camera in the same horizontal direction as a footprint."""
    middle = corners_xz_m.mean(0) - camera_xz_m

    def bearing(places: np.ndarray) -> np.ndarray:
        away = places - camera_xz_m
        return np.arctan2(middle[0] * away[:, 1] - middle[1] * away[:, 0], away @ middle)

    edges = bearing(corners_xz_m)
    angle = bearing(points_xz_m)
    return (angle >= edges.min()) & (angle <= edges.max())
