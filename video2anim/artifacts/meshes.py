"""Meshes on disk as binary PLY with vertex colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from video2anim.errors import ArtifactError
from video2anim.types.scene import Mesh

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
_FACE = np.dtype([("count", "u1"), ("index", "<i4", (3,))])


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


def read_ply(path: Path) -> Mesh:
    """Read a PLY, also one saved by a 3D program (polygons are triangulated, missing colours are gray).

    Raises:
        ArtifactError: no mesh in the file.
    """
    data = path.read_bytes()
    if b"element vertex 0\n" in data[:400]:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))
    import trimesh

    loaded = trimesh.load_mesh(path, process=False)
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise ArtifactError(f"want a triangle mesh, got {type(loaded).__name__} at {path}")
    visual = loaded.visual
    if visual is not None and visual.kind == "vertex":
        rgb = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)  # pyright: ignore
    else:
        rgb = np.full((len(loaded.vertices), 3), 160, np.uint8)
    return Mesh(np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64), rgb)
