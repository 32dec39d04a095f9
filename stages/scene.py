"""Stage scene: objects, floor, walls and what is seen beyond, and a signed distance field, in one world frame.

A scan of the user's takes the place of all that.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from video2anim.pipeline.config import user_path
from video2anim.pipeline.options import limits, only_with, only_without
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundImage,
    BodyTracks,
    DepthClip,
    InstanceMasks,
    MetricDepth,
    PlacedObjects,
    RoomPiece,
    SceneModel,
    VideoClip,
)

_FAR_SCAN_M = 0.25
"""A scan that stays farther from the video's depth is probably not in place."""

_ShiftM = Annotated[float, limits("m", ge=-10_000_000, le=10_000_000)]
"""Scans in the coordinates of a survey lie far from the origin."""


@dataclass(frozen=True)
class SceneConfig:
    """Extent and detail of the scene."""

    sdf_spacing_m: Annotated[float, limits("m", ge=0.001, le=5)] = 0.06
    """Spacing of the distance field; wider where the field would have too many nodes."""
    max_nodes: Annotated[int, limits("nodes", ge=1000, le=100_000_000)] = 3_000_000
    """Upper limit of nodes of the distance field."""
    margin_m: Annotated[float, limits("m", ge=0, le=100)] = 1.0
    """Room and floor around the motion."""
    reach_m: Annotated[float, limits("m", ge=0, le=1000), only_with("scan", "")] = 3.0
    """Objects up to this far from the motion lie wholly in the distance field."""
    far_m: Annotated[float, limits("m", gt=0, le=10_000)] = 30.0
    """What is farther goes onto one backdrop behind everything; with a scan, depth beyond this does not count."""
    walked_m: Annotated[float, limits("m", ge=0, le=1000), only_with("scan", "")] = 0.5
    """An object in which a pelvis makes a longer way is in the wrong place: left out unless somebody rests on it."""
    supports: Annotated[bool, only_with("scan", "")] = True
    """Put a solid where a part of the body rested and no surface is near."""
    scan: str = user_path()
    """Mesh file of the room (meters, triangles facing the room), in place of what the video shows."""
    scan_up: Annotated[Literal["y", "z"], only_without("scan", "")] = "y"
    """The scan's upward axis."""
    scan_yaw_deg: Annotated[float, limits("degrees", ge=-360, le=360), only_without("scan", "")] = 0.0
    """Turn of the scan about the vertical that brings it roughly into the video's world."""
    scan_shift_m: Annotated[tuple[_ShiftM, _ShiftM, _ShiftM], only_without("scan", "")] = (0.0, 0.0, 0.0)
    """Shift after that turn; the world's origin is the floor under the person's first place."""
    scan_register: Annotated[bool, only_without("scan", "")] = True
    """Fit yaw and shift to the video's depth from there on."""


def build_scene(
    clip: VideoClip,
    placed: PlacedObjects,
    depth: MetricDepth,
    clip_depth: DepthClip,
    masks: InstanceMasks,
    background: BackgroundImage,
    config: SceneConfig,
    ctx: StageContext,
) -> SceneModel:
    """Everything the body can touch.

    Raises:
        StageError: no body has a valid frame (the scene is built around the motion).
        InputError: the scan cannot be read.
    """
    from video2anim.geometry.scene_mesh import world_mesh
    from video2anim.geometry.sdf import build_sdf_grid
    from video2anim.objects.carried import with_moved_objects
    from video2anim.objects.path import settled
    from video2anim.objects.pictures import pictures_of
    from video2anim.scene.backdrop import backdrop
    from video2anim.scene.field import field_bounds, field_spacing, motion_bounds, overlaps
    from video2anim.scene.ground import ground
    from video2anim.scene.inferred_supports import inferred_supports, rested_on, without_walked_through
    from video2anim.scene.view import relative_sigma

    bodies = depth.bodies
    motion_m = motion_bounds(bodies)
    if config.scan:
        return _scanned(motion_m, depth, bodies, config, ctx)
    rested = rested_on(bodies)
    pictures = pictures_of(clip, background)
    found = placed.objects if pictures is None else with_moved_objects(pictures, masks, bodies, placed.objects)
    moved = [item for item in found if item.path]
    still = [item for item in found if not item.path]
    kept, rejected = without_walked_through(
        still, rested, bodies, spacing_m=config.sdf_spacing_m, max_path_m=config.walked_m
    )
    stay = [item for item in map(settled, moved) if item is not None]
    supports, inferred = inferred_supports([*kept, *stay], rested, bodies) if config.supports else ([], [])
    for text in (*rejected, *inferred):
        ctx.warn(text)
    objects = [*kept, *supports]
    solids = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in (*objects, *stay)]
    bounds_m = field_bounds(motion_m, solids, config.margin_m, config.reach_m)
    spacing_m = field_spacing(bounds_m, config.sdf_spacing_m, config.max_nodes)
    near = [solid for solid in solids if overlaps(solid, bounds_m)]
    grid = build_sdf_grid(near, bounds_m, spacing_m, floor_y_m=0.0)
    seen = backdrop(depth, masks, background, config.far_m, relative_sigma(depth, clip_depth))
    around_m = motion_m[:, [0, 2]] + np.array([[-config.margin_m], [config.margin_m]])
    floor = ground(seen, background, around_m)
    ctx.quality("rejected_by_motion", len(still) - len(kept), "count")
    ctx.quality("inferred_supports", len(supports), "count")
    ctx.quality("objects_in_field", len(near), "count")
    origin_m = np.asarray(grid.origin_m)
    scene = SceneModel((*objects, *moved), floor, seen.pieces, grid.sdf_m, origin_m, float(spacing_m))
    _report(ctx, scene, len(moved))
    return scene


