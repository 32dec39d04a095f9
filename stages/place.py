"""Stage place: metric pose of every object mesh (paper 8.1).

Visible mesh points and the object's depth points are brought together by Chamfer distance over horizontal position, yaw
and scale. Objects stay upright and rest on the floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from video2anim.errors import StageError
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    BodyMotion,
    BodyTracks,
    InstanceMasks,
    MetricDepth,
    ObjectMesh,
    ObjectMeshes,
    PlacedObject,
    PlacedObjects,
)


@dataclass(frozen=True)
class PlaceConfig:
    """Starts and limits of the fit."""

    yaw_starts_deg: tuple[float, ...] = (-60.0, -30.0, 30.0, 60.0, 90.0, 180.0)
    """Yaws tried besides the first guess, relative to it, for meshes whose front is unknown."""
    extrusion_yaw_starts_deg: tuple[float, ...] = (-25.0, 25.0)
    """The same for extrusions, whose front comes from the picture."""
    points: int = 300
    """At most so many mesh points and depth points."""
    least_points: int = 30
    """Objects with fewer reliable depth pixels are not trusted."""
    largest_chamfer_m: float = 0.25
    """Objects that stay farther from their depth are not trusted."""


def place_objects(
    meshes: ObjectMeshes,
    masks: InstanceMasks,
    depth: MetricDepth,
    bodies: BodyTracks,
    config: PlaceConfig,
    ctx: StageContext,
) -> PlacedObjects:
    """Every object at its place. Those whose fit cannot be trusted keep their first guess or best fit and say why.

    Raises:
        StageError: there is no body (its camera lifts pixels into the world).
    """
    if not bodies.people:
        raise StageError("place: want at least one fitted body, got none; check stage humans")
    visible = {instance.object_id: instance.mask for instance in masks.instances}
    placed = []
    for done, found in enumerate(meshes.objects):
        points_m = _depth_points(visible[found.object_id], depth, bodies.people[0])
        placed.append(_place_one(found, points_m, depth, bodies.people[0], config, ctx))
        ctx.progress(done + 1, len(meshes.objects))
    measured = [(p.chamfer_before_m, p.chamfer_after_m) for p in placed if p.chamfer_before_m is not None]
    ctx.quality("objects", len(placed), "objects")
    ctx.quality("trusted", sum(p.trusted for p in placed), "objects", "higher")
    if measured:
        ctx.quality("chamfer_before", float(np.mean([before for before, _ in measured])), "m", "lower")
        ctx.quality("chamfer_after", float(np.mean([after for _, after in measured])), "m", "lower")
    return PlacedObjects(tuple(placed))


def _place_one(
    found: ObjectMesh,
    points_m: Float[np.ndarray, "points 3"],
    depth: MetricDepth,
    body: BodyMotion,
    config: PlaceConfig,
    ctx: StageContext,
) -> PlacedObject:
    from video2anim.geometry.placement import Placement, place

    if len(points_m) < config.least_points:
        fit = Placement(found.T_world_object, 1.0, np.nan, np.nan)
        problem = f"only {len(points_m)} reliable depth pixels (want {config.least_points}); pose is the first guess"
    else:
        turns = config.extrusion_yaw_starts_deg if found.method.startswith("extrusion") else config.yaw_starts_deg
        fit = place(
            found.mesh.vertices_m.astype(np.float64),
            found.mesh.faces,
            found.T_world_object,
            points_m,
            body.T_world_camera[0],
            body.intrinsics,
            yaw_starts_rad=tuple(np.deg2rad(turns)),
            rng=ctx.rng(f"place/{found.object_id}"),
            most_points=config.points,
        )
        far = fit.chamfer_after_m > config.largest_chamfer_m
        problem = f"mesh and depth stay {fit.chamfer_after_m:.2f} m apart" if far else ""
    if not problem and not depth.trusted:
        problem = "the scale of depth is not trusted"
    return PlacedObject(
        object_id=found.object_id,
        label=found.label,
        mesh=found.mesh,
        scale=fit.scale,
        T_world_object=fit.T_world_object,
        chamfer_before_m=fit.chamfer_before_m if np.isfinite(fit.chamfer_before_m) else None,
        chamfer_after_m=fit.chamfer_after_m if np.isfinite(fit.chamfer_after_m) else None,
        trusted=not problem,
        reason=problem or f"fitted to {len(points_m)} depth points",
    )


def _depth_points(
    visible: Bool[np.ndarray, "height width"], depth: MetricDepth, body: BodyMotion
) -> Float[np.ndarray, "points 3"]:
    """Reliable plate depth of the object in the world."""
    import cv2

    from video2anim.geometry.projection import backproject, transform_points

    height, width = depth.background_depth_m.shape
    share = cv2.resize(visible.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    chosen = (share > 0.5) & depth.background_valid
    points = backproject(depth.background_depth_m.astype(np.float64), body.intrinsics.resized(width, height))[chosen]
    return transform_points(body.T_world_camera[0], points)


STAGE = StageSpec("place", place_objects, version=1)
