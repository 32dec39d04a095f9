"""Meshes on disk as binary PLY with vertex colors."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import get_type_hints

import numpy as np

from video2anim.artifacts.arrays import Axes, damage, expect_content, expect_shape
from video2anim.artifacts.stage_files import opened
from video2anim.errors import ArtifactError
from video2anim.types.checks import MAX_M
from video2anim.types.scene import Mesh
from video2anim.types.storage import Holds

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
_FACE = np.dtype([("count", "u1"), ("index", "<i4", (3,))])
_COUNTS = re.compile(rb"^\s*element\s+\S+\s+(\d{1,18})", re.MULTILINE)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write binary little-endian PLY; also right for an empty mesh, which mesh libraries refuse."""
    vertices = np.zeros(len(mesh.vertices_m), _VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = mesh.vertices_m[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = mesh.vertex_rgb[:, channel]
    faces = np.zeros(len(mesh.faces), _FACE)
    faces["count"] = 3
    faces["index"] = mesh.faces
    types = [("float", "x"), ("float", "y"), ("float", "z"), ("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {kind} {name}" for kind, name in types]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_bytes(("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes())


def read_ply(path: Path, *, empty: bool = True) -> Mesh:
    """Read a PLY, also one saved by a 3D program (polygons are triangulated, missing colors are gray).

    Args:
        path: of the mesh.
        empty: whether a mesh without triangles will do.

    Raises:
        ArtifactError: no mesh in the file, or one that cannot be: no numbers, farther away than 10 km, triangles that
            name no vertex or have no area.
    """
    with opened(path) as stream:
        data = stream.read()
    if sum(int(count) for count in _COUNTS.findall(data[: data.find(b"end_header")])) > len(data):
        raise ArtifactError(f"{path.name} is damaged (it announces more than it holds) at {path}")
    if b"element vertex 0\n" in data[:400]:
        mesh = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))
    else:
        with damage(path):
            mesh = _parsed(data, path)
        expect_sound(mesh, path)
    if not empty and not len(mesh.faces):
        raise ArtifactError(f"{path.name}: want {Holds.SOMETHING.value}, got none at {path}")
    return mesh


def expect_sound(mesh: Mesh, path: Path) -> None:
    """Hold a mesh against what its type says.

    Raises:
        ArtifactError: it does not fit.
    """
    axes: Axes = {}
    for name, hint in get_type_hints(Mesh, include_extras=True).items():
        array = getattr(mesh, name)
        expect_shape(array.shape, array.dtype, hint, axes, name, path)
        expect_content(array, (), axes, name, path)
    if np.abs(mesh.vertices_m).max(initial=0.0) > MAX_M:
        raise ArtifactError(f"{path.name}: want meters, got vertices farther than 10 km from the origin at {path}")
    corners = mesh.vertices_m[mesh.faces]
    if len(corners) and not np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any():
        raise ArtifactError(f"{path.name}: want triangles with an area, got none at {path}")


def _parsed(data: bytes, path: Path) -> Mesh:
    import trimesh

    # From memory: what a file names beside itself (textures) is not read.
    loaded = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise ArtifactError(f"want a triangle mesh, got {type(loaded).__name__} at {path}")
    visual = loaded.visual
    if visual is not None and visual.kind == "vertex":
        rgb = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)  # pyright: ignore
    else:
        rgb = np.full((len(loaded.vertices), 3), 160, np.uint8)
    return Mesh(np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64), rgb)
