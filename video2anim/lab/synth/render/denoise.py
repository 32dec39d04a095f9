"""Denoising: averages the sample pattern within surfaces, never across their edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.lab.synth.render.vectors import dot

_SAME_NORMAL = 0.93
_OFF_PLANE = 0.006
"""Two pixels are on one surface if their distance to each other's plane is less than this share of the depth."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Which neighboring pixels are on the same surface."""

    right: Bool[np.ndarray, "height width-1"]
    down: Bool[np.ndarray, "height-1 width"]

    def edges(self) -> Bool[np.ndarray, "height width"]:
        """Pixels with a neighbor on another surface."""
        height, width = len(self.right), self.down.shape[1]
        edge = np.zeros((height, width), bool)
        edge[:, :-1] |= ~self.right
        edge[:, 1:] |= ~self.right
        edge[:-1] |= ~self.down
        edge[1:] |= ~self.down
        return edge

    def cropped(self, rows: slice, columns: slice) -> Links:
        """Links within a rectangle."""
        return Links(self.right[rows, columns.start : columns.stop - 1], self.down[rows.start : rows.stop - 1, columns])


def link(
    label: Int[np.ndarray, "height width"],
    normal: Float[np.ndarray, "height width 3"],
    position_m: Float[np.ndarray, "height width 3"],
    depth_m: Float[np.ndarray, "height width"],
) -> Links:
    """Links by equal label, similar normal and common plane. Label 0 (no surface) is linked to itself."""

    def same(a: tuple, b: tuple) -> np.ndarray:
        step = position_m[a] - position_m[b]
        off = np.maximum(np.abs(dot(step, normal[a])), np.abs(dot(step, normal[b])))
        alike = dot(normal[a], normal[b]) > _SAME_NORMAL
        near = off < _OFF_PLANE * np.minimum(depth_m[a], depth_m[b])
        return (label[a] == label[b]) & ((alike & near) | (label[a] == 0))

    every, near, far = slice(None), slice(None, -1), slice(1, None)
    return Links(same((every, near), (every, far)), same((near, every), (far, every)))


def smooth_tiles(values: Float[np.ndarray, "height width channels"], links: Links) -> np.ndarray:
    """Box filter of the size of one tile (weights 1/2 1 1 1 1/2 per axis) over linked pixels."""
    planes = np.ascontiguousarray(np.moveaxis(values, -1, 0))
    return np.moveaxis(_smooth_along(_smooth_along(planes, links.right, 2), links.down, 1), 0, -1)


def _smooth_along(planes: np.ndarray, linked: np.ndarray, axis: int) -> np.ndarray:
    """(channels, height, width) averaged along an axis over linked neighbors."""

    def part(array: np.ndarray, cut: slice) -> np.ndarray:
        return array[..., cut] if axis == 2 else array[..., cut, :]

    one = linked.astype(np.float32)
    two = 0.5 * part(one, slice(None, -1)) * part(one, slice(1, None))
    total, weight = planes.copy(), np.ones(planes.shape[1:], np.float32)
    for step, share in ((1, one), (2, two)):
        if planes.shape[axis] > step:
            before, after = slice(None, -step), slice(step, None)
            part(total, before)[...] += share * part(planes, after)
            part(total, after)[...] += share * part(planes, before)
            part(weight, before)[...] += share
            part(weight, after)[...] += share
    return total / weight
