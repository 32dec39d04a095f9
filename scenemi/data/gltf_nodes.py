"""Nodes, skins and animations of a glTF binary file, as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError, expect_file, one_line
from video2anim.geometry.rotations import matrix_from_quaternion, nearest_rotation, quaternion_from_matrix, slerp

_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
"""Numbers in a row of an accessor."""
_STILL = {
    "translation": np.array([0.0, 0.0, 0.0]),
    "rotation": np.array([0.0, 0.0, 0.0, 1.0]),
    "scale": np.array([1.0, 1.0, 1.0]),
}
"""What can be animated, and its value where a node says nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One property of a node over time."""

    node: int
    path: str
    """`translation`, `rotation` (x, y, z, w) or `scale`."""
    time_s: Float[np.ndarray, "keys"]
    values: Float[np.ndarray, "keys parts size"]
    """One part; for CUBICSPLINE three: tangent in, value, tangent out."""
    mode: str

    def at(self, time_s: Float[np.ndarray, "frames"]) -> Float[np.ndarray, "frames size"]:
        """Values at times; before the first and after the last key they are held."""
        time_s = np.clip(time_s, self.time_s[0], self.time_s[-1])
        left = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, max(len(self.time_s) - 2, 0))
        right = np.minimum(left + 1, len(self.time_s) - 1)
        step_s = (self.time_s[right] - self.time_s[left])[:, None]
        u = np.where(step_s > 0, (time_s - self.time_s[left])[:, None] / np.where(step_s > 0, step_s, 1.0), 0.0)
        middle = self.values.shape[1] // 2
        a, b = self.values[left, middle], self.values[right, middle]
        if self.mode == "STEP":
            return np.where(u < 1, a, b)
        if self.mode == "CUBICSPLINE":
            out, into = self.values[left, 2] * step_s, self.values[right, 0] * step_s
            share = u * u * (3 - 2 * u)
            return (1 - share) * a + share * b + u * (1 - u) * ((1 - u) * out - u * into)
        return slerp(a, b, u) if self.path == "rotation" else a + u * (b - a)


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """Nodes in the world."""

    position_m: Float[np.ndarray, "frames nodes 3"]
    R_world: Float[np.ndarray, "frames nodes 3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """Joints of a skin and where they were when it was bound."""

    nodes: tuple[int, ...]
    T_bind: Float[np.ndarray, "joints 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class GltfFile:
    """What a file says of its nodes."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    extras: tuple[dict[str, Any], ...]
    still: dict[str, Float[np.ndarray, "nodes size"]]
    """Translation, rotation (x, y, z, w) and scale without animation."""
    meshes: dict[int, Float[np.ndarray, "faces 3 3"]]
    """Triangles of nodes in their own frames; people, which have a skin, are left out."""
    skins: tuple[Skin, ...]
    animations: tuple[tuple[Channel, ...], ...]

    def ancestors(self, node: int) -> list[int]:
        """From the parent up."""
        found = []
        while (node := self.parents[node]) >= 0:
            found.append(node)
        return found

    def descendants(self, node: int) -> tuple[int, ...]:
        """The node and what hangs from it, parents first."""
        children: dict[int, list[int]] = {}
        for child, parent in enumerate(self.parents):
            children.setdefault(parent, []).append(child)
        found = [node]
        for one in found:
            found += children.get(one, [])
        return tuple(found)

    def posed(self, nodes: Sequence[int], channels: Sequence[Channel], time_s: Float[np.ndarray, "frames"]) -> Posed:
        """Nodes at times; `nodes` are of one tree, parents first."""
        T = self.placed(nodes, channels, time_s)
        return Posed(T[..., :3, 3].copy(), nearest_rotation(T[..., :3, :3]))

    def placed(
        self, nodes: Sequence[int], channels: Sequence[Channel], time_s: Float[np.ndarray, "frames"]
    ) -> Float[np.ndarray, "frames nodes 4 4"]:
        """The same with scales, by forward kinematics over all ancestors."""
        ahead = self.ancestors(nodes[0])[::-1]
        T_world: dict[int, np.ndarray] = {-1: np.tile(np.eye(4), (len(time_s), 1, 1))}
        of = {(channel.node, channel.path): channel for channel in channels}
        for node in (*ahead, *nodes):
            part = {path: np.tile(self.still[path][node], (len(time_s), 1)) for path in _STILL}
            part |= {path: of[node, path].at(time_s) for path in _STILL if (node, path) in of}
            T = np.tile(np.eye(4), (len(time_s), 1, 1))
            T[:, :3, :3] = matrix_from_quaternion(np.roll(part["rotation"], 1, -1)) * part["scale"][:, None]
            T[:, :3, 3] = part["translation"]
            T_world[node] = T_world[self.parents[node]] @ T
        return np.stack([T_world[node] for node in nodes], 1)

    def bound(self, nodes: Sequence[int], skin: Skin) -> Posed:
        """Nodes where they were when the skin was bound; those that are no joints of it go with their parents."""
        T: dict[int, np.ndarray] = dict(zip(skin.nodes, skin.T_bind, strict=True))
        for node in nodes:
            if node not in T:
                above = T.get(self.parents[node], np.eye(4))
                T[node] = above.copy()
                T[node][:3, 3] = above[:3, :3] @ self.still["translation"][node] + above[:3, 3]
        every = np.stack([T[node] for node in nodes])[None]
        return Posed(every[..., :3, 3].copy(), nearest_rotation(every[..., :3, :3]))


