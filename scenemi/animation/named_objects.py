"""Objects of a scene by their names, and surfaces of them on which a body sits or rests a hand."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, NonNegativeInt

from scenemi.data.gltf_nodes import GltfFile, read_gltf
from scenemi.data.plain_files import checked
from video2anim.errors import MESSAGE_LETTERS, InputError

SEATS = ("seat", "bed")
"""Parts of objects that are made for sitting; objects without them are sat on where they are level."""
SEAT_M, TOP_M = (0.2, 0.8), (0.4, 1.4)
"""Heights above the floor of what people sit on (a step to a bar stool), and of what a standing adult puts a hand on (a
low table to the shoulder)."""
_SAME_M = 0.03
"""Faces within this of one height are one surface."""


class _Part(BaseModel):
    name: str
    first_face: NonNegativeInt
    face_count: NonNegativeInt


class _Extras(BaseModel):
    """What this project writes beside an object."""

    object_id: NonNegativeInt | None = None
    label: str | None = None
    parts: tuple[_Part, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class NamedObject:
    """An object in the world, +Y up, meters."""

    name: str
    """`chair_2` (label and number) of scenes of this project, else the name of the node."""
    T_world_object: Float[np.ndarray, "4 4"]
    """Its front is +Z of its own frame."""
    triangles_m: Float[np.ndarray, "faces 3 3"]
    parts: tuple[tuple[str, slice], ...]
    """Names and faces; none where the shape has no known parts."""

    @property
    def front(self) -> Float[np.ndarray, "2"]:
        """Unit vector (x, z) out of its front."""
        front = self.T_world_object[[0, 2], 2]
        return front / np.maximum(np.linalg.norm(front), 1e-9)

    def seat(self) -> Float[np.ndarray, "faces 3 3"]:
        """The surface to sit on: the part made for it, else the largest level one at a height for sitting.

        Raises:
            InputError: none.
        """
        made_for = [self.triangles_m[faces] for name, faces in self.parts if name in SEATS]
        found = _level(made_for or [self.triangles_m], SEAT_M)
        if found is None:
            has = ", ".join(sorted({name for name, _ in self.parts})) or "none known"
            raise InputError(
                f"{self.name} has no seat, nothing level {SEAT_M[0]} to {SEAT_M[1]} m above the floor; parts: {has}"
            )
        return found

    def top(self) -> Float[np.ndarray, "faces 3 3"]:
        """The largest level surface at a height for a hand.

        Raises:
            InputError: none.
        """
        found = _level([self.triangles_m], TOP_M)
        if found is None:
            raise InputError(f"{self.name} has nothing level from {TOP_M[0]} to {TOP_M[1]} m above the floor")
        return found


def read_objects(path: Path) -> tuple[NamedObject, ...]:
    """Objects of a `.glb`, by the extras of their nodes; of files without, all meshes by the names of their nodes.

    Raises:
        InputError: another kind of file, or a damaged one.
    """
    if path.suffix.lower() != ".glb":
        raise InputError(f"{path}: postures at objects want a scene whose objects have names, a .glb or a scene folder")
    file = read_gltf(path)
    extras = {node: checked(_Extras, str(path), file.extras[node]) for node in file.meshes}
    labeled = [node for node, one in extras.items() if one.object_id is not None and one.label is not None]
    return tuple(_object(file, node, extras[node], str(path)) for node in labeled or file.meshes)


def object_by_name(objects: Sequence[NamedObject], name: str, where: str) -> NamedObject:
    """The object of a name: `chair_2`, or `chair` where there is one chair only.

    Raises:
        InputError: none or several; it lists the names.
    """
    found = [one for one in objects if one.name == name] or [
        one for one in objects if one.name.rpartition("_")[0] == name
    ]
    if len(found) == 1:
        return found[0]
    names = textwrap.shorten(", ".join(one.name for one in objects) or "none", MESSAGE_LETTERS, placeholder=" ...")
    raise InputError(f"{where}: {'no' if not found else 'more than one'} object {name!r} in the scene; it has {names}")


def _object(file: GltfFile, node: int, extras: _Extras, where: str) -> NamedObject:
    T: Any = file.placed([node], (), np.zeros(1))[0, 0]
    triangles_m = file.meshes[node] @ T[:3, :3].T + T[:3, 3]
    parts = tuple((one.name, slice(one.first_face, one.first_face + one.face_count)) for one in extras.parts)
    if any(faces.stop > len(triangles_m) for _, faces in parts):
        raise InputError(f"{where}: {file.names[node]} has parts of faces that are not there")
    name = file.names[node]
    if extras.label is not None and extras.object_id is not None:
        name = f"{re.sub(r'[^A-Za-z0-9]+', '_', extras.label)}_{extras.object_id}"
    return NamedObject(name, T, triangles_m, parts)


def _level(meshes: Sequence[np.ndarray], height_m: tuple[float, float]) -> np.ndarray | None:
    """Faces of the level surface with the largest area at some heights."""
    triangles_m = np.concatenate(list(meshes))
    normal = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    double_m2 = np.linalg.norm(normal, axis=-1)
    y_m = triangles_m[..., 1].mean(1)
    # As in the contact graph: what looks up more than aside carries.
    carries = (normal[:, 1] > np.hypot(normal[:, 0], normal[:, 2])) & (y_m >= height_m[0]) & (y_m <= height_m[1])
    if not carries.any():
        return None
    order = np.flatnonzero(carries)[np.argsort(y_m[carries])]
    sorted_m = y_m[order]
    area = np.concatenate([[0.0], np.cumsum(double_m2[order])])
    first = np.searchsorted(sorted_m, sorted_m - _SAME_M, "left")
    stop = np.searchsorted(sorted_m, sorted_m + _SAME_M, "right")
    best = int((area[stop] - area[first]).argmax())
    return triangles_m[order[first[best] : stop[best]]]
