"""Movable objects of a scene: their solids and position covariances for the solve, and the scene after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from scenemi.postprocess.solids import MovableSolid, Solids
from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import REACH_M, touches
from video2anim.geometry.moving_field import MovingField
from video2anim.geometry.scene_mesh import world_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.objects.path import holding, settled
from video2anim.objects.rest import TOP_SIGMA_M
from video2anim.scene.supports import SUPPORT
from video2anim.types import BodyMotion, PlacedObject, SceneModel

_FAR_M = 2 * REACH_M
"""Range of the distance fields: contacts reach half of it, and normals need one more spacing."""
_SLAB_SPACING_M = 0.02
"""Spacing of the field of an inferred support: a slab of 5 cm is thinner than the spacing of the scene's field."""


@dataclass(frozen=True, slots=True)
class PlaceUncertainty:
    """Position uncertainty of the objects."""

    objects_move: bool
    """False: the scene is fixed."""
    across_ratio: float
    """Standard deviation across the horizontal line of sight, over the distance."""


def scene_field(scene: SceneModel) -> SdfGrid:
    """Distance field of the scene."""

    return SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)


def movable_solids(scene: SceneModel, camera_m: Float[np.ndarray, "3"], uncertainty: PlaceUncertainty) -> Solids:
    """The objects, which move mostly along their horizontal lines of sight; the fixed scene where none may move.

    An object with a path is one of them if it rests in one place for more than half of the clip.
    """
    standing = [item for item in map(settled, scene.objects) if item is not None]
    if not standing or not uncertainty.objects_move:
        return Solids(scene_field(scene), floor=False)
    movable = []
    for item in standing:
        solid = world_mesh(item.mesh, item.T_world_object, item.scale)
        bounds_m = np.stack([solid.vertices_m.min(0) - 0.3, solid.vertices_m.max(0) + 0.3])
        inferred = item.label == SUPPORT
        finest_m = min(_SLAB_SPACING_M, scene.sdf_spacing_m) if inferred else scene.sdf_spacing_m
        spacing_m = max(finest_m, float(np.ptp(bounds_m, axis=0).max()) / 60)
        away_m = 0.5 * bounds_m.sum(0) - camera_m
        away_m[1] = 0.0
        field = build_sdf_grid([solid], bounds_m, spacing_m, floor_y_m=None, reach_m=_FAR_M)
        along = item.distance_sigma**2 * np.outer(away_m, away_m)
        across = uncertainty.across_ratio**2 * (away_m @ away_m) * np.diag([1.0, 0.0, 1.0])
        covariance_m2 = along + across + np.diag([0.0, TOP_SIGMA_M**2, 0.0])
        movable.append(MovableSolid(field, TOP_SIGMA_M**2 * np.eye(3) if inferred else covariance_m2))
    return Solids(None, tuple(movable))


def moved_scene(scene: SceneModel, solids: Solids, moved_m: Float[np.ndarray, "solids 3"]) -> SceneModel:
    """The scene with its objects at the solved places; the same scene where none moved."""
    if not moved_m.any():
        return scene
    objects, ways_m = [], iter(moved_m)
    for item in scene.objects:
        if settled(item) is None:
            objects.append(item)
            continue
        way_m = next(ways_m)
        paths = tuple(replace(path, T_world_object=_shifted(path.T_world_object, way_m)) for path in item.path)
        objects.append(replace(item, T_world_object=_shifted(item.T_world_object, way_m), path=paths))
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in scene.sdf_m.shape), indexing="ij"), -1)
    slabs = [solids.distance_m(scene.sdf_origin_m + scene.sdf_spacing_m * slab, moved_m)[0] for slab in nodes]
    return replace(scene, objects=tuple(objects), sdf_m=np.stack(slabs).astype(np.float32))


def _shifted(T: Float[np.ndarray, "*frames 4 4"], way_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*frames 4 4"]:
    moved = T.copy()
    moved[..., :3, 3] += way_m
    return moved


def moving_fields(scene: SceneModel) -> tuple[MovingField, ...]:
    """Fields of the objects that somebody moves."""
    fields = []
    for item in scene.objects:
        if item.path:
            solid = world_mesh(item.mesh, np.eye(4), item.scale)
            bounds_m = np.stack([solid.vertices_m.min(0) - 0.1, solid.vertices_m.max(0) + 0.1])
            spacing_m = max(_SLAB_SPACING_M, float(np.ptp(bounds_m, axis=0).max()) / 60)
            field = build_sdf_grid([solid], bounds_m, spacing_m, floor_y_m=None, reach_m=_FAR_M)
            fields.append(MovingField(field, np.asarray(item.path[0].T_world_object)))
    return tuple(fields)


def with_scene_contacts(
    motion: BodyMotion, scene: SdfGrid, moving: Sequence[MovingField], objects: Sequence[PlacedObject]
) -> BodyMotion:
    """A solved motion with its contacts in the scene in place of the observed ones; a hand that holds an object touches
    it."""
    contact = touches(motion, shaped_body(motion.shape), scene, motion.contact, moving)
    return replace(motion, contact=np.where(holding(objects, motion), 1.0, contact))
