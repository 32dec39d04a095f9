"""The solid of a thing that one camera sees: seen surface, what is not seen to be free, and stated assumptions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool
from scipy.spatial import KDTree

from video2anim.geometry.carving import ObjectView, Voxels, carve
from video2anim.geometry.projection import backproject, transform_points
from video2anim.geometry.thing_pixels import surface_normals
from video2anim.geometry.upright_box import UprightBox, fit_upright_box, turned_to

_LEAST_POINTS = 30
_BOX_FILL = 0.9
"""Solids that fill so much of their box are boxes."""
_TOUCHING_M = 0.2
"""What is seen right below a thing carries it if it is nearer to its lower end than this."""
_RAISED_M = 0.15
"""Lower ends below this height are on the floor."""
_RING_PX = 0.04
"""Width of the surroundings in which a wall is looked for, as a share of the picture's width."""


@dataclass(frozen=True, slots=True)
class SolidLimits:
    """What is assumed where nothing is seen."""

    most_along: int = 40
    """Cubes along the longest side."""
    thinnest_m: float = 0.2
    thickest_m: float = 0.8
    thickness_ratio: float = 0.35
    """Thickness of a thing seen from the front alone, as a share of the root of width times height."""
    wall_ratio: float = 1.7
    """It reaches to the wall behind it if that makes it no thicker than this many times what is assumed."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectSolid:
    """Box, cubes, and how they came about."""

    box: UprightBox
    voxels: Voxels
    view: ObjectView
    method: str


def object_solid(
    own: Bool[np.ndarray, "height width"],
    added: Bool[np.ndarray, "height width"],
    view: ObjectView,
    limits: SolidLimits,
    *,
    blur_m: float = 0.0,
) -> ObjectSolid | None:
    """The solid of one thing; None where too little of it has depth.

    Args:
        own: Visible pixels that count as the thing's.
        added: Hidden pixels of its whole outline.
        view: Depth of the whole picture; `own` pixels are the thing's, and `added` ones unknown.
        limits: Assumptions.
        blur_m: How far off depth may be along a pixel's ray.
    """
    world_m = transform_points(
        view.T_world_camera, backproject(view.depth_m.astype(np.float64), view.intrinsics).reshape(-1, 3)
    ).reshape(*own.shape, 3)
    normal = surface_normals(world_m)
    inner = _inner(own, view)
    points_m, normals = world_m[inner], normal[inner]
    if len(points_m) < _LEAST_POINTS:
        return None
    near = _without_strays(points_m)
    points_m, normals = points_m[near], normals[near]
    camera_m = view.T_world_camera[:3, 3]
    box = turned_to(fit_upright_box(points_m, normals), camera_m)
    box = _widened(box, own, added, points_m, inner, view)
    base_m = max(float(box.low_m[1]), 0.0) if _is_raised(own, world_m, view.known) else 0.0
    low, high = box.low_m.copy(), box.high_m.copy()
    low[1], high[1] = base_m, max(high[1], base_m + 0.05)
    words = []
    if not box.measured[2]:
        assumed = float(np.clip(
            limits.thickness_ratio * np.sqrt((high[0] - low[0]) * (high[1] - low[1])),
            limits.thinnest_m, limits.thickest_m,
        ))  # fmt: skip
        wall = _wall_behind(box, own | added, world_m, view)
        if wall is not None and high[2] - wall < limits.wall_ratio * assumed:
            low[2] = min(low[2], wall)
            words.append("to the wall")
        elif high[2] - low[2] < assumed:
            low[2] = high[2] - assumed
            words.append("assumed thickness")
    box = box.with_bounds(low, np.maximum(high, low + 0.02))
    voxels = carve(box, view, points_m, most_along=limits.most_along, blur_m=blur_m)
    if not voxels.filled.any():
        return None
    kind = "box" if voxels.filled.mean() >= _BOX_FILL else "carved"
    if voxels.mirrored and kind == "carved":
        words.append("symmetric")
    return ObjectSolid(box, voxels, view, ", ".join([kind, *words]))


def _inner(own: np.ndarray, view: ObjectView) -> Bool[np.ndarray, "height width"]:
    """Pixels off the outline, where depths mix; all of a thing that is narrower than that."""
    shows = own & view.known if view.shows is None else own & view.known & view.shows
    inner = cv2.erode(own.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & shows
    return inner if inner.sum() >= max(_LEAST_POINTS, 0.2 * shows.sum()) else shows


def _without_strays(points_m: np.ndarray) -> Bool[np.ndarray, "points"]:
    """Points that have company: a mask's edge on a far wall would stretch the box."""
    # Twelve neighbours within a distance that suits the thing's size.
    reach_m = 0.08 * float(np.linalg.norm(np.ptp(np.percentile(points_m, [5, 95], axis=0), axis=0))) + 0.02
    sample = points_m[:: max(1, len(points_m) // 4000)]
    enough = max(3, len(sample) // 300)
    gap_m, _ = KDTree(sample).query(points_m, k=min(enough, len(sample)))
    kept = np.atleast_2d(gap_m.T).T[:, -1] <= reach_m
    return kept if kept.mean() > 0.5 else np.ones(len(points_m), bool)


def _is_raised(own: np.ndarray, world_m: np.ndarray, known: np.ndarray) -> bool:
    """Whether the thing rests on something else than the floor: most of its lower ends touch what is seen below them,
    and that is above the floor. Where something hides the lower ends the floor is assumed."""
    rows = own.shape[0]
    columns = np.flatnonzero(own.any(0))
    lowest = rows - 1 - np.argmax(own[::-1, columns], axis=0)
    inside, below = np.maximum(lowest - 1, 0), np.minimum(lowest + 2, rows - 1)
    told = (lowest < rows - 2) & known[inside, columns] & known[below, columns]
    end_m, under_m = world_m[inside, columns][told], world_m[below, columns][told]
    high = np.minimum(end_m[:, 1], under_m[:, 1]) > _RAISED_M
    # What reaches higher than the lower end stands before it.
    carried = end_m[:, 1] > under_m[:, 1] - 0.02
    raised = high & carried & (np.linalg.norm(end_m - under_m, axis=-1) < _TOUCHING_M)
    return bool(raised.sum() > 0.6 * max(len(columns), 1))


def _widened(
    box: UprightBox,
    own: np.ndarray,
    added: np.ndarray,
    points_m: np.ndarray,
    inner: np.ndarray,
    view: ObjectView,
) -> UprightBox:
    """The box with the hidden part of the outline, at the depth of the nearest seen part."""
    if not added.any():
        return box
    seen, hidden = np.argwhere(inner), np.argwhere(added)
    _, nearest = KDTree(seen).query(hidden)
    depth_m = view.depth_m[tuple(seen[nearest].T)].astype(np.float64)
    k = view.intrinsics
    x, y = (hidden[:, 1] - k.cx_px) / k.fx_px, (hidden[:, 0] - k.cy_px) / k.fy_px
    lifted = transform_points(view.T_world_camera, np.stack([x, y, np.ones(len(x))], -1) * depth_m[:, None])
    low, high = np.percentile(box.to_box(lifted), [1, 99], axis=0)
    low, high = np.minimum(low, box.low_m), np.maximum(high, box.high_m)
    # Depth of hidden parts is a guess: they widen the thing, they do not deepen it.
    low[2], high[2] = box.low_m[2], box.high_m[2]
    return box.with_bounds(low, high)


def _wall_behind(box: UprightBox, outline: np.ndarray, world_m: np.ndarray, view: ObjectView) -> float | None:
    """Place along the box's z of the upright surface around the outline and behind the front; None if there is none."""
    reach = max(2, round(_RING_PX * outline.shape[1]))
    around = cv2.dilate(outline.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).astype(bool)
    own_m = box.to_box(world_m[around & ~outline & view.known])
    behind = (own_m[:, 1] > 0.25) & (own_m[:, 2] < box.high_m[2] - 0.03)
    if behind.sum() < _LEAST_POINTS or behind.mean() < 0.15:
        return None
    z = own_m[behind, 2]
    middle = float(np.median(z))
    # A wall is flat: most of the points lie in one plane across the view.
    return middle if (np.abs(z - middle) < 0.12).mean() > 0.5 else None
