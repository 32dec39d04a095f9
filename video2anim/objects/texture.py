"""A picture for the faces of a low mesh: every face gets its own patch, with texels at known places of the surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, UInt8

from video2anim.types.scene import Texture

_SIDE_PX = 512
"""Width of a texture: an object that fills the picture has about as many pixels across."""
_FILL = 0.75
"""Share of it that patches fill."""
_BORDER_PX = 1
"""Texels beyond the edges of a patch, for filters."""


def textured(
    vertices_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    color: Callable[[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"]], UInt8[np.ndarray, "points 3"]],
    finest_m: float,
) -> Texture:
    """The texture of a mesh.

    Args:
        color: Colors of points with unit normals.
        finest_m: Texels are no smaller.
    """
    corners = vertices_m[faces]
    # The corner nearest to a right angle becomes the origin of its patch.
    edges = np.roll(corners, -1, 1) - corners
    length = np.maximum(np.linalg.norm(edges, axis=-1), 1e-9)
    cosine = -(edges * np.roll(edges, 1, 1)).sum(-1) / (length * np.roll(length, 1, 1))
    origin = np.abs(cosine).argmin(1)
    order = (origin[:, None] + np.arange(3)) % 3
    a, b, c = (np.take_along_axis(corners, order[:, k, None, None], 1)[:, 0] for k in range(3))
    extent_m = np.stack([np.linalg.norm(b - a, axis=-1), np.linalg.norm(c - a, axis=-1)], -1)
    texel_m = max(float(np.sqrt(extent_m.prod(1).sum() / (_FILL * _SIDE_PX**2))), finest_m)
    while True:
        size = np.maximum(np.ceil(extent_m / texel_m), 1).astype(int) + 1
        corner, height = _packed(size + 2 * _BORDER_PX)
        if corner is not None and height <= _SIDE_PX:
            break
        texel_m *= 1.1
    face, u, v, column, row = _texels(size, corner)
    across, along = (size[face] - 1).T
    s, t = np.clip(u / across, 0, 1)[:, None], np.clip(v / along, 0, 1)[:, None]
    # Half of a patch is beyond its face: those texels have the color of the face's long edge.
    over = np.maximum(s + t - 1, 0) / 2
    s, t = s - over, t - over
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    rgb = np.full((height, _SIDE_PX, 3), 127, np.uint8)
    rgb[row, column] = color(a[face] + s * (b - a)[face] + t * (c - a)[face], normal[face])
    low, high = corner + _BORDER_PX + 0.5, corner + _BORDER_PX + size - 0.5
    uv = np.stack([low, np.stack([high[:, 0], low[:, 1]], -1), np.stack([low[:, 0], high[:, 1]], -1)], 1)
    corner_uv = np.empty_like(uv)
    np.put_along_axis(corner_uv, order[:, :, None], uv / [_SIDE_PX, height], 1)
    return Texture(rgb, corner_uv.astype(np.float32))


def _packed(size: Int[np.ndarray, "faces 2"]) -> tuple[Int[np.ndarray, "faces 2"] | None, int]:
    """Upper left corners of rectangles in rows of falling height, and the height of all; None where one is too wide."""
    if size[:, 0].max() > _SIDE_PX:
        return None, 0
    corner = np.zeros_like(size)
    x = y = tall = 0
    for number in np.argsort(-size[:, 1], kind="stable"):
        width, height = size[number]
        if x + width > _SIDE_PX:
            x, y, tall = 0, y + tall, 0
        corner[number] = x, y
        x, tall = x + width, max(tall, height)
    return corner, int(y + tall)


def _texels(size: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, ...]:
    """Face, place in its patch and in the texture of every texel."""
    found = []
    for face, ((width, height), (x, y)) in enumerate(zip(size, corner, strict=True)):
        v, u = np.mgrid[-_BORDER_PX : height + _BORDER_PX, -_BORDER_PX : width + _BORDER_PX].reshape(2, -1)
        found.append(np.stack([np.full(len(u), face), u, v, x + u + _BORDER_PX, y + v + _BORDER_PX]))
    return tuple(np.concatenate(found, 1))
