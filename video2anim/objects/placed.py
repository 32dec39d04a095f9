"""Placed objects: a fitted form or a mesh fitted to its depth, resting on what is below it and free of collisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from trimesh.remesh import subdivide_to_size

from video2anim.geometry.scene_mesh import world_mesh
from video2anim.objects.collisions import PlacedSolid, resolve_collisions
from video2anim.objects.placement import Placement, place
from video2anim.types import ObjectMesh, PlacedObject, View

_EDGES = 50
"""Edges along the longest side of a mesh for the fit, which uses vertices: plain meshes have few."""
_RAISED_M = 0.05
"""Objects whose lower end is higher than this do not rest on the floor."""


def fitted_form(found: ObjectMesh, *, max_chamfer_m: float, min_outline_iou: float) -> PlacedObject:
    """A form at the pose of its fit; not trusted where it is far from its depth or covers little of its mask.

    Args:
        found: with `chamfer_m`, the distance of its depth points.
        max_chamfer_m: maximum of that distance.
        min_outline_iou: minimum IoU with the mask.
    """
    assert found.chamfer_m is not None
    problem = ""
    if found.chamfer_m > max_chamfer_m:
        problem = f"form and depth stay {found.chamfer_m:.2f} m apart"
    elif found.outline_iou is not None and found.outline_iou < min_outline_iou:
        problem = f"form and outline overlap by {found.outline_iou:.0%} only"
    return PlacedObject(
        found.object_id, found.label, found.mesh, 1.0, found.T_world_object, None, found.chamfer_m, not problem,
        problem or f"fitted as {found.method.removeprefix('form: ')}", found.position_sigma_m, found.yaw_sigma_rad,
        found.size_sigma, parts=found.parts, textures=found.textures,
    )  # fmt: skip


def fitted_by_chamfer(
    found: ObjectMesh,
    points_m: Float[np.ndarray, "points 3"],
    view: View,
    *,
    yaw_starts_deg: Sequence[float],
    points: int,
    min_points: int,
    max_chamfer_m: float,
    rng: np.random.Generator,
) -> PlacedObject:
    """Any other mesh, by the distance to its depth points.

    Args:
        found: mesh and first guess of its pose.
        points_m: depth points of the object, world frame.
        view: camera that sees them.
        yaw_starts_deg: yaws from which the fit starts, relative to the first guess.
        points: maximum number of mesh points and of depth points.
        min_points: objects with fewer depth points keep the first guess and are not trusted.
        max_chamfer_m: objects at a larger distance are not trusted.
        rng: draws the points.
    """
    if len(points_m) < min_points:
        fit = Placement(found.T_world_object, 1.0, np.nan, np.nan)
        problem = f"only {len(points_m)} reliable depth pixels (want {min_points}); pose is the first guess"
    else:
        vertices_m = found.mesh.vertices_m
        vertices_m, faces, *_ = subdivide_to_size(
            vertices_m.astype(np.float64), found.mesh.faces, float(np.ptp(vertices_m)) / _EDGES
        )
        yaw_starts_rad = tuple(np.deg2rad(yaw_starts_deg))
        fit = place(
            vertices_m, faces, found.T_world_object, points_m, view,
            yaw_starts_rad=yaw_starts_rad, rng=rng, max_points=points,
        )  # fmt: skip
        far = fit.chamfer_after_m > max_chamfer_m
        problem = f"mesh and depth stay {fit.chamfer_after_m:.2f} m apart" if far else ""
    return PlacedObject(
        found.object_id, found.label, found.mesh, fit.scale, fit.T_world_object, _known(fit.chamfer_before_m),
        _known(fit.chamfer_after_m), not problem, problem or f"fitted to {len(points_m)} depth points",
        _known(fit.position_sigma_m), _known(fit.yaw_sigma_rad), _known(fit.scale_sigma), parts=found.parts,
        textures=found.textures,
    )  # fmt: skip


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def without_collisions(
    placed: Sequence[PlacedObject], overlap_m: float, max_overlap_m: float
) -> tuple[list[PlacedObject], float, float]:
    """Objects on what carries them and apart, and the deepest overlap before and after.

    Args:
        placed: objects at their own places.
        overlap_m: objects that overlap more deeply are moved apart.
        max_overlap_m: objects that still overlap more deeply are not trusted.
    """
    solids = [
        PlacedSolid(
            world_mesh(item.mesh, item.T_world_object, item.scale),
            # An object that was not fitted yields to one that was.
            1.0 if item.position_sigma_m is None else item.position_sigma_m,
            raised=bool(item.T_world_object[1, 3] > _RAISED_M),
        )
        for item in placed
    ]
    found = resolve_collisions(solids, overlap_m)
    moved = []
    for item, state in zip(placed, found, strict=True):
        notes, trusted = [item.reason], item.trusted
        if state.rests_on is not None:
            notes.append(f"rests on object {placed[state.rests_on].object_id}")
        flat_m = float(np.hypot(*state.shift_m[[0, 2]]))
        if flat_m > 0:
            notes.append(f"moved by {flat_m:.2f} m out of its neighbor")
        if state.inside_of is not None and state.overlap_after_m > max_overlap_m:
            trusted = False
            notes.append(f"still {state.overlap_after_m:.2f} m inside object {placed[state.inside_of].object_id}")
        T_world_object = item.T_world_object.copy()
        T_world_object[:3, 3] += state.shift_m
        moved.append(replace(item, T_world_object=T_world_object, trusted=trusted, reason="; ".join(notes)))
    before_m = max((state.overlap_before_m for state in found), default=0.0)
    return moved, before_m, max((state.overlap_after_m for state in found), default=0.0)
