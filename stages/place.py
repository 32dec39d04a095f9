"""Stage place: metric pose of every object mesh (SceneMI, supplement section 8.1).

Forms come with their pose. Other meshes are fitted to the depth points of the object: Chamfer distance of their visible
points over horizontal position, yaw and scale. Objects stay upright and rest on the floor or on each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    InstanceMasks,
    MetricDepth,
    ObjectMeshes,
    PlacedObjects,
)

_TurnDeg = Annotated[float, limits("degrees", ge=-360, le=360)]


@dataclass(frozen=True)
class PlaceConfig:
    """Starts and limits of the fit."""

    yaw_starts_deg: tuple[_TurnDeg, ...] = (-60.0, -30.0, 30.0, 60.0, 90.0, 180.0)
    """Yaws from which the fit starts besides the first guess, relative to it: the front of a mesh is unknown."""
    points: Annotated[int, limits(ge=1, le=1_000_000)] = 300
    """Maximum number of mesh points and of depth points."""
    min_points: Annotated[int, limits(ge=1, le=1_000_000)] = 30
    """Objects with fewer reliable depth pixels are not trusted."""
    max_chamfer_m: Annotated[float, limits("m", ge=0, le=100)] = 0.25
    """Objects at a larger Chamfer distance from their depth are not trusted."""
    min_outline_iou: Annotated[float, limits(ge=0, le=1)] = 0.5
    """Forms with a smaller IoU with their mask are not trusted."""


def place_objects(
    meshes: ObjectMeshes,
    masks: InstanceMasks,
    depth: MetricDepth,
    config: PlaceConfig,
    ctx: StageContext,
) -> PlacedObjects:
    """Every object at its place. Those whose fit is not trusted keep their first guess or best fit and a reason."""
    from video2anim.objects.backproject import ObjectBackprojector
    from video2anim.objects.placed import fitted_by_chamfer, fitted_form, put_down

    lifter = ObjectBackprojector(masks, depth)
    placed = []
    for done, found in enumerate(meshes.objects):
        if found.chamfer_m is not None:
            item = fitted_form(found, max_chamfer_m=config.max_chamfer_m, min_outline_iou=config.min_outline_iou)
        else:
            item = fitted_by_chamfer(
                found,
                lifter.lift(found.object_id).points_world_m,
                depth.bodies.main_view,
                yaw_starts_deg=config.yaw_starts_deg,
                points=config.points,
                min_points=config.min_points,
                max_chamfer_m=config.max_chamfer_m,
                rng=ctx.rng(f"place/{found.object_id}"),
            )
        if item.trusted and not depth.trusted:
            item = replace(item, trusted=False, reason="the scale of depth is not trusted")
        placed.append(replace(item, distance_sigma=depth.object_sigma[str(found.object_id)]))
        ctx.progress(done + 1, len(meshes.objects))
    placed = put_down(placed)
    before_m = [p.chamfer_before_m for p in placed if p.chamfer_before_m is not None]
    after_m = [p.chamfer_after_m for p in placed if p.chamfer_after_m is not None]
    ctx.quality("objects", len(placed), "count")
    ctx.quality("reliable", sum(p.trusted for p in placed), "count", "higher")
    if before_m and after_m:
        ctx.quality("chamfer_before", float(np.mean(before_m)), "m", "lower")
        ctx.quality("chamfer_after", float(np.mean(after_m)), "m", "lower")
    return PlacedObjects(tuple(placed))


STAGE = StageSpec("place", place_objects, version=11)
