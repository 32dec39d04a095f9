"""Meshes that users bring along: object meshes by number, scans."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from video2anim.artifacts.folder import folder_digest
from video2anim.artifacts.meshes import expect_sound
from video2anim.artifacts.stage_files import shown
from video2anim.digest import file_digest
from video2anim.errors import ArtifactError, InputError
from video2anim.mesh_file import MESH_SUFFIXES, read_mesh_parts
from video2anim.types.scene import Mesh

if TYPE_CHECKING:
    import trimesh


def content_digest(path: Path) -> str:
    """sha256 of a file with the files that a glTF or OBJ names, or of the names and bytes in a folder.

    Raises:
        InputError: missing or unreadable.
    """
    if not path.exists():
        raise InputError(f"want a file or folder, found nothing at {path}")
    try:
        if path.is_dir():
            return folder_digest(path)
        own, named = file_digest(path), named_files(path)
        if not named:
            return own
        parts = [own, *(f"{other.name} {file_digest(other)}" for other in named)]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()
    except OSError as error:
        raise InputError(f"want a readable file or folder, got {error.strerror} at {path}") from error


def named_files(path: Path) -> list[Path]:
    """Files beside a glTF (buffers, images) or OBJ (materials, their textures) that belong to it; missing ones are left
    to the reader to complain of."""
    found: list[Path] = []
    waiting = [path]
    while waiting:
        one = waiting.pop()
        new = [one.parent / unquote(name) for name in _names_in(one)]
        new = [other for other in new if other.is_file() and other not in found and other != path]
        found += new
        waiting += new
    return sorted(found)


def _names_in(path: Path) -> list[str]:
    suffix = path.suffix.lower()
    if suffix == ".gltf":
        try:
            document = json.loads(path.read_bytes())
            parts = [*document.get("buffers", ()), *document.get("images", ())]
            names = [str(part.get("uri", "")) for part in parts]
        except (ValueError, AttributeError, TypeError):
            return []  # the reader says what is wrong with it
        return [name for name in names if name and not name.startswith("data:")]
    if suffix not in (".obj", ".mtl"):
        return []
    key = "mtllib" if suffix == ".obj" else "map_"
    with path.open(encoding="utf-8", errors="replace") as lines:
        # A texture's options stand before its name.
        words = [line.split() for line in lines if line.lstrip().lower().startswith(key)]
    names = [word[-1] for word in words if len(word) > 1]
    # One library's name may have blanks; several stand on one line.
    return names if suffix == ".mtl" else [name for word in words for name in (*word[1:], " ".join(word[1:]))]


def mesh_files(folder: Path) -> dict[int, Path]:
    """Mesh files of a folder that are named by an object's number, such as `3.glb`.

    Raises:
        InputError: no folder, no such file in it, or two of one number.
    """
    if not folder.is_dir():
        raise InputError(f"want a folder of meshes named by object, such as 3.glb, found none at {folder}")
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in MESH_SUFFIXES and path.stem.isascii() and path.stem.isdigit():
            if int(path.stem) in found:
                raise InputError(f"want one mesh per object, got {found[int(path.stem)].name} and {path.name}")
            found[int(path.stem)] = path
    if not found:
        raise InputError(f"want a folder of meshes named by object, such as 3.glb, found no such name in {folder}")
    return found


def read_mesh_file(path: Path) -> Mesh:
    """Triangles with a color per vertex of a GLB, glTF, OBJ, PLY or STL file, all its parts together.

    Raises:
        InputError: missing, unreadable, of more than `MAX_FACES` triangles, or not sound (`expect_sound`).
    """
    import trimesh

    parts = read_mesh_parts(path, "mesh", colored=True).parts
    parts = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    sound = (part.vertices.shape[1:] == (3,) and np.isfinite(part.vertices).all() for part in parts)
    if not parts or not all(sound):
        raise InputError(f"want a mesh with triangles and finite vertices (x, y, z), got {len(parts)} parts at {path}")
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    vertices_m = np.concatenate([np.asarray(part.vertices, np.float64) for part in parts])
    triangles = [np.asarray(part.faces, np.int64) + start for part, start in zip(parts, starts, strict=True)]
    rgb = np.concatenate([_vertex_rgb(part, path) for part in parts])
    try:
        mesh = Mesh(vertices_m, np.concatenate(triangles), rgb)
        expect_sound(mesh, path)
    except ArtifactError as error:
        raise InputError(str(error)) from error
    except ValueError as error:
        raise InputError(f"{path.name}: {error} at {path}") from error
    return mesh


def _vertex_rgb(part: trimesh.Trimesh, path: Path) -> np.ndarray:
    """Colors of vertices, faces, texture or material, in this order; gray if the file has none."""
    visual = part.visual
    if visual is None or visual.kind is None:
        return np.full((len(part.vertices), 3), 160, np.uint8)
    try:
        if visual.kind == "texture":
            material = visual.material  # type: ignore[union-attr]
            image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
            if image is None or visual.uv is None:  # type: ignore[union-attr]
                return np.tile(np.asarray(material.main_color)[:3].astype(np.uint8), (len(part.vertices), 1))
            visual = visual.to_color()  # type: ignore[union-attr]
        rgb = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)  # type: ignore[union-attr]
    except Exception as error:  # pictures are decoded here, by a library that raises many classes
        raise InputError(f"want a readable texture, got {shown(str(error))} in {path}; save the mesh again") from error
    if len(rgb) != len(part.vertices):
        raise InputError(f"want a color for each of {len(part.vertices)} vertices, got {len(rgb)} in {path}")
    return rgb
