"""Stage scene: objects, floor, room surface and a signed distance field, in one world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from video2anim.errors import StageError
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundPlate,
    BodyTracks,
    InstanceMasks,
    Mesh,
    MetricDepth,
    PlacedObjects,
    SceneModel,
)


@dataclass(frozen=True)
class SceneConfig:
    """Extent and detail of the scene."""

    sdf_spacing_m: float = 0.06
    """Spacing of the distance field; wider where the field would have too many nodes."""
    most_nodes: int = 3_000_000
    """Upper limit of nodes of the distance field."""
    margin_m: float = 1.0
    """Room around the motion."""
    reach_m: float = 3.0
    """Objects up to this far from the motion lie wholly in the distance field."""
    far_m: float = 30.0
    """Room surface beyond this depth is left out."""
    background_long_side_px: int = 192
    """Resolution of the room surface."""


def build_scene(
    placed: PlacedObjects,
    depth: MetricDepth,
    masks: InstanceMasks,
    plate: BackgroundPlate,
    bodies: BodyTracks,
    config: SceneConfig,
    ctx: StageContext,
) -> SceneModel:
    """Everything the body can touch.

    Raises:
        StageError: no body has a valid frame (the scene is built around the motion).
    """
    from video2anim.geometry.scene_mesh import floor_patch, world_mesh
    from video2anim.geometry.sdf import build_sdf_grid

    motion_m = _motion_bounds(bodies)
    body = bodies.people[0]
    solids = [world_mesh(p.mesh, p.T_world_object, p.scale) for p in placed.objects]
    bounds_m = _field_bounds(motion_m, solids, config)
    spacing_m = _field_spacing(bounds_m, config)
    near = [solid for solid in solids if _overlap(solid, bounds_m)]
    grid = build_sdf_grid(near, bounds_m, spacing_m, floor_y_m=0.0)
    low, high = bounds_m[:, [0, 2]]
    floor = floor_patch(low, high, plate.plate_rgb, masks.floor_mask, body.T_world_camera[0], body.intrinsics)
    background = _background(depth, masks, plate, bodies, config)
    ctx.quality("objects", len(placed.objects), "objects")
    ctx.quality("objects_in_field", len(near), "objects")
    ctx.quality("sdf_spacing", spacing_m, "m", "lower")
    ctx.quality("sdf_nodes", grid.sdf_m.size, "nodes")
    ctx.quality("background_faces", len(background.faces), "faces")
    return SceneModel(placed.objects, floor, background, grid.sdf_m, np.asarray(grid.origin_m), float(spacing_m))


def _motion_bounds(bodies: BodyTracks) -> Float[np.ndarray, "2 3"]:
    joints = [body.joints_world_m[body.valid].reshape(-1, 3) for body in bodies.people]
    points = np.concatenate(joints) if joints else np.zeros((0, 3))
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        raise StageError("scene: want a body with at least one valid frame, got none; check stage humans")
    return np.stack([points.min(0), points.max(0)])


def _field_bounds(
    motion_m: Float[np.ndarray, "2 3"], solids: list[Mesh], config: SceneConfig
) -> Float[np.ndarray, "2 3"]:
    """Motion with a margin, and the objects within reach of it; from just under the floor to above the highest joint."""
    low, high = motion_m[0] - config.margin_m, motion_m[1] + config.margin_m
    for solid in solids:
        box_low, box_high = solid.vertices_m.min(0).astype(float), solid.vertices_m.max(0).astype(float)
        gap = np.maximum(np.maximum(box_low - motion_m[1], motion_m[0] - box_high), 0)[[0, 2]]
        if np.hypot(*gap) <= config.reach_m:
            low, high = np.minimum(low, box_low - 0.2), np.maximum(high, box_high + 0.2)
    low[1] = -0.3
    high[1] = max(high[1], 2.0)
    return np.stack([low, high])


def _field_spacing(bounds_m: Float[np.ndarray, "2 3"], config: SceneConfig) -> float:
    """The wanted spacing, or the finest that stays within the limit of nodes."""
    spacing_m = config.sdf_spacing_m
    while np.prod(np.ceil(np.ptp(bounds_m, axis=0) / spacing_m) + 1) > config.most_nodes:
        spacing_m *= 1.05
    return spacing_m


def _overlap(solid: Mesh, bounds_m: Float[np.ndarray, "2 3"]) -> bool:
    if not len(solid.faces):
        return False
    low, high = solid.vertices_m.min(0), solid.vertices_m.max(0)
    return bool((low <= bounds_m[1]).all() and (high >= bounds_m[0]).all())


def _background(
    depth: MetricDepth, masks: InstanceMasks, plate: BackgroundPlate, bodies: BodyTracks, config: SceneConfig
) -> Mesh:
    """Room surface: reliable plate depth that is neither floor nor object nor far away."""
    import cv2

    from video2anim.geometry.scene_mesh import room_surface

    height, width = depth.background_depth_m.shape
    shrink = min(1.0, config.background_long_side_px / max(height, width))
    size = (max(2, round(width * shrink)), max(2, round(height * shrink)))
    objects = np.zeros(masks.floor_mask.shape, dtype=bool)
    for instance in masks.instances:
        objects |= instance.mask
    depth_m = cv2.resize(depth.background_depth_m.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    valid = cv2.resize(depth.background_valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
    wanted = valid & (depth_m < config.far_m) & ~_touches(masks.floor_mask, size, 0.75) & ~_touches(objects, size, 0.25)
    rgb = cv2.resize(plate.plate_rgb, size, interpolation=cv2.INTER_AREA)
    body = bodies.people[0]
    return room_surface(
        depth_m.astype(np.float64), wanted, rgb, body.T_world_camera[0], body.intrinsics.resized(*size)
    )


def _touches(mask: Bool[np.ndarray, "height width"], size: tuple[int, int], share: float) -> np.ndarray:
    import cv2

    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > share


STAGE = StageSpec("scene", build_scene, version=1)
