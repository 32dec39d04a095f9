"""Depth of a picture from gravity and the floor alone: a planar scene proxy of floor, upright objects and an upright
background.

The floor plane is known (y = 0 of the world). Where the floor ends in a plumb column, something upright begins, at the
distance of its foot line. Objects nearer than the background beside them become upright cut-outs of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.depth.floor_boundary import BoundaryConfig, FloorBoundary, find_floor_boundary
from video2anim.depth.furniture_layers import grow_cutout
from video2anim.geometry.column_layers import background_distance, ground_contact_distance
from video2anim.geometry.gravity_view import GravityView, remap
from video2anim.types.camera import View

_EDGE_ROWS = 3
"""Rows below the floor's boundary whose look is mixed with that of the upright surface."""


@dataclass(frozen=True, slots=True)
class PlanarSceneConfig:
    """Limits of the planar scene proxy."""

    far_m: float = 30.0
    """Nothing is placed beyond this distance."""
    tallest_m: float = 12.0
    """Upright surfaces are trusted up to this height."""
    seed_radius_m: float = 0.25
    """Floor taken as known around a standing foot."""
    min_ratio: float = 0.003
    """Least share of the picture for a cut-out of its own."""
    boundary: BoundaryConfig = field(default_factory=BoundaryConfig)


@dataclass(frozen=True, slots=True, eq=False)
class PlanarSceneProxy:
    """Depth of the background image; all maps have the picture's size."""

    depth_m: Float[np.ndarray, "height width"]
    sigma_m: Float[np.ndarray, "height width"]
    valid: Bool[np.ndarray, "height width"]
    layer: Int[np.ndarray, "height width"]
    """0 background, 1 floor, 2 and up one cut-out each."""


def planar_scene_depth(
    background_rgb: UInt8[np.ndarray, "height width 3"],
    camera: View,
    standing_world_m: Float[np.ndarray, "spots 3"],
    config: PlanarSceneConfig,
) -> PlanarSceneProxy | None:
    """Depth of the background image, or None where no standing spot lies in the picture (then nothing is known of the
    floor).

    Args:
        background_rgb: picture without people, of the size the camera says.
        standing_world_m: places on the floor where feet stood.
    """
    view = GravityView.of(camera)
    if view.camera_height_m <= 0.05 or not len(standing_world_m):
        return None
    nodes, seen = view.pixels_of_grid()
    image = remap(background_rgb, nodes)
    seed = _floor_seeds(view, standing_world_m, config.seed_radius_m) & seen
    if not seed.any():
        return None
    horizon = int(np.clip(round(view.elevation_top_rad / view.step_rad), 0, view.rows))
    first = int(np.clip(np.ceil(view.floor_row(np.array(config.far_m))), 0, view.rows))
    boundary = find_floor_boundary(image, seen, seed, first, horizon, config.boundary)
    distance_m, sigma_m, known = _upright_distance(view, boundary, seen, first)
    background_m, hidden = background_distance(
        distance_m, view.azimuth_rad(np.arange(view.columns)), far_m=config.far_m
    )
    sigma_m = np.where(hidden, sigma_m + 0.2 * background_m, sigma_m)
    cutouts = _cutouts(view, image, seen, seed, boundary, background_m, config)
    return _compose(view, seen, background_m, sigma_m, known | hidden, cutouts, config)


def _floor_seeds(view: GravityView, standing_world_m: np.ndarray, radius_m: float) -> Bool[np.ndarray, "rows columns"]:
    """Nodes on the floor near a standing spot, or before it: a foot that is seen has free floor in front of it."""
    seed = np.zeros((view.rows, view.columns), dtype=np.uint8)
    spots = np.unique(np.round(standing_world_m[:, [0, 2]] / 0.1).astype(int), axis=0) * 0.1
    for x, z in spots:
        offset = np.array([x, 0.0, z]) - view.center_world_m
        distance = float(np.hypot(offset[0], offset[2]))
        column = float(view.locate(np.array([[x, 0.0, z]]))[0, 0])
        half = radius_m / max(distance, 0.3) / view.step_rad
        top = view.floor_row(np.array(distance + 0.6 * radius_m))
        bottom = view.floor_row(np.array(max(distance - 2 * radius_m, 0.7 * distance)))
        corners = [(round(column - half), round(float(top))), (round(column + half), round(float(bottom)))]
        cv2.rectangle(seed, corners[0], corners[1], 1, thickness=-1)
    return seed.astype(bool)


