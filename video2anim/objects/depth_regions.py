"""Objects as regions of a metric depth map: upright, standing on the floor, nearer than the background behind them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_opening, minimum_filter

from video2anim.geometry.column_layers import background_distance
from video2anim.geometry.gravity_view import GravityView, remap
from video2anim.types.camera import View

_FLOOR_TOLERANCE_M, _FLOOR_TOLERANCE_RATIO = 0.08, 0.03
"""Flat points lower than this, plus this share of their distance, belong to the floor."""
NEARER_RATIO = 0.9
"""Objects are nearer than this share of the background's distance."""
_BREAK_RATIO = 0.06
"""Relative step in depth between neighboring pixels that separates surfaces."""


@dataclass(frozen=True, slots=True)
class RegionLimits:
    """What counts as an object."""

    min_ratio: float
    """Share of the image."""
    min_m: float
    """Width and height."""
    max_m: float
    """Width and height."""
    max_objects: int
    """Those with the best score are kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """One object."""

    mask: Bool[np.ndarray, "height width"]
    score: float
    """0 to 1: contrast of its distance to the background, times the share of its lower edge on the floor."""
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    objects: tuple[Region, ...]
    floor: Bool[np.ndarray, "height width"]


def find_regions(
    depth_m: Float[np.ndarray, "height width"],
    valid: Bool[np.ndarray, "height width"],
    camera: View,
    limits: RegionLimits,
) -> Regions:
    """Floor and objects of a background image's metric depth, best first."""
    view = GravityView.of(camera)
    height_m = view.center_world_m[1] + depth_m * view.ray_world[..., 1]
    distance_m = depth_m * view.ray_horizontal
    low = np.abs(height_m) < _FLOOR_TOLERANCE_M + _FLOOR_TOLERANCE_RATIO * distance_m
    floor = valid & low & (view.ray_world[..., 1] < 0) & _lies_flat(view, distance_m)
    upright = valid & ~floor & ((height_m > 0) | low)
    if not upright.any():
        return Regions((), floor)
    background_m = _background(view, distance_m, upright)
    near = upright & (distance_m < NEARER_RATIO * background_m)
    near = np.asarray(binary_opening(near & ~_breaks(depth_m, _BREAK_RATIO), np.ones((2, 2))), dtype=bool)
    count, parts = cv2.connectedComponents(near.astype(np.uint8), connectivity=4)
    found = []
    for index in range(1, count):
        region = _judge(parts == index, near, floor, view, depth_m, distance_m / background_m, limits)
        if region is not None:
            found.append(region)
    found.sort(key=lambda region: -region.score)
    return Regions(tuple(found[: limits.max_objects]), floor)


def _lies_flat(view: GravityView, distance_m: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """Pixels whose distance changes with elevation as that of the floor, not as that of an upright surface."""
    floor_m = view.camera_height_m * view.ray_horizontal / np.maximum(-view.ray_world[..., 1], 1e-3)
    change, floor_change = (np.gradient(field, axis=0) for field in (distance_m, floor_m))
    return np.abs(change) > 0.5 * np.abs(floor_change)


def _background(view: GravityView, distance_m: np.ndarray, upright: np.ndarray) -> Float[np.ndarray, "height width"]:
    """Distance of the background behind every pixel: the farthest upright surface of its plumb column."""
    nodes, seen = view.pixels_of_grid()
    there = seen & remap(upright, nodes, nearest=True)
    reach = np.where(there, remap(distance_m.astype(np.float32), nodes, nearest=True), np.nan)
    known = there.sum(0) >= 2
    columns = np.arange(view.columns)
    if not known.any():
        return np.full(distance_m.shape, np.inf)
    farthest = np.array([np.nanpercentile(reach[:, c], 90) for c in columns[known]])
    per_column = np.interp(columns, columns[known], farthest)
    background_m, _ = background_distance(per_column, view.azimuth_rad(columns))
    column = np.clip(np.round(view.grid_of_pixels()[..., 0]).astype(int), 0, view.columns - 1)
    return background_m[column]


def _breaks(depth_m: np.ndarray, ratio: float) -> Bool[np.ndarray, "height width"]:
    """Far side of every step in depth."""
    log = np.log(np.maximum(depth_m, 1e-3))
    return log - minimum_filter(log, size=2) > np.log1p(ratio)


def _judge(
    part: np.ndarray,
    near: np.ndarray,
    floor: np.ndarray,
    view: GravityView,
    depth_m: np.ndarray,
    share: np.ndarray,
    limits: RegionLimits,
) -> Region | None:
    """The region if it is large enough, stands on the floor and has an object's size."""
    if part.sum() < limits.min_ratio * part.size:
        return None
    points = view.center_world_m + depth_m[part][:, None] * view.ray_world[part]
    low, high = np.percentile(points, [2, 98], axis=0)
    width_m = float(np.hypot(*(high - low)[[0, 2]]))
    height_m = float(high[1])
    sizes = (width_m, height_m)
    if min(sizes) < limits.min_m or max(sizes) > limits.max_m:
        return None
    columns = np.flatnonzero(part.any(0))
    lowest = part.shape[0] - 1 - np.argmax(part[::-1, columns], axis=0)
    below = np.minimum(lowest + 2, part.shape[0] - 1)
    stands = floor[below, columns] | (lowest >= part.shape[0] - 3)
    on_floor = float(stands.mean())
    if on_floor < 0.3 or not floor[below, columns].any():
        return None
    mask = cv2.dilate(part.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & (near | part)
    contrast = float(np.clip((1 - np.median(share[part])) / 0.3, 0, 1))
    return Region(mask, contrast * on_floor, width_m, height_m)
