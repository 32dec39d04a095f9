"""Stage scene: objects, floor, walls and the background behind them, and a signed distance field, in one world frame.

A scan by the user replaces all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from video2anim.pipeline.config import user_path
from video2anim.pipeline.options import limits, only_with, only_without
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BackgroundImage,
    CameraEstimate,
    DepthClip,
    InstanceMasks,
    MetricDepth,
    PlacedObjects,
    RoomPiece,
    SceneModel,
    VideoClip,
)  # fmt: skip

_FAR_SCAN_M = 0.25
"""Mean distance of the depth from a registered scan above which a warning says that the scan is misplaced."""

_ShiftM = Annotated[float, limits("m", ge=-10_000_000, le=10_000_000)]  # national survey coordinates


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
    """Farther depth and objects go onto one backdrop behind everything; a scan is registered to nearer depth only."""
    walked_m: Annotated[float, limits("m", ge=0, le=1000), only_with("scan", "")] = 0.5
    """An object is rejected where the path of a pelvis inside it is longer, unless somebody rests on it."""
    supports: Annotated[bool, only_with("scan", "")] = True
    """Add a solid where a part of the body rested and no surface is near."""
    scan: str = user_path()
    """Mesh file of the room (meters, triangles facing the room), in place of what the video shows."""
    scan_up: Annotated[Literal["y", "z"], only_without("scan", "")] = "y"
    """The scan's upward axis."""
    scan_yaw_deg: Annotated[float, limits("degrees", ge=-360, le=360), only_without("scan", "")] = 0.0
    """Rotation of the scan about the vertical, roughly into the video's world."""
    scan_shift_m: Annotated[tuple[_ShiftM, _ShiftM, _ShiftM], only_without("scan", "")] = (0.0, 0.0, 0.0)
    """Translation after that rotation; the world's origin is on the floor below the person's first position."""
    scan_register: Annotated[bool, only_without("scan", "")] = True
    """Refine yaw and translation by the video's depth."""


def build_scene(
    clip: VideoClip,
    camera: CameraEstimate,
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
        StageError: no body has a valid frame: the scene is built around the motion.
        InputError: the scan cannot be read.
    """
    from video2anim.geometry.scene_mesh import world_mesh
    from video2anim.objects.path import settled
    from video2anim.objects.pictures import with_paths
    from video2anim.scene.backdrop import backdrop
    from video2anim.scene.field import motion_bounds, solid_field
    from video2anim.scene.ground import ground
    from video2anim.scene.inferred_supports import inferred_supports, rested_on, without_walked_through
    from video2anim.scene.view import nearer_than, relative_sigma

    bodies = depth.bodies
    motion_m = motion_bounds(bodies)
    if config.scan:
        return _scanned(motion_m, depth, config, ctx)
    found = nearer_than(placed.objects, bodies.main_view, config.far_m)
    if far := {item.object_id for item in placed.objects} - {item.object_id for item in found}:
        masks = replace(masks, instances=tuple(one for one in masks.instances if one.object_id not in far))
        ctx.warn(f"objects farther than {config.far_m:g} m are shown on the backdrop: {sorted(far)}")
    found = with_paths(found, clip, masks, background, bodies) if camera.is_static else found
    moved = [item for item in found if item.path]
    still = [item for item in found if not item.path]
    rested = rested_on(bodies)
    kept, rejected = without_walked_through(still, rested, bodies, config.sdf_spacing_m, config.walked_m)
    stay = [item for item in map(settled, moved) if item is not None]
    last_id = max((item.object_id for item in found), default=0)
    supports, inferred = inferred_supports([*kept, *stay], rested, bodies, last_id) if config.supports else ([], [])
    for text in (*rejected, *inferred):
        ctx.warn(text)
    objects = [*kept, *supports]
    solids = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in (*objects, *stay)]
    grid, in_field = solid_field(
        solids, motion_m, config.margin_m, config.reach_m, config.sdf_spacing_m, config.max_nodes
    )
    seen = backdrop(depth, masks, background, config.far_m, relative_sigma(depth, clip_depth))
    around_m = motion_m[:, [0, 2]] + np.array([[-config.margin_m], [config.margin_m]])
    floor = ground(seen, background, around_m, solids)
    counts = {
        "rejected_by_motion": len(still) - len(kept), "inferred_supports": len(supports), "objects_in_field": in_field,
        "moved": len(moved), "objects": len(objects), "sdf_nodes": grid.sdf_m.size, **seen.counts,
    }  # fmt: skip
    for key, count in counts.items():
        ctx.quality(key, count, "count")
    ctx.quality("sdf_spacing", grid.spacing_m, "m", "lower")
    return SceneModel((*objects, *moved), floor, seen.pieces, grid.sdf_m, grid.origin_m, float(grid.spacing_m))


def _scanned(
    motion_m: Float[np.ndarray, "2 3"], depth: MetricDepth, config: SceneConfig, ctx: StageContext
) -> SceneModel:
    """The user's scan as the only surface of the scene."""
    from video2anim.artifacts.user_files import read_mesh_file
    from video2anim.geometry.scene_mesh import empty_mesh
    from video2anim.scene.scan import field_around, moved_mesh, registered, scan_pose, visible_points

    placed = scan_pose(config.scan_up, config.scan_yaw_deg, config.scan_shift_m)
    scan = moved_mesh(read_mesh_file(Path(config.scan)), placed)
    seen_m = visible_points(depth, config.far_m)
    if config.scan_register and len(seen_m):
        found = registered(scan, seen_m, ctx.rng("scene/scan"))
        scan = moved_mesh(scan, found.T_world_scan)
        ctx.quality("scan_to_depth_before", found.before_m, "m", "lower")
        ctx.quality("scan_to_depth", found.after_m, "m", "lower")
        if found.after_m > _FAR_SCAN_M:
            ctx.warn(
                f"the scan stays {found.after_m:.2f} m from the video's depth (mean); bring it nearer by "
                "scene.scan_up, scene.scan_yaw_deg and scene.scan_shift_m, and look at `video2anim view`"
            )
    grid = field_around(scan, motion_m, config.margin_m, config.sdf_spacing_m, config.max_nodes)
    ctx.quality("sdf_spacing", grid.spacing_m, "m", "lower")
    ctx.quality("scan_faces", len(scan.faces), "count")
    floor, room = RoomPiece("floor", empty_mesh()), RoomPiece("scan", scan)
    return SceneModel((), floor, (room,), grid.sdf_m, np.asarray(grid.origin_m), float(grid.spacing_m))


STAGE = StageSpec("scene", build_scene, version=29)
