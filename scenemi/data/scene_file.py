"""Scenes from files: meshes and clouds of points of one world, +Y up, meters."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from scenemi.data.plain_files import MAX_BYTES, Numbers, checked, expect_file, one_line, read_arrays, shaped
from scenemi.scene.scene_parts import ScenePart, expect_scene
from video2anim.errors import InputError
from video2anim.types.scene import MAX_FACES

SCENE_SUFFIXES = (".glb", ".gltf", ".ply", ".obj", ".stl", ".npz")
_MAX_HEADER_BYTES = 64 * 1024
_GLB_HEADER, _CHUNK_HEADER, _JSON_CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s"), b"JSON"
_STL_HEAD_BYTES, _STL_FACE_BYTES = 84, 50


@dataclass(frozen=True, slots=True, eq=False)
class SceneFile:
    """What a file holds that is solid, and what was left out of it."""

    parts: tuple[ScenePart, ...]
    notes: tuple[str, ...] = ()


class _SceneArrays(BaseModel):
    model_config = ConfigDict(arbitrary_types_allowed=True, frozen=True)

    vertices_m: Annotated[Numbers, shaped(None, 3, letters="V")] | None = None
    points_m: Annotated[Numbers, shaped(None, 3, letters="N")] | None = None
    faces: Annotated[Numbers, shaped(None, 3, letters="F")] | None = None


def mesh_path(path: Path) -> Path:
    """The file of a scene: of a folder of `video2anim run` its `scene.glb`.

    Raises:
        InputError: a folder without one.
    """
    if path.is_dir() and not (path / "scene.glb").is_file():
        raise InputError(
            f"{path}: want a scene folder with scene.glb; `video2anim export {path} --format glb` makes it"
        )
    return path / "scene.glb" if path.is_dir() else path


def read_scene(path: Path) -> SceneFile:
    """A scene in the world frame (+Y up, meters): all meshes and points of a file but people, which are skinned meshes.

    An `.npz` holds `vertices_m` and `faces`, or `points_m`. A folder is one of `video2anim run`.

    Raises:
        InputError: the file is missing, cannot be read, is too large, or has no geometry.
    """
    path = mesh_path(path)
    if path.suffix.lower() not in SCENE_SUFFIXES:
        raise InputError(f"{path}: want a scene as {', '.join(SCENE_SUFFIXES)}")
    found = _npz(path) if path.suffix.lower() == ".npz" else read_meshes(path)
    faces = sum(len(part.faces) for part in found.parts)
    if faces > MAX_FACES:
        raise InputError(f"{path}: want at most {MAX_FACES:,} faces, got {faces:,}; simplify the scan first")
    return SceneFile(expect_scene(str(path), found.parts), found.notes)


def read_meshes(path: Path) -> SceneFile:
    """All meshes and clouds of points of a mesh file, as they are, but skinned ones.

    Raises:
        InputError: the file is missing, cut off, damaged or of no known kind.
    """
    import trimesh
    from trimesh.resolvers import FilePathResolver

    expect_file(path, "scene file", MAX_BYTES)
    suffix = path.suffix.lower()
    try:
        data = path.read_bytes()
        if suffix in _PREPARED:
            data, notes, fits = _PREPARED[suffix](data)
        else:
            notes, fits = (), lambda parts: True
        loaded = trimesh.load_scene(
            io.BytesIO(data),
            file_type=suffix.removeprefix("."),
            resolver=FilePathResolver(str(path)),
            process=False,  # also drops what is broken
            skip_materials=True,
        )
        parts = tuple(ScenePart(_rows(found, "vertices", float), _rows(found, "faces", int)) for found in loaded.dump())
    except Exception as error:  # each format's reader raises classes of its own
        raise InputError(f"{path}: cannot be read as a scene: {one_line(error)}") from error
    if any(len(part.faces) and not 0 <= part.faces.min() <= part.faces.max() < len(part.vertices_m) for part in parts):
        raise InputError(f"{path}: faces point at vertices that are not there")
    if not fits(parts):
        raise InputError(f"{path}: cannot be read as a scene: it holds less than it says; copy or export it again")
    return SceneFile(parts, notes)


def _rows(found: object, name: str, kind: type) -> np.ndarray:
    """Rows of three of what trimesh read; none where it has no such rows (points have no faces)."""
    rows = np.asarray(getattr(found, name, np.zeros((0, 3))), kind)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"{name} want rows of three, got {rows.shape}")
    return rows


def _npz(path: Path) -> SceneFile:
    found = read_arrays(path, tuple(_SceneArrays.model_fields), "scene file")
    values = checked(_SceneArrays, str(path), found)
    points_m = values.points_m if values.vertices_m is None else values.vertices_m
    if points_m is None:
        raise InputError(f"{path}: want vertices_m and faces, or points_m, got {sorted(found)}")
    faces = np.zeros((0, 3)) if values.faces is None else values.faces
    if not (np.isfinite(faces).all() and (np.abs(faces) < 2**62).all() and (faces == np.rint(faces)).all()):
        raise InputError(f"{path}: faces wants whole numbers of vertices")
    return SceneFile((ScenePart(points_m.astype(np.float64), faces.astype(np.int64)),))


_Prepared = tuple[bytes, tuple[str, ...], Callable[[tuple[ScenePart, ...]], bool]]
"""Bytes to read, notes, and whether what was read is all that the file said."""


def _glb(data: bytes) -> _Prepared:
    """A binary glTF without its people."""
    magic, _, length = _GLB_HEADER.unpack_from(data)
    chunk_bytes, kind = _CHUNK_HEADER.unpack_from(data, _GLB_HEADER.size)
    start = _GLB_HEADER.size + _CHUNK_HEADER.size
    if magic != b"glTF" or kind != _JSON_CHUNK or start + chunk_bytes > len(data):
        raise ValueError("no binary glTF 2.0, or cut off")
    if length != len(data):
        raise ValueError(f"cut off or damaged: it says {length} bytes and has {len(data)}")
    text, notes = _without_people(data[start : start + chunk_bytes])
    text += b" " * (-len(text) % 4)
    rest = data[start + chunk_bytes :]
    head = _GLB_HEADER.pack(magic, 2, start + len(text) + len(rest)) + _CHUNK_HEADER.pack(len(text), kind)
    return head + text + rest, notes, lambda parts: True


def _gltf(data: bytes) -> _Prepared:
    return (*_without_people(data), lambda parts: True)


def _without_people(text: bytes) -> tuple[bytes, tuple[str, ...]]:
    """glTF without skinned meshes. They are people, at rest in the file: what moves in a scene is no part of it."""
    document: dict[str, Any] = json.loads(text)
    people = [node for node in document.get("nodes", ()) if "skin" in node and "mesh" in node]
    if not people:
        return text, ()
    for node in people:
        del node["mesh"]
    names = ", ".join(str(node.get("name", "unnamed"))[:40] for node in people[:3])
    more = f" and {len(people) - 3} more" if len(people) > 3 else ""
    return json.dumps(document).encode(), (f"skinned meshes (people) of the scene are left out: {names}{more}",)


def _stl(data: bytes) -> _Prepared:
    count = struct.unpack_from("<I", data, _STL_HEAD_BYTES - 4)[0] if len(data) >= _STL_HEAD_BYTES else 0
    text = data[:_MAX_HEADER_BYTES].lstrip().startswith(b"solid") and b"facet" in data[:_MAX_HEADER_BYTES]
    if not text and len(data) != _STL_HEAD_BYTES + _STL_FACE_BYTES * count:
        raise ValueError(f"cut off or damaged: it says {count} triangles in {len(data)} bytes")
    return data, (), lambda parts: True


def _ply(data: bytes) -> _Prepared:
    """Counts of vertices and faces are believed only where there are as many."""
    head = data[:_MAX_HEADER_BYTES].partition(b"end_header")[0].decode("ascii", "replace").split("\n")
    said = {words[1]: int(words[2]) for words in map(str.split, head) if len(words) == 3 and words[0] == "element"}
    if sum(said.values()) > len(data) or min(said.values(), default=0) < 0:
        raise ValueError(f"cut off or damaged: it says {sum(said.values())} elements in {len(data)} bytes")

    def fits(parts: tuple[ScenePart, ...]) -> bool:
        vertices, faces = (sum(len(getattr(part, name)) for part in parts) for name in ("vertices_m", "faces"))
        return vertices == said.get("vertex", 0) and faces >= said.get("face", 0)

    return data, (), fits


_PREPARED: dict[str, Callable[[bytes], _Prepared]] = {".glb": _glb, ".gltf": _gltf, ".stl": _stl, ".ply": _ply}
