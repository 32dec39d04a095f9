"""Mesh files that users bring: one list of kinds, one set of limits, one reader."""

from __future__ import annotations

import io
import json
import logging
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from video2anim.errors import InputError, expect_file, one_line

if TYPE_CHECKING:
    from trimesh.parent import Geometry

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
MAX_FACES = 3_000_000
"""Maximum number of faces of a user's scan. More take minutes and several GiB, without better distances."""
_HEADER_BYTES = 64 * 1024
"""A PLY's header and the beginning of a text STL are sought in so many: more than any of them has (not measured)."""
_GLB_HEADER, _CHUNK_HEADER, _JSON_CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s"), b"JSON"
_STL_HEADER, _STL_FACE = struct.Struct("<80xI"), struct.Struct("<12fH")


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """What a file holds."""

    parts: tuple[Geometry, ...]
    """Meshes and clouds of points of trimesh, each in its place in the frame of the file."""
    people: tuple[str, ...] = ()
    """Names of skinned meshes that were left out."""


def read_mesh_parts(path: Path, what: str, *, colored: bool) -> MeshFile:
    """All meshes and clouds of points of a file.

    Args:
        path: of one of `MESH_SUFFIXES`; files beside it that it names are read too.
        what: of which the errors speak.
        colored: with materials, as trimesh loads them. Else as they are in the file, whatever is broken in them, and
            without skinned meshes: these are people.

    Raises:
        InputError: the file is missing, of no such kind, cut off, damaged, or of more than `MAX_FACES` faces.
    """
    import trimesh
    from trimesh.resolvers import FilePathResolver

    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InputError(f"{path}: want a {what} file ({', '.join(MESH_SUFFIXES)})")
    expect_file(path, f"{what} file")
    try:
        # From memory, where a false length in the file asks for no more than there is.
        data, people = path.read_bytes(), ()
        if suffix in _CHECKS:
            _CHECKS[suffix](data)
        if suffix in _WITHOUT_PEOPLE and not colored:
            data, people = _WITHOUT_PEOPLE[suffix](data)
        with _quiet():
            bare: dict[str, Any] = {} if colored else {"process": False, "skip_materials": True}
            beside = FilePathResolver(str(path))
            loaded = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=beside, **bare)
            parts = tuple(loaded.dump())
    except Exception as error:  # each format's reader raises classes of its own
        raise InputError(f"{path}: cannot be read as a {what}: {one_line(error)}; save it again") from error
    if suffix == ".ply" and not colored and not _is_whole(data, parts):
        raise InputError(f"{path}: cannot be read as a {what}: it holds less than it says; save it again")
    expect_few_faces(sum(len(getattr(part, "faces", ())) for part in parts), str(path), what)
    return MeshFile(parts, people)


def expect_few_faces(count: int, where: str, what: str) -> None:
    """Refuse a mesh that is too large to work with.

    Raises:
        InputError: more than `MAX_FACES`.
    """
    if count > MAX_FACES:
        raise InputError(f"{where}: want a {what} of at most {MAX_FACES:,} faces, got {count:,}; simplify it first")


@contextmanager
def _quiet() -> Iterator[None]:
    """What is wrong with a file is said once, by the error."""
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _glb_parts(data: bytes) -> tuple[bytes, bytes]:
    """Text of a binary glTF, and what follows it."""
    start = _GLB_HEADER.size + _CHUNK_HEADER.size
    head = data[:start].ljust(start, b"\0")
    magic, _, length = _GLB_HEADER.unpack_from(head)
    text_bytes, kind = _CHUNK_HEADER.unpack_from(head, _GLB_HEADER.size)
    if magic != b"glTF" or kind != _JSON_CHUNK or start + text_bytes > len(data):
        raise ValueError("no binary glTF 2.0, or cut off")
    if length != len(data):
        raise ValueError(f"cut off or damaged: it says {length} bytes and has {len(data)}")
    return data[start : start + text_bytes], data[start + text_bytes :]


def _check_stl(data: bytes) -> None:
    count = _STL_HEADER.unpack_from(data)[0] if len(data) >= _STL_HEADER.size else 0
    text = data[:_HEADER_BYTES].lstrip().startswith(b"solid") and b"facet" in data[:_HEADER_BYTES]
    if not text and len(data) != _STL_HEADER.size + _STL_FACE.size * count:
        raise ValueError(f"cut off or damaged: it says {count} triangles in {len(data)} bytes")


def _ply_counts(data: bytes) -> dict[str, int]:
    head = data[:_HEADER_BYTES].partition(b"end_header")[0].decode("ascii", "replace").split("\n")
    return {words[1]: int(words[2]) for words in map(str.split, head) if len(words) == 3 and words[0] == "element"}


def _check_ply(data: bytes) -> None:
    said = _ply_counts(data).values()
    if sum(said) > len(data) or min(said, default=0) < 0:
        raise ValueError(f"cut off or damaged: it says {sum(said)} elements in {len(data)} bytes")


def _is_whole(ply: bytes, parts: Sequence[Any]) -> bool:
    """Whether all vertices and faces were read that a PLY says to have."""
    said = _ply_counts(ply)
    vertices, faces = (sum(len(getattr(part, name, ())) for part in parts) for name in ("vertices", "faces"))
    return vertices == said.get("vertex", 0) and faces >= said.get("face", 0)


def _glb_without_people(data: bytes) -> tuple[bytes, tuple[str, ...]]:
    text, rest = _glb_parts(data)
    text, people = _without_people(text)
    text += b" " * (-len(text) % 4)
    size = _GLB_HEADER.size + _CHUNK_HEADER.size + len(text) + len(rest)
    return _GLB_HEADER.pack(b"glTF", 2, size) + _CHUNK_HEADER.pack(len(text), _JSON_CHUNK) + text + rest, people


def _without_people(text: bytes) -> tuple[bytes, tuple[str, ...]]:
    """glTF without skinned meshes, and their names. They are people, at rest in the file."""
    document: dict[str, Any] = json.loads(text)
    people = [node for node in document.get("nodes", ()) if "skin" in node and "mesh" in node]
    for node in people:
        del node["mesh"]
    names = tuple(str(node.get("name", "unnamed")) for node in people)
    return (json.dumps(document).encode() if people else text), names


_CHECKS: dict[str, Callable[[bytes], object]] = {".glb": _glb_parts, ".stl": _check_stl, ".ply": _check_ply}
_WITHOUT_PEOPLE = {".glb": _glb_without_people, ".gltf": _without_people}
