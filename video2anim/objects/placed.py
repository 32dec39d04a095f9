"""Placed objects: a fitted form or a mesh fitted to its depth, resting on what is below it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from trimesh.remesh import subdivide_to_size

from video2anim.geometry.scene_mesh import world_mesh
from video2anim.objects.placement import Placement, place
from video2anim.types import Mesh, ObjectMesh, PlacedObject, View

_EDGES = 50
"""Edges along the longest side of a mesh for the fit, which uses vertices: plain meshes have few."""
_RAISED_M = 0.05
"""Objects whose lower end is higher than this do not rest on the floor."""
UNDER_M = 0.25
"""Maximum vertical displacement to rest on what is below: the error of depth of a table at 4 m."""
_LEVEL, _CARRIED = 0.5, 0.3
"""Surfaces within 60 degrees of level carry, and are below at least this share of the points of a footprint."""


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


def put_down(placed: Sequence[PlacedObject]) -> list[PlacedObject]:
    """Raised objects on the highest surface below their footprint that is within `UNDER_M` of their lower end."""
    done = list(placed)
    meshes = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in placed]
    lowest_m = [float(mesh.vertices_m[:, 1].min()) for mesh in meshes]
    for number in np.argsort(lowest_m):
        item = placed[number]
        if item.T_world_object[1, 3] <= _RAISED_M:
            continue
        below = [(top_m, k) for k, mesh in enumerate(meshes) if k != number
                 and (top_m := _top_below_m(meshes[number], mesh)) is not None]  # fmt: skip
        if not below:
            continue
        top_m, under = max(below)
        T_world_object = item.T_world_object.copy()
        T_world_object[1, 3] += top_m - lowest_m[number]
        reason = f"{item.reason}; rests on object {placed[under].object_id}"
        done[number] = replace(item, T_world_object=T_world_object, reason=reason)
        meshes[number] = world_mesh(item.mesh, T_world_object, item.scale)
    return done


def _top_below_m(raised: Mesh, other: Mesh) -> float | None:
    """Height of the other's surface below an object's footprint, tested at nine points; None if there is none near."""
    import trimesh

    low, high = raised.vertices_m.min(0).astype(np.float64), raised.vertices_m.max(0)
    center, half = 0.5 * (low + high), 0.3 * (high - low)
    starts = np.array([[center[0] + a * half[0], low[1] + UNDER_M, center[2] + b * half[2]]
                       for a in (-1, 0, 1) for b in (-1, 0, 1)])  # fmt: skip
    mesh = trimesh.Trimesh(other.vertices_m, other.faces, process=False)
    down = np.tile([0.0, -1.0, 0.0], (len(starts), 1))
    hits, _, faces = mesh.ray.intersects_location(starts, down, multiple_hits=False)
    tops_m = hits[mesh.face_normals[faces, 1] > _LEVEL, 1]
    if len(tops_m) < _CARRIED * len(starts):
        return None
    top_m = float(np.median(tops_m))
    return top_m if abs(top_m - low[1]) <= UNDER_M else None
