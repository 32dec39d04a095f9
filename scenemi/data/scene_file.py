"""Scenes from files: meshes and clouds of points of one world, +Y up, meters."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict

from scenemi.data.plain_files import Numbers, checked, read_arrays, shaped
from scenemi.scene.scene_parts import ScenePart, expect_scene
from video2anim.errors import MESSAGE_LETTERS, InputError, one_line
from video2anim.mesh_file import MESH_SUFFIXES, expect_few_faces, read_mesh_parts

SCENE_SUFFIXES = (*MESH_SUFFIXES, ".npz")


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
    return SceneFile(expect_scene(str(path), found.parts), found.notes)


def read_meshes(path: Path) -> SceneFile:
    """All meshes and clouds of points of a mesh file, as they are, but skinned ones.

    Raises:
        InputError: the file is missing, cut off, damaged or of no known kind.
    """
    found = read_mesh_parts(path, "scene", colored=False)
    try:
        parts = tuple(ScenePart(_rows(part, "vertices", float), _rows(part, "faces", int)) for part in found.parts)
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as a scene: {one_line(error)}") from error
    if any(len(part.faces) and not 0 <= part.faces.min() <= part.faces.max() < len(part.vertices_m) for part in parts):
        raise InputError(f"{path}: faces point at vertices that are not there")
    if not found.people:
        return SceneFile(parts)
    names = textwrap.shorten(", ".join(found.people), MESSAGE_LETTERS, placeholder=" ...")
    return SceneFile(parts, (f"skinned meshes (people) of the scene are left out: {names}",))


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
    expect_few_faces(len(faces), str(path), "scene")
    return SceneFile((ScenePart(points_m.astype(np.float64), faces.astype(np.int64)),))
