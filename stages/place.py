"""Stage place: metric pose of every object mesh (paper 8.1).

Forms have their place already. Of other meshes, visible points and the object's depth points are brought together by
Chamfer distance over horizontal position, yaw and scale. Objects stay upright, rest on the floor or on each other, and
do not run into each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from video2anim.pipeline.options import limits
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import (
    InstanceMasks,
    MetricDepth,
    ObjectMesh,
    ObjectMeshes,
    PlacedObject,
    PlacedObjects,
    View,
)

_FINENESS = 50
"""Edges are shorter than this part of the object for the fit."""
_TurnDeg = Annotated[float, limits("degrees", ge=-360, le=360)]


@dataclass(frozen=True)
class PlaceConfig:
    """Starts and limits of the fit."""

    yaw_starts_deg: tuple[_TurnDeg, ...] = (-60.0, -30.0, 30.0, 60.0, 90.0, 180.0)
    """Yaws tried besides the first guess, relative to it, for meshes whose front is unknown."""
    points: Annotated[int, limits(ge=1, le=1_000_000)] = 300
    """At most so many mesh points and depth points."""
    min_points: Annotated[int, limits(ge=1, le=1_000_000)] = 30
    """Objects with fewer reliable depth pixels are not trusted."""
    max_chamfer_m: Annotated[float, limits("m", ge=0, le=100)] = 0.25
    """Objects that stay farther from their depth are not trusted."""
    min_outline_iou: Annotated[float, limits(ge=0, le=1)] = 0.5
    """Nor are forms that cover less of their outline."""
    overlap_m: Annotated[float, limits("m", ge=0, le=100)] = 0.03
    """Objects deeper in each other than this are moved apart."""
    max_overlap_m: Annotated[float, limits("m", ge=0, le=100)] = 0.1
    """Objects that stay deeper in another than this are not trusted."""


def place_objects(
    meshes: ObjectMeshes,
    masks: InstanceMasks,
    depth: MetricDepth,
    config: PlaceConfig,
    ctx: StageContext,
) -> PlacedObjects:
    """Every object at its place. Those whose fit cannot be trusted keep their first guess or best fit and say why."""
    from video2anim.objects.backproject import ObjectBackprojector

    lifter = ObjectBackprojector(masks, depth)
    placed = []
    for done, found in enumerate(meshes.objects):
        if found.chamfer_m is not None:
            item = _fitted_form(found, found.chamfer_m, config)
        else:
            points_m = lifter.lift(found.object_id).points_world_m
            item = _by_chamfer(found, points_m, depth.bodies.main_view, config, ctx)
        if item.trusted and not depth.trusted:
            item = replace(item, trusted=False, reason="the scale of depth is not trusted")
        placed.append(replace(item, distance_sigma=depth.object_sigma[str(found.object_id)]))
        ctx.progress(done + 1, len(meshes.objects))
    placed = _without_collisions(placed, config, ctx)
    before_m = [p.chamfer_before_m for p in placed if p.chamfer_before_m is not None]
    after_m = [p.chamfer_after_m for p in placed if p.chamfer_after_m is not None]
    ctx.quality("objects", len(placed), "count")
    ctx.quality("reliable", sum(p.trusted for p in placed), "count", "higher")
    if before_m and after_m:
        ctx.quality("chamfer_before", float(np.mean(before_m)), "m", "lower")
        ctx.quality("chamfer_after", float(np.mean(after_m)), "m", "lower")
    return PlacedObjects(tuple(placed))


def _fitted_form(found: ObjectMesh, chamfer_m: float, config: PlaceConfig) -> PlacedObject:
    """A form where its fit has it."""
    problem = ""
    if chamfer_m > config.max_chamfer_m:
        problem = f"form and depth stay {chamfer_m:.2f} m apart"
    elif found.outline_iou is not None and found.outline_iou < config.min_outline_iou:
        problem = f"form and outline overlap by {found.outline_iou:.0%} only"
    return PlacedObject(
        found.object_id, found.label, found.mesh, 1.0, found.T_world_object, None, chamfer_m, not problem,
        problem or f"fitted as {found.method.removeprefix('form: ')}", found.position_sigma_m, found.yaw_sigma_rad,
        found.size_sigma, parts=found.parts, textures=found.textures,
    )  # fmt: skip


def _by_chamfer(
    found: ObjectMesh,
    points_m: Float[np.ndarray, "points 3"],
    view: View,
    config: PlaceConfig,
    ctx: StageContext,
) -> PlacedObject:
    """Any other mesh, by the distance to its depth points."""
    from trimesh.remesh import subdivide_to_size

    from video2anim.objects.placement import Placement, place

    if len(points_m) < config.min_points:
        fit = Placement(found.T_world_object, 1.0, np.nan, np.nan)
        problem = f"only {len(points_m)} reliable depth pixels (want {config.min_points}); pose is the first guess"
    else:
        # The fit goes by vertices, of which plain meshes have few.
        vertices_m, faces, *_ = subdivide_to_size(
            found.mesh.vertices_m.astype(np.float64), found.mesh.faces, float(np.ptp(found.mesh.vertices_m)) / _FINENESS
        )
        fit = place(
            vertices_m,
            faces,
            found.T_world_object,
            points_m,
            view,
            yaw_starts_rad=tuple(np.deg2rad(config.yaw_starts_deg)),
            rng=ctx.rng(f"place/{found.object_id}"),
            max_points=config.points,
        )
        far = fit.chamfer_after_m > config.max_chamfer_m
        problem = f"mesh and depth stay {fit.chamfer_after_m:.2f} m apart" if far else ""
    return PlacedObject(
        found.object_id, found.label, found.mesh, fit.scale, fit.T_world_object, _known(fit.chamfer_before_m),
        _known(fit.chamfer_after_m), not problem, problem or f"fitted to {len(points_m)} depth points",
        _known(fit.position_sigma_m), _known(fit.yaw_sigma_rad), _known(fit.scale_sigma), parts=found.parts,
        textures=found.textures,
    )  # fmt: skip


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _without_collisions(placed: list[PlacedObject], config: PlaceConfig, ctx: StageContext) -> list[PlacedObject]:
    """Objects on what carries them, and apart."""
    from video2anim.geometry.scene_mesh import world_mesh
    from video2anim.objects.collisions import PlacedSolid, resolve_collisions

    standing = [
        PlacedSolid(
            world_mesh(item.mesh, item.T_world_object, item.scale),
            # What was not fitted gives way to what was.
            1.0 if item.position_sigma_m is None else item.position_sigma_m,
            raised=bool(item.T_world_object[1, 3] > 0.05),
        )
        for item in placed
    ]
    found = resolve_collisions(standing, config.overlap_m)
    moved = []
    for item, state in zip(placed, found, strict=True):
        notes, trusted = [item.reason], item.trusted
        if state.rests_on is not None:
            notes.append(f"rests on object {placed[state.rests_on].object_id}")
        flat_m = float(np.hypot(*state.shift_m[[0, 2]]))
        if flat_m > 0:
            notes.append(f"moved by {flat_m:.2f} m out of its neighbor")
        if state.inside_of is not None and state.overlap_after_m > config.max_overlap_m:
            trusted = False
            notes.append(f"still {state.overlap_after_m:.2f} m inside object {placed[state.inside_of].object_id}")
        T_world_object = item.T_world_object.copy()
        T_world_object[:3, 3] += state.shift_m
        moved.append(replace(item, T_world_object=T_world_object, trusted=trusted, reason="; ".join(notes)))
    ctx.quality("deepest_overlap_before", max((s.overlap_before_m for s in found), default=0.0), "m", "lower")
    ctx.quality("deepest_overlap", max((s.overlap_after_m for s in found), default=0.0), "m", "lower")
    return moved


STAGE = StageSpec("place", place_objects, version=10)
