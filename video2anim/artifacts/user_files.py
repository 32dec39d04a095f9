"""Meshes that users bring along: object meshes by number, scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from video2anim.artifacts.folder import file_digest, folder_digest
from video2anim.errors import InputError
from video2anim.types.scene import Mesh

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")


def content_digest(path: Path) -> str:
    """sha256 of a file, or of the names and bytes in a folder.

    Raises:
        InputError: missing or unreadable.
    """
    if not path.exists():
        raise InputError(f"want a file or folder, found nothing at {path}")
    try:
        return folder_digest(path) if path.is_dir() else file_digest(path)
    except OSError as error:
        raise InputError(f"want a readable file or folder, got {error.strerror} at {path}") from error


def mesh_files(folder: Path) -> dict[int, Path]:
    """Mesh files of a folder that are named by an object's number, such as `3.glb`.

    Raises:
        InputError: no folder, or two files of one number.
    """
    if not folder.is_dir():
        raise InputError(f"want a folder of meshes named by object, such as 3.glb, found none at {folder}")
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in MESH_SUFFIXES and path.stem.isdigit():
            if int(path.stem) in found:
                raise InputError(f"want one mesh per object, got {found[int(path.stem)].name} and {path.name}")
            found[int(path.stem)] = path
    return found


def read_mesh_file(path: Path) -> Mesh:
    """Triangles with a color per vertex of a GLB, glTF, OBJ, PLY or STL file, all its parts together.

    Raises:
        InputError: missing, unreadable, or without triangles.
    """
    import trimesh

    if path.suffix.lower() not in MESH_SUFFIXES or not path.is_file():
        raise InputError(f"want a mesh file ({', '.join(MESH_SUFFIXES)}), got {path}")
    try:
        loaded = trimesh.load_scene(path).to_mesh()
    except Exception as error:  # the loaders raise what their parsers raise
        raise InputError(f"want a mesh, got {type(error).__name__} at {path}") from error
    vertices = np.asarray(loaded.vertices, np.float64)
    if not len(loaded.faces) or not np.isfinite(vertices).all():
        raise InputError(f"want a mesh with triangles and finite vertices, got {len(loaded.faces)} faces at {path}")
    try:
        colors = loaded.visual if loaded.visual.kind == "vertex" else loaded.visual.to_color()
        rgb = np.asarray(colors.vertex_colors)[:, :3].astype(np.uint8)
    except Exception:  # no texture, or one that cannot be read
        rgb = np.zeros((0, 3), np.uint8)
    if len(rgb) != len(vertices):
        rgb = np.full((len(vertices), 3), 160, np.uint8)
    return Mesh(vertices, np.asarray(loaded.faces, np.int64), rgb)