def _report(ctx: StageContext, scene: SceneModel, moved: int) -> None:
    ctx.quality("moved", moved, "count")
    ctx.quality("objects", len(scene.objects) - moved, "count")
    ctx.quality("sdf_spacing", scene.sdf_spacing_m, "m", "lower")
    ctx.quality("sdf_nodes", scene.sdf_m.size, "count")
    ctx.quality("background_faces", sum(len(piece.mesh.faces) for piece in scene.background), "count")
    ctx.quality("walls", sum(piece.name.startswith("wall") for piece in scene.background), "count")
    ctx.quality("openings", sum(len(piece.openings) for piece in scene.background), "count")


def _scanned(
    motion_m: Float[np.ndarray, "2 3"], depth: MetricDepth, bodies: BodyTracks, config: SceneConfig, ctx: StageContext
) -> SceneModel:
    """The user's scan as the only surface of the scene."""
    from dataclasses import replace

    from video2anim.artifacts.user_files import read_mesh_file
    from video2anim.geometry.projection import backproject, transform_points
    from video2anim.geometry.rotations import matrix_from_axis_angle
    from video2anim.geometry.scene_mesh import empty_mesh
    from video2anim.scene.field import field_spacing
    from video2anim.scene.scan import registered, scan_field

    scan = read_mesh_file(Path(config.scan))
    T_world_scan = np.eye(4)
    T_world_scan[:3, :3] = matrix_from_axis_angle(np.array([0.0, np.deg2rad(config.scan_yaw_deg), 0.0]))
    if config.scan_up == "z":
        T_world_scan[:3, :3] = T_world_scan[:3, :3] @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    T_world_scan[:3, 3] = config.scan_shift_m
    scan = replace(scan, vertices_m=transform_points(T_world_scan, scan.vertices_m))
    if config.scan_register:
        height, width = depth.background_depth_m.shape
        view = bodies.main_view.resized(width, height)
        known = depth.background_valid & (depth.background_depth_m < config.far_m)
        seen_m = backproject(depth.background_depth_m.astype(np.float64), view.intrinsics)[known]
        if len(seen_m):
            found = registered(scan, transform_points(view.T_world_camera, seen_m), ctx.rng("scene/scan"))
            scan = replace(scan, vertices_m=transform_points(found.T_world_scan, scan.vertices_m))
            ctx.quality("scan_to_depth_before", found.before_m, "m", "lower")
            ctx.quality("scan_to_depth", found.after_m, "m", "lower")
            if found.after_m > _FAR_SCAN_M:
                ctx.warn(
                    f"the scan stays {found.after_m:.2f} m from the video's depth (median); bring it nearer by "
                    "scene.scan_up, scene.scan_yaw_deg and scene.scan_shift_m, and look at `video2anim view`"
                )
    bounds_m = np.stack([motion_m[0] - config.margin_m, motion_m[1] + config.margin_m])
    bounds_m[0, 1], bounds_m[1, 1] = -0.3, max(bounds_m[1, 1], 2.0)
    spacing_m = field_spacing(bounds_m, config.sdf_spacing_m, config.max_nodes)
    grid = scan_field(scan, bounds_m, spacing_m)
    ctx.quality("sdf_spacing", spacing_m, "m", "lower")
    ctx.quality("scan_faces", len(scan.faces), "count")
    floor, room = RoomPiece("floor", empty_mesh()), RoomPiece("scan", scan)
    return SceneModel((), floor, (room,), grid.sdf_m, np.asarray(grid.origin_m), float(spacing_m))


STAGE = StageSpec("scene", build_scene, version=16)
