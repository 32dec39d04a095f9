"""Closed, colored meshes of fitted forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree

from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.objects.form_fit import FormFit
from video2anim.objects.furniture import BOX
from video2anim.objects.observed import ObjectEvidence
from video2anim.objects.solids import Solids
from video2anim.objects.texture import textured
from video2anim.types import Mesh, ObjectPart, Texture, View

_SEEN_M = 0.03
"""A surface so far behind the first that a ray meets is still the one that is seen: sides meet at edges."""
_SIDE_M = 0.15
"""A side that looks elsewhere counts as so far away when a color is looked for."""
_GRAY = 127
_SOURCES = 2000
"""Seen places at most in which a color is looked for."""
_FARTHER = 1.0
"""A place farther than the nearest by up to this share of its distance will do: the search takes a quarter of the
time, and textures look the same."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPicture:
    """Colors of one object; any size."""

    rgb: UInt8[np.ndarray, "height width 3"]
    own: Bool[np.ndarray, "height width"]
    """Pixels that show it or were completed."""
    view: View


def form_mesh(fit: FormFit, picture: ObjectPicture) -> tuple[Mesh, tuple[ObjectPart, ...], Texture]:
    """The form's parts as closed surfaces of few faces, in the object's frame, and their texture."""
    return _painted(*fit.solids(), fit.T_world_object, picture)


def box_object(
    size_m: tuple[float, float, float], T_world_object: Float[np.ndarray, "4 4"], picture: ObjectPicture
) -> tuple[Mesh, tuple[ObjectPart, ...], Texture]:
    """A box of known width, height and depth that stands on the origin of its frame."""
    return _painted(*BOX.build(np.array([[size_m[0], size_m[2], size_m[1]]])), T_world_object, picture)


def _painted(
    names: tuple[str, ...], solids: Solids, T_world_object: Float[np.ndarray, "4 4"], picture: ObjectPicture
) -> tuple[Mesh, tuple[ObjectPart, ...], Texture]:
    vertices, faces, parts, first, count = [], [], [], 0, 0
    for name, (own_m, own_faces) in zip(names, solids.meshes(), strict=True):
        vertices.append(own_m)
        faces.append(own_faces + count)
        parts.append(ObjectPart(name, first, len(own_faces)))
        first, count = first + len(own_faces), count + len(own_m)
    vertices_m, every = np.concatenate(vertices), np.concatenate(faces)
    # A pixel of the picture at the object's distance.
    away_m = float(np.linalg.norm(T_world_object[:3, 3] - picture.view.T_world_camera[:3, 3]))
    finest_m = away_m / picture.view.intrinsics.fx_px

    def color(points_m: np.ndarray, normals: np.ndarray) -> UInt8[np.ndarray, "points 3"]:
        return _colors(points_m, normals, solids, T_world_object, picture)

    rgb = color(vertices_m, np.zeros_like(vertices_m))
    return Mesh(vertices_m.astype(np.float32), every, rgb), tuple(parts), textured(vertices_m, every, color, finest_m)


def _colors(
    points_m: Float[np.ndarray, "points 3"],
    normals: Float[np.ndarray, "points 3"],
    solids: Solids,
    T_world_object: Float[np.ndarray, "4 4"],
    picture: ObjectPicture,
) -> UInt8[np.ndarray, "points 3"]:
    """Those of the picture where the camera sees a point; elsewhere of the nearest seen place that looks the same way,
    in the object or in its mirror images."""
    T_object_camera = invert_rigid(T_world_object) @ picture.view.T_world_camera
    camera_m = transform_points(invert_rigid(T_object_camera), points_m)
    ahead = camera_m[:, 2] > 0.05
    pixels = project(np.where(ahead[:, None], camera_m, [0.0, 0.0, 1.0]), picture.view.intrinsics)
    height, width = picture.own.shape
    u, v = (np.round(pixels[:, k]).astype(int) for k in (0, 1))
    inside = ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    rays = points_m - T_object_camera[:3, 3]
    seen = inside & picture.own[v, u]
    first = solids.first_hit(T_object_camera[None, :3, 3], rays[None, seen])[0]
    seen[seen] = (1 - first) * np.linalg.norm(rays[seen], axis=-1) < _SEEN_M
    rgb = picture.rgb[v, u].copy()
    if not seen.any():
        some = picture.rgb[picture.own]
        color = np.median(some, axis=0).astype(np.uint8) if len(some) else np.full(3, _GRAY, np.uint8)
        return np.tile(color, (len(rgb), 1))
    place = np.concatenate([points_m, _SIDE_M * normals], 1)
    some = np.flatnonzero(seen)
    some = some[:: max(1, len(some) // _SOURCES)]
    # Left to right, front to rear, and both.
    images = [place[some] * np.tile([x, 1.0, z], 2) for x in (1.0, -1.0) for z in (1.0, -1.0)]
    _, nearest = KDTree(np.concatenate(images)).query(place[~seen], eps=_FARTHER)
    rgb[~seen] = rgb[np.tile(some, len(images))[nearest]]
    return rgb


def outline_iou(fit: FormFit, evidence: ObjectEvidence, own: Bool[np.ndarray, "height width"]) -> float:
    """Overlap of the form, drawn, with the object's visible pixels, where nothing can hide it."""
    height, width = own.shape
    row, column = np.mgrid[:height, :width]
    k, T_world_camera = evidence.intrinsics, invert_rigid(evidence.T_camera_world)
    local = np.stack([(column - k.cx_px) / k.fx_px, (row - k.cy_px) / k.fy_px, np.ones_like(row)], -1).reshape(-1, 3)
    T_object_camera = invert_rigid(fit.T_world_object) @ T_world_camera
    hit = fit.solids()[1].first_hit(T_object_camera[None, :3, 3], (local @ T_object_camera[:3, :3].T)[None])[0]
    drawn = np.isfinite(hit).reshape(height, width)
    open_ = own | (evidence.outside_px > 0)
    return float((drawn & own).sum() / max(int(((drawn | own) & open_).sum()), 1))
