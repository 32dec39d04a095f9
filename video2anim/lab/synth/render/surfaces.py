"""The triangles of a scene with normals, texture coordinates and materials, and surface points for shading."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from video2anim.export.frames import linear_light
from video2anim.geometry.projection import transform_points
from video2anim.geometry.vertex_normals import vertex_normals
from video2anim.lab.synth.render.caster import Hits, RayCaster
from video2anim.lab.synth.render.garments import Borders, material_at, no_borders
from video2anim.lab.synth.render.vectors import dot, length, unit
from video2anim.lab.synth.world import Material, SceneObject

BAKED_COLOR = -1
"""Material number of faces whose color is baked into the vertices (-1, the last entry of material tables)."""


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """A triangle list in the world frame; float32 throughout."""

    vertices_m: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"]
    """Vertex normals, world frame."""
    texture_m: Float[np.ndarray, "vertices 3"]
    """Points at which textures are evaluated: in the object's frame, or on the rest mesh of a body."""
    texture_normal: Float[np.ndarray, "faces 3"]
    """Face normals in the frame of `texture_m`."""
    face_normal: Float[np.ndarray, "faces 3"]
    smooth: Bool[np.ndarray, "faces"]
    object_id: Int[np.ndarray, "faces"]
    material: Int[np.ndarray, "faces"]
    """Index into `materials`, or `BAKED_COLOR`."""
    vertex_rgb: Float[np.ndarray, "vertices 3"]
    """Baked colors, linear; zero where none are used."""
    materials: tuple[Material, ...]
    borders: Borders

    def caster(self, chosen: Bool[np.ndarray, "faces"] | None = None) -> RayCaster:
        """A ray caster for all faces, or the chosen ones."""
        return RayCaster(self.vertices_m, self.faces if chosen is None else self.faces[chosen])

    def opaque(self) -> Bool[np.ndarray, "faces"]:
        """Faces that cast shadows: all without emission, so that a lampshade does not occlude its own bulb, nor a
        window pane the sun."""
        glows = np.array([*(m.emission > 0 for m in self.materials), False])
        return ~glows[self.material]

    def moved(self, vertices_m: np.ndarray, spanning: sparse.csr_array | None = None) -> Surfaces:
        """The same surfaces with new vertices; `spanning` is a matrix that smooths vertex normals (garments)."""
        normals = _vertex_normals(vertices_m, self.faces)
        return replace(
            self,
            vertices_m=vertices_m.astype(np.float32),
            normals=normals if spanning is None else spanning @ normals,
            face_normal=face_normals(vertices_m, self.faces),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Surface points seen from a viewpoint, world frame; one row for each ray that hit."""

    position_m: Float[np.ndarray, "points 3"]
    normal: Float[np.ndarray, "points 3"]
    """Shading normal, unit, facing the viewer."""
    face_normal: Float[np.ndarray, "points 3"]
    """Unit normal of the triangle, facing the viewer."""
    face: Int[np.ndarray, "points"]
    object_id: Int[np.ndarray, "points"]
    material: Int[np.ndarray, "points"]
    texture_m: Float[np.ndarray, "points 3"]
    texture_normal: Float[np.ndarray, "points 3"]
    baked_rgb: Float[np.ndarray, "points 3"]
    view: Float[np.ndarray, "points 3"]
    """Unit vector to the viewer."""
    footprint_m: Float[np.ndarray, "points"]
    """Width of a pixel on the surface, without foreshortening."""

    def __len__(self) -> int:
        return len(self.position_m)

    def joined(self, other: Points) -> Points:
        """These points followed by others."""
        return Points(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__slots__))

    def chosen(self, index: np.ndarray) -> Points:
        """The points of a mask or of an index array."""
        return Points(*(getattr(self, name)[index] for name in self.__slots__))


def face_normals(vertices_m: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "faces 3"]:
    """Unit normals of triangles; zero for degenerate ones."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return unit(normal).astype(np.float32)


def _vertex_normals(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return vertex_normals(vertices_m, faces).astype(np.float32)


def join_surfaces(pieces: Sequence[Surfaces]) -> Surfaces:
    """Several surfaces as one, with each material listed once."""
    if not pieces:
        none, nothing = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
        empty = np.zeros(0, bool)
        faces = np.zeros((0, 3), np.int64)
        return Surfaces(none, faces, none, none, none, none, empty, nothing, nothing, none, (), no_borders(0))
    vertex_start = np.cumsum([0, *(len(p.vertices_m) for p in pieces)])
    known: dict[Material, int] = {}
    numbers = [np.array([*(known.setdefault(m, len(known)) for m in p.materials), BAKED_COLOR]) for p in pieces]
    border_start = np.cumsum([0, *(len(p.borders.material) for p in pieces)])
    borders = [p.borders.renumbered(n, int(b)) for p, n, b in zip(pieces, numbers, border_start, strict=False)]
    together: dict[str, np.ndarray] = {}
    for name in ("vertices_m", "normals", "texture_m", "texture_normal", "face_normal", "smooth", "object_id"):
        together[name] = np.concatenate([getattr(p, name) for p in pieces])
    return Surfaces(
        faces=np.concatenate([p.faces + start for p, start in zip(pieces, vertex_start, strict=False)]),
        material=np.concatenate([n[p.material] for p, n in zip(pieces, numbers, strict=True)]),
        vertex_rgb=np.concatenate([p.vertex_rgb for p in pieces]),
        materials=tuple(known),
        borders=Borders(*(np.concatenate([getattr(b, n) for b in borders]) for n in Borders.__slots__)),
        **together,
    )


def surfaces_of_mesh(
    vertices_m: np.ndarray,
    faces: np.ndarray,
    texture_m: np.ndarray,
    *,
    smooth: bool,
    object_id: int,
    face_material: np.ndarray,
    materials: tuple[Material, ...],
    vertex_rgb: np.ndarray | None = None,
    borders: Borders | None = None,
) -> Surfaces:
    """Surfaces of one mesh (world, meters). `vertex_rgb` (vertices, 3), uint8 sRGB, replaces the materials' colors."""
    count = len(faces)
    baked = np.zeros((len(vertices_m), 3), np.float32)
    if vertex_rgb is not None:
        baked = linear_light(np.asarray(vertex_rgb)[:, :3] / 255.0).astype(np.float32)
        face_material = np.full(count, BAKED_COLOR)
    faces = np.asarray(faces, np.int64)
    return Surfaces(
        vertices_m.astype(np.float32),
        faces,
        _vertex_normals(vertices_m, faces),
        texture_m.astype(np.float32),
        face_normals(texture_m, faces),
        face_normals(vertices_m, faces),
        np.full(count, smooth),
        np.full(count, object_id),
        np.asarray(face_material, np.int64),
        baked,
        materials,
        no_borders(count) if borders is None else borders,
    )


def surfaces_of_object(obj: SceneObject, T_world_object: np.ndarray | None = None) -> Surfaces:
    """Surfaces of a scene object at its own or another pose."""
    T = obj.T_world_object if T_world_object is None else T_world_object
    pieces = [
        surfaces_of_mesh(
            transform_points(T, part.vertices_m),
            part.faces,
            np.asarray(part.vertices_m),
            smooth=part.smooth,
            object_id=obj.object_id,
            face_material=np.zeros(len(part.faces), np.int64),
            materials=(part.material,),
            vertex_rgb=part.vertex_rgb,
        )
        for part in obj.parts
    ]
    return join_surfaces(pieces)


def object_vertices(obj: SceneObject, T_world_object: np.ndarray) -> Float[np.ndarray, "vertices 3"]:
    """Vertices of `surfaces_of_object`."""
    return np.concatenate([transform_points(T_world_object, p.vertices_m).astype(np.float32) for p in obj.parts])


def surfaces_of_objects(objects: Iterable[SceneObject]) -> Surfaces:
    """Surfaces of many objects."""
    return join_surfaces([surfaces_of_object(obj) for obj in objects])


def points_at(
    surfaces: Surfaces, hits: Hits, origin_m: np.ndarray, directions: np.ndarray, pixel_angle: float
) -> Points:
    """Surface points where rays from one origin hit; every ray must have hit. `pixel_angle` = 1 / focal length."""
    face = hits.face
    corner = surfaces.faces[face]
    b1, b2 = hits.barycentric[:, :1], hits.barycentric[:, 1:]
    b0 = 1 - b1 - b2
    position = (origin_m + directions * hits.distance[:, None]).astype(np.float32)
    far = length(directions)
    view = (-directions / far[:, None]).astype(np.float32)
    flat = surfaces.face_normal[face]
    facing = np.where(dot(flat, view) < 0, np.float32(-1), np.float32(1))[:, None]
    smooth = surfaces.smooth[face]
    normal = flat * facing
    bent = corner[smooth]
    if len(bent):
        n = surfaces.normals
        mixed = n[bent[:, 0]] * b0[smooth] + n[bent[:, 1]] * b1[smooth] + n[bent[:, 2]] * b2[smooth]
        normal[smooth] = _towards(mixed * facing[smooth], view[smooth])
    mix = surfaces.texture_m
    baked = np.zeros_like(position)
    seen_baked = surfaces.material[face] == BAKED_COLOR
    if seen_baked.any():
        c, rgb = corner[seen_baked], surfaces.vertex_rgb
        baked[seen_baked] = (
            rgb[c[:, 0]] * b0[seen_baked] + rgb[c[:, 1]] * b1[seen_baked] + rgb[c[:, 2]] * b2[seen_baked]
        )
    return Points(
        position,
        normal,
        flat * facing,
        face,
        surfaces.object_id[face],
        material_at(surfaces.borders, face, surfaces.material[face], hits.barycentric),
        mix[corner[:, 0]] * b0 + mix[corner[:, 1]] * b1 + mix[corner[:, 2]] * b2,
        surfaces.texture_normal[face],
        baked,
        view,
        (hits.distance * far * pixel_angle).astype(np.float32),
    )


def _towards(normal: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Unit normals; those that face away from the viewer are bent until they just face it."""
    normal = unit(normal)
    away = np.minimum(dot(normal, view) - 0.02, 0)
    return unit(normal - view * away[:, None])