def read_gltf(path: Path) -> GltfFile:
    """Nodes, meshes, skins and animations of a `.glb`.

    Raises:
        InputError: missing, damaged, or with files beside it.
    """
    import pygltflib

    expect_file(path, "glTF file")
    try:
        document = pygltflib.GLTF2.load_from_bytes(path.read_bytes())
        if document is None:
            raise ValueError("no binary glTF 2.0")
        return _read(document)
    except Exception as error:  # the library's parser raises classes of many kinds
        raise InputError(f"{path}: cannot be read as a binary glTF (.glb): {one_line(error)}") from error


def _read(document: Any) -> GltfFile:
    nodes = document.nodes or []
    parents = [-1] * len(nodes)
    for number, node in enumerate(nodes):
        for child in node.children or ():
            if parents[child] >= 0 or child == number:
                raise ValueError(f"node {child} hangs from two others")
            parents[child] = number
    below = [number for number, parent in enumerate(parents) if parent < 0]
    for number in below:
        below += nodes[number].children or []
    if len(below) < len(nodes):
        raise ValueError("nodes hang from each other in a circle")
    still = {name: np.stack([_still(node)[name] for node in nodes]) for name in _STILL} if nodes else {}
    skins = tuple(_skin(document, skin) for skin in document.skins or ())
    animations = tuple(
        tuple(_channel(document, one, channel) for channel in one.channels if channel.target.path in _STILL)
        for one in document.animations or ()
    )
    names = tuple(str(node.name or f"node_{number}") for number, node in enumerate(nodes))
    extras = tuple(node.extras if isinstance(node.extras, dict) else {} for node in nodes)
    meshes = {
        number: _triangles(document, document.meshes[node.mesh])
        for number, node in enumerate(nodes)
        if node.mesh is not None and node.skin is None
    }
    return GltfFile(names, tuple(parents), extras, still, meshes, skins, animations)


def _triangles(document: Any, mesh: Any) -> np.ndarray:
    """Corners of the faces of all its parts, in the order of the file."""
    from pygltflib import TRIANGLES

    found = [np.zeros((0, 3, 3))]
    for part in mesh.primitives:
        if part.mode in (None, TRIANGLES) and part.attributes.POSITION is not None:
            corners = _accessor(document, part.attributes.POSITION)
            order = np.arange(len(corners)) if part.indices is None else _accessor(document, part.indices)[:, 0]
            found.append(corners[order.astype(np.int64)].reshape(-1, 3, 3))
    return np.concatenate(found)


def _still(node: Any) -> dict[str, np.ndarray]:
    if node.matrix is not None:
        T = np.array(node.matrix, float).reshape(4, 4).T
        scale = np.linalg.norm(T[:3, :3], axis=0)
        xyzw = np.roll(quaternion_from_matrix(nearest_rotation(T[:3, :3] / scale)[None])[0], -1)
        return {"translation": T[:3, 3], "rotation": xyzw, "scale": scale}
    given = {"translation": node.translation, "rotation": node.rotation, "scale": node.scale}
    return {name: _STILL[name] if value is None else _sized(value, len(_STILL[name])) for name, value in given.items()}


def _sized(value: Any, size: int) -> np.ndarray:
    found = np.array(value, float)
    if found.shape != (size,) or not np.isfinite(found).all():
        raise ValueError(f"want {size} finite numbers")
    return found


def _skin(document: Any, skin: Any) -> Skin:
    nodes = tuple(int(node) for node in skin.joints)
    if skin.inverseBindMatrices is None:
        return Skin(nodes, np.tile(np.eye(4), (len(nodes), 1, 1)))
    inverse = _accessor(document, skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    return Skin(nodes, np.linalg.inv(inverse[: len(nodes)]))


def _channel(document: Any, animation: Any, channel: Any) -> Channel:
    sampler = animation.samplers[channel.sampler]
    time_s = _accessor(document, sampler.input).reshape(-1)
    mode, size = sampler.interpolation or "LINEAR", len(_STILL[channel.target.path])
    parts = 3 if mode == "CUBICSPLINE" else 1
    values = _accessor(document, sampler.output).reshape(len(time_s), parts, size)
    if not len(time_s) or (np.diff(time_s) <= 0).any():
        raise ValueError("times of an animation do not rise")
    return Channel(int(channel.target.node), channel.target.path, time_s, values, mode)


def _accessor(document: Any, number: int) -> np.ndarray:
    """Numbers of an accessor, (count, width); integers that stand for fractions become those."""
    from pygltflib import BYTE, FLOAT, SHORT, UNSIGNED_BYTE, UNSIGNED_INT, UNSIGNED_SHORT

    kinds = {
        BYTE: np.int8, UNSIGNED_BYTE: np.uint8, SHORT: np.int16, UNSIGNED_SHORT: np.uint16, UNSIGNED_INT: np.uint32,
        FLOAT: np.float32,
    }  # fmt: skip
    accessor = document.accessors[number]
    if accessor.sparse is not None or accessor.bufferView is None:
        raise ValueError("sparse numbers are not read; export again without")
    view = document.bufferViews[accessor.bufferView]
    if document.buffers[view.buffer].uri is not None:
        raise ValueError("its numbers are in another file; export as one .glb")
    kind, width = np.dtype(kinds[accessor.componentType]), _WIDTHS[accessor.type]
    data = document.binary_blob()
    start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
    stride = view.byteStride or width * kind.itemsize
    rows = np.lib.stride_tricks.as_strided(
        np.frombuffer(data, np.uint8, stride * (accessor.count - 1) + width * kind.itemsize, start),
        (accessor.count, width * kind.itemsize), (stride, 1), writeable=False,
    )  # fmt: skip
    found = np.ascontiguousarray(rows).view(kind.newbyteorder("<")).astype(float)
    if accessor.normalized:
        found = np.maximum(found / np.iinfo(kind).max, -1.0)
    if not np.isfinite(found).all():
        raise ValueError("numbers that are not finite")
    return found
