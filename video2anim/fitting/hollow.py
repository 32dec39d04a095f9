"""Take out of an object what the observed body was in: nobody sits inside a solid sofa."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from video2anim.body.anny_body import shaped_body
from video2anim.body.skeleton import forward_kinematics
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.geometry.solid_mesh import outward, simplified
from video2anim.geometry.visible import vertex_normals
from video2anim.types.motion import BodyMotion
from video2anim.types.scene import Mesh

_NODES_ALONG = 56
_FRAME_STEP = 2
_MOST_LOOKS = 100
_VERTEX_STRIDE = 4
_DEEPEST_M = 0.2
_VOTES = 2
"""Looked-at frames in which the body must be at a place for it to be free: one is not believed."""
_LEAST_PIECE = 0.1
"""Pieces of the rest below this share of the largest are dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Hollowed:
    """What is left of an object."""

    mesh: Mesh
    left_ratio: float
    """Share of its volume."""


def hollowed(solid: Mesh, motions: Sequence[BodyMotion], *, margin_m: float, most_faces: int) -> Hollowed | None:
    """The object without the places that bodies were in, deeper than the margin; None if nothing is left.

    Args:
        solid: In the world.
        motions: Observed bodies; every second valid frame is looked at, of long clips about a hundred.
        margin_m: Skin may sink in so far: it is soft, as is what people sit on, and both are uncertain.
        most_faces: Of the result.
    """
    low, high = solid.vertices_m.min(0).astype(np.float64), solid.vertices_m.max(0).astype(np.float64)
    spacing_m = max(0.015, float((high - low).max()) / _NODES_ALONG)
    bounds_m = np.stack([low - 2 * spacing_m, high + 2 * spacing_m])
    field = build_sdf_grid([solid], bounds_m, spacing_m, floor_y_m=None)
    solid_nodes = np.argwhere(field.sdf_m < 2 * spacing_m)
    places_m = field.origin_m + spacing_m * solid_nodes
    body_m = np.concatenate([_deepest(places_m, motion) for motion in motions], 1)
    inside_m = np.partition(body_m, _VOTES - 1, axis=1)[:, _VOTES - 1]
    free = field.sdf_m.astype(np.float64).copy()
    at = tuple(solid_nodes.T)
    before = int((free < 0).sum())
    free[at] = np.maximum(free[at], -inside_m - margin_m)
    free, after = _main_pieces(free, spacing_m)
    if before == 0 or after == 0:
        return None
    return Hollowed(_surface(free, field.origin_m, spacing_m, solid, most_faces), after / before)


def _deepest(places_m: Float[np.ndarray, "places 3"], motion: BodyMotion) -> Float[np.ndarray, "places votes"]:
    """The smallest signed distances to the body's skin, negative inside; large where it never came near."""
    far = np.full((len(places_m), _VOTES), 1.0)
    frames = np.flatnonzero(motion.valid)
    frames = frames[:: max(_FRAME_STEP, len(frames) // _MOST_LOOKS)]
    if len(frames) == 0:
        return far
    body = shaped_body(motion.shape)
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint[frames], motion.T_world_root[frames, :3, 3], motion.rest_joints_m
    )
    box = np.stack([places_m.min(0), places_m.max(0)])
    chosen: Int[np.ndarray, "chosen"] = np.arange(0, len(body.rest_vertices_m), _VERTEX_STRIDE)
    for k in range(len(frames)):
        reach = np.stack([joints_m[k].min(0) - 0.3, joints_m[k].max(0) + 0.3])
        if (reach[0] > box[1]).any() or (reach[1] < box[0]).any():
            continue
        near = np.flatnonzero(((places_m > reach[0]) & (places_m < reach[1])).all(1))
        if not len(near):
            continue
        skin_m = body.vertices(R_world_joint[k : k + 1], joints_m[k : k + 1])[0].astype(np.float64)
        normals = vertex_normals(skin_m, body.faces)[chosen]
        gap_m, nearest = (np.asarray(v) for v in KDTree(skin_m[chosen]).query(places_m[near]))
        away = np.einsum("nd,nd->n", places_m[near] - skin_m[chosen][nearest], normals[nearest])
        # Farther from all skin than a trunk is thick, the normal of the nearest says nothing.
        signed = np.where((away < 0) & (gap_m < _DEEPEST_M), -gap_m, gap_m)
        worst = far[near].argmax(1)
        better = signed < far[near, worst]
        far[near[better], worst[better]] = signed[better]
    return far


def _main_pieces(field: np.ndarray, spacing_m: float) -> tuple[np.ndarray, int]:
    """The field without small pieces of solid, and the number of nodes in what is left."""
    from scipy import ndimage

    pieces = np.zeros(field.shape, np.int32)
    count = int(ndimage.label(field < 0, output=pieces))  # type: ignore[arg-type]
    if count == 0:
        return field, 0
    sizes = np.bincount(pieces.ravel())[1:]
    kept = 1 + np.flatnonzero(sizes >= _LEAST_PIECE * sizes.max())
    dropped = (pieces > 0) & ~np.isin(pieces, kept)
    field = np.where(dropped, spacing_m, field)
    return field, int(np.isin(pieces, kept).sum())


def _surface(field: np.ndarray, origin_m: np.ndarray, spacing_m: float, colored: Mesh, most_faces: int) -> Mesh:
    """Zero level of a field (marching cubes) with the nearest colors of a mesh."""
    from skimage.measure import marching_cubes

    padded = np.pad(field, 1, constant_values=spacing_m)
    # Off zero: nodes right on the surface would make triangles without area.
    found = marching_cubes(padded, -1e-3 * spacing_m)
    # Small tears are no harm: the signed distance goes by the majority of six rays.
    vertices, faces = simplified(
        (found[0] - 1) * spacing_m + origin_m, found[1].astype(np.int64), most_faces, keep_closed=False
    )
    _, nearest = KDTree(colored.vertices_m).query(vertices)
    return Mesh(vertices.astype(np.float32), outward(vertices, faces), colored.vertex_rgb[nearest])
