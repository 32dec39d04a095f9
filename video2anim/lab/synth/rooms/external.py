"""External meshes (`MESH_SUFFIXES`) as objects of a room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import UInt8
from trimesh.visual import ColorVisuals, TextureVisuals

from video2anim.errors import InputError
from video2anim.lab.synth.world import CLUTTER_LABELS, FURNITURE_LABELS, Material, Part, SceneObject, Surface
from video2anim.mesh_file import MESH_SUFFIXES, read_mesh_parts

MIN_M = 0.02
MAX_M = 4.0
"""Range of the largest extent of an object; others are not in meters, or are not objects of a room."""
_FLATTEST_M = 0.002
_NO_COLOR = (0.62, 0.60, 0.57)


def load_meshes(folder: Path) -> tuple[SceneObject, ...]:
    """All meshes of a folder, sorted by name: meters, +Y up, moved to y = 0 with the origin below the center.

    Vertex colors are kept; textures and face colors are baked into the vertices. The label is the class at the start
    of the file name (`chair_oak.glb` is a chair), else `mesh`.

    Raises:
        InputError: there is no such folder, it holds no mesh, or a mesh is unreadable, empty, flat or too small or
            large for an object in meters.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: wanted a folder with meshes, but there is none; check the path")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES)
    if not paths:
        raise InputError(f"{folder}: wanted meshes ({', '.join(MESH_SUFFIXES)}), found none in the folder")
    return tuple(load_mesh(path) for path in paths)


def load_mesh(path: Path) -> SceneObject:
    """The mesh of one file as an object; see `load_meshes`, also for errors."""
    meshes = _read(path)
    points = np.concatenate([np.asarray(mesh.vertices, float)[np.unique(mesh.faces)] for mesh in meshes])
    if not np.isfinite(points).all():
        raise InputError(f"{path}: mesh has coordinates that are not finite; export it again")
    low, high = points.min(0), points.max(0)
    extent = high - low
    if extent.max() > MAX_M or extent.max() < MIN_M:
        raise InputError(
            f"{path}: mesh is {extent.max():.3g} units long, but objects of {MIN_M:g} to {MAX_M:g} m are "
            f"wanted; export it in meters"
        )
    if extent.min() < _FLATTEST_M:
        raise InputError(f"{path}: mesh is flat ({1000 * extent.min():.2g} mm thick); a solid object is wanted")
    origin = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    parts = tuple(_part(mesh, origin) for mesh in meshes)
    top = Surface("top", float(extent[1]), (0.0, 0.0), (float(extent[0]), float(extent[2])))
    label = _label(path.stem)
    surfaces = (top,) if label in ("table", "desk", "box", "cabinet") else ()
    return SceneObject(1, label, parts, np.eye(4), surfaces, f"file {path.name}")


def _read(path: Path) -> list[trimesh.Trimesh]:
    """Meshes of a file, in its scene's frame."""
    parts = read_mesh_parts(path, "mesh", colored=True).parts
    meshes = [mesh for mesh in parts if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not meshes:
        raise InputError(f"{path}: holds no triangles; export the mesh again")
    return meshes


def _part(mesh: trimesh.Trimesh, origin: np.ndarray) -> Part:
    faces = np.asarray(mesh.faces, np.int64)
    if mesh.is_watertight and mesh.volume < 0:
        faces = faces[:, ::-1].copy()
    material = Material("plain", _NO_COLOR, _NO_COLOR)
    return Part(np.asarray(mesh.vertices, float) - origin, faces, material, False, _vertex_rgb(mesh))


def _vertex_rgb(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, "vertices 3"]:
    plain = np.full((len(mesh.vertices), 3), np.round(255 * np.array(_NO_COLOR)), np.uint8)
    visual = mesh.visual
    try:
        colors = visual.to_color() if isinstance(visual, TextureVisuals) else visual
        if not isinstance(colors, ColorVisuals) or colors.kind is None:
            return plain
        rgb = np.asarray(colors.vertex_colors)[:, :3]
    except (AttributeError, ValueError, IndexError, TypeError):  # a texture that is not there
        return plain
    return np.asarray(rgb, np.uint8) if len(rgb) == len(plain) else plain


def _label(stem: str) -> str:
    words = stem.lower().replace("-", "_").replace(" ", "_").split("_")
    for label in (*FURNITURE_LABELS, *CLUTTER_LABELS):
        if words[0].rstrip("0123456789") == label:
            return label
    return "mesh"
