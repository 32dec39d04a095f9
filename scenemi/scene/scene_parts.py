"""A scene of a file as something solid: what is filled, where the floor is, and what does not fit the keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.voxel_sdf import SCANNED_FLOOR_M
from scenemi.scene.voxels import DEFAULT_GRID
from video2anim.errors import InputError

SIGHT_M = DEFAULT_GRID.reach_m
"""The model sees this far from the first root of each window."""
MAX_SCENE_M = 1000.0
"""What is larger is in another unit than meters."""


@dataclass(frozen=True, slots=True, eq=False)
class ScenePart:
    """One mesh or cloud of points of a scene, in the world frame."""

    vertices_m: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    """Empty for a cloud of points."""


def expect_scene(where: str, parts: tuple[ScenePart, ...]) -> tuple[ScenePart, ...]:
    """The parts that hold something.

    Raises:
        InputError: nothing in any, NaN, broken faces, or other units than meters.
    """
    kept = tuple(part for part in parts if len(part.vertices_m))
    if not kept:
        raise InputError(f"{where}: an empty scene, neither faces nor points; leave --scene out for a bare floor")
    for part in kept:
        if part.vertices_m.ndim != 2 or part.vertices_m.shape[1] != 3:
            raise InputError(f"{where}: want points of shape (N, 3), got {part.vertices_m.shape}")
        if not np.isfinite(part.vertices_m).all():
            raise InputError(f"{where}: the scene holds NaN or infinity; remove such points")
        if len(part.faces) and (part.faces.min() < 0 or part.faces.max() >= len(part.vertices_m)):
            raise InputError(f"{where}: faces point at vertices that are not there")
    size_m = float(np.ptp(_all_points(kept), axis=0).max())
    if size_m > MAX_SCENE_M:
        raise InputError(f"{where}: want a scene in meters, got one of {size_m:.0f} across; scale it first")
    return kept


def geometry_of(parts: tuple[ScenePart, ...], roots_m: Float[np.ndarray, "keyframes 3"]) -> SceneGeometry:
    """All parts and an endless floor at y = 0.

    The inside of a closed mesh is solid (furniture), unless most keyframes stand in it (the shell of a room).
    """
    geometry = SceneGeometry.floor()
    for part in parts:
        geometry = SceneGeometry((*geometry.parts, *_solid(part, roots_m).parts))
    return geometry


def _solid(part: ScenePart, roots_m: np.ndarray) -> SceneGeometry:
    if len(part.faces) == 0:
        return SceneGeometry.from_points(part.vertices_m)
    filled = SceneGeometry.from_mesh(part.vertices_m, part.faces, fill=True)
    inside = filled.nearest_within(roots_m, 0.0)[1] == 0
    return SceneGeometry.from_mesh(part.vertices_m, part.faces) if inside.mean() > 0.5 else filled


def notes_on(parts: tuple[ScenePart, ...], roots_m: Float[np.ndarray, "keyframes 3"]) -> list[str]:
    """Sentences on what a user may not expect: no floor at y = 0, or no part of the scene near the keyframes."""
    points_m = _all_points(parts)
    notes = []
    low_m = float(np.percentile(points_m[:, 1], 0.5))
    if low_m > SCANNED_FLOOR_M:
        notes.append(f"the scene has no floor (lowest at y = {low_m:.2f} m); the plane y = 0 is taken for it")
    elif low_m < -SCANNED_FLOOR_M:
        notes.append(
            f"the scene reaches down to y = {low_m:.2f} m; the floor is taken to be y = 0, move it if that is wrong"
        )
    level = [0, 2]
    gap_m = np.maximum(points_m.min(0) - roots_m, roots_m - points_m.max(0))[:, level].max(1)
    beyond = int((gap_m > SIGHT_M).sum())
    if beyond:
        notes.append(
            f"{beyond} of {len(roots_m)} keyframes are more than {SIGHT_M:.1f} m outside the scene, which has no "
            "influence there; check that both are in meters, in one frame"
        )
    return notes


def _all_points(parts: tuple[ScenePart, ...]) -> Float[np.ndarray, "points 3"]:
    used = [part.vertices_m[np.unique(part.faces)] if len(part.faces) else part.vertices_m for part in parts]
    return np.concatenate(used)