def _upright_distance(
    view: GravityView, boundary: FloorBoundary, seen: np.ndarray, first_row: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, its sigma and whether it is known, of the first upright surface in each column."""
    lowest = view.rows - 1 - np.argmax(seen[::-1], axis=0)
    row = np.minimum(boundary.row, lowest + 1)
    no_floor = row > lowest
    distance_m = view.floor_distance_m(row - 0.5)
    finite = np.isfinite(distance_m)
    columns = np.arange(view.columns)
    if finite.any():
        distance_m = np.where(finite, distance_m, np.interp(columns, columns[finite], distance_m[finite]))
    else:
        distance_m = np.full(view.columns, view.camera_height_m)
    slope = (view.camera_height_m**2 + distance_m**2) / view.camera_height_m * view.step_rad
    sigma_m = slope * np.hypot(boundary.sigma_rows, 1.0) + 0.03 * distance_m + np.where(no_floor, 0.3 * distance_m, 0)
    return distance_m, sigma_m, finite & (row > first_row + 1)


def _cutouts(
    view: GravityView,
    image: np.ndarray,
    seen: np.ndarray,
    seed: np.ndarray,
    boundary: FloorBoundary,
    background_m: np.ndarray,
    config: PlanarSceneConfig,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Masks on the cylinder and distance per column of upright objects before the background, farthest first."""
    rows = np.arange(view.rows)[:, None]
    behind_row = np.ceil(view.floor_row(background_m)).astype(int)
    area = seen & (rows >= behind_row[None, :] + 1)
    above = rows < boundary.row[None, :]
    below = rows >= boundary.row[None, :] + _EDGE_ROWS
    unlike = (above & (boundary.log_ratio < 1.0)) | (below & (boundary.log_ratio < -1.5))
    strange = area & ~seed & unlike
    size = max(3, round(0.01 * view.columns) | 1)
    strange = cv2.morphologyEx(strange.astype(np.uint8), cv2.MORPH_OPEN, np.ones((size, size), np.uint8)).astype(bool)
    count, parts = cv2.connectedComponents(strange.astype(np.uint8), connectivity=4)
    found = []
    for index in range(1, count):
        part = parts == index
        if part.sum() < config.min_ratio * seen.sum():
            continue
        columns = np.flatnonzero(part.any(0))
        foot = view.rows - np.argmax(part[::-1, columns], axis=0)
        near_m = view.floor_distance_m(foot - 0.5)
        if not np.isfinite(near_m).all() or (near_m > 0.92 * background_m[columns]).mean() > 0.5:
            continue
        tallest = view.elevation_rad(np.zeros(1))[0]
        reach = np.arctan2(4.0 - view.camera_height_m, float(np.median(near_m)))
        top = int(np.clip((view.elevation_top_rad - min(reach, tallest)) / view.step_rad, 0, view.rows - 1))
        mask = grow_cutout(image, seen, part, ~strange & area, top)
        per_column = ground_contact_distance(
            near_m, view.azimuth_rad(columns), view.azimuth_rad(np.arange(view.columns))
        )
        mask &= rows <= view.floor_row(per_column)[None, :] + 1
        found.append((mask, per_column))
    return sorted(found, key=lambda item: -float(np.median(item[1])))


def _compose(
    view: GravityView,
    seen: np.ndarray,
    background_m: np.ndarray,
    sigma_m: np.ndarray,
    known: np.ndarray,
    cutouts: list[tuple[np.ndarray, np.ndarray]],
    config: PlanarSceneConfig,
) -> PlanarSceneProxy:
    shape = seen.shape
    distance = np.broadcast_to(background_m, shape).copy()
    sigma = np.broadcast_to(sigma_m, shape).copy()
    valid = np.broadcast_to(known & (background_m < 0.98 * config.far_m), shape).copy()
    layer = np.zeros(shape, dtype=np.int32)
    layer[np.arange(view.rows)[:, None] >= view.floor_row(background_m)[None, :]] = 1
    for index, (mask, near_m) in enumerate(cutouts):
        near = np.broadcast_to(near_m, shape)
        slope = (view.camera_height_m**2 + near**2) / view.camera_height_m * view.step_rad
        distance[mask], layer[mask], valid[mask] = near[mask], index + 2, True
        sigma[mask] = (2 * slope + 0.05 * near)[mask]
    grid = view.grid_of_pixels()
    pixel_layer = remap(layer.astype(np.float32), grid, nearest=True).astype(np.int32)
    on_floor = (pixel_layer == 1) & (view.ray_world[..., 1] < -1e-3)
    floor_depth = view.camera_height_m / np.maximum(-view.ray_world[..., 1], 1e-3)
    reach_m = remap(distance.astype(np.float32), grid, nearest=True).astype(np.float64)
    depth_m = np.where(on_floor, floor_depth, reach_m / view.ray_horizontal)
    floor_range = floor_depth * view.ray_horizontal
    floor_sigma = (view.camera_height_m**2 + floor_range**2) / view.camera_height_m * view.step_rad + 0.02 * floor_range
    height_m = view.camera_height_m + depth_m * view.ray_world[..., 1]
    upright_sigma = remap(sigma.astype(np.float32), grid, nearest=True) + 0.15 * np.maximum(height_m - 2.0, 0)
    sigma_pixel = np.where(on_floor, floor_sigma, upright_sigma) / view.ray_horizontal
    good = on_floor | remap(valid, grid, nearest=True)
    good &= np.isfinite(depth_m) & (depth_m > 0.05) & (depth_m < 2 * config.far_m) & (height_m < config.tallest_m)
    depth_m = np.where(np.isfinite(depth_m), np.clip(depth_m, 0.05, 4 * config.far_m), config.far_m)
    return PlanarSceneProxy(depth_m, np.clip(sigma_pixel, 1e-3, 4 * config.far_m), good, pixel_layer)
