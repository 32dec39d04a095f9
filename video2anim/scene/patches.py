"""Rectangles on planes as colored grids, and which cells of them stand for something that was seen or is hidden."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from video2anim.geometry.harmonic import harmonic_fill
from video2anim.geometry.scene_mesh import empty_mesh, grid_faces
from video2anim.scene.view import View
from video2anim.types.scene import Mesh

_UNSEEN_RGB = 128.0
"""Gray where the plate shows nothing of a patch."""
_LEAST_M2 = 1e-8
"""Twice the area of a triangle; less has no direction to face in single precision."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A rectangle of a plane: origin + a * across + b * upward, for a and b on a grid."""

    origin_m: Float[np.ndarray, "3"]
    across: Float[np.ndarray, "3"]
    """Unit vectors in the world; across x upward is the side that triangles face."""
    upward: Float[np.ndarray, "3"]
    low_m: Float[np.ndarray, "2"]
    """Least a and b."""
    high_m: Float[np.ndarray, "2"]

    def grid(self, cell_m: float) -> Float[np.ndarray, "rows columns 3"]:
        """Points of the world, at most `cell_m` apart; a along columns, b along rows."""
        columns, rows = (max(2, int(np.ceil(e / cell_m)) + 1) for e in np.maximum(self.high_m - self.low_m, 1e-3))
        a, b = np.linspace(self.low_m[0], self.high_m[0], columns), np.linspace(self.low_m[1], self.high_m[1], rows)
        return self.origin_m + a[None, :, None] * self.across + b[:, None, None] * self.upward


def tidy(kept: Bool[np.ndarray, "rows columns"], radius: int) -> Float[np.ndarray, "rows columns"]:
    """A field over a grid's nodes, positive where they are kept, that is zero on a smooth outline: without holes, and
    without slits, spurs and crumbs narrower than twice the radius (in nodes)."""
    if kept.all() or not kept.any():
        return kept - 0.5
    size = 2 * radius + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    padded = np.pad(kept.astype(np.uint8), 2 * size, mode="edge")
    smooth = cv2.morphologyEx(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk), cv2.MORPH_OPEN, disk)
    smooth = np.asarray(ndimage.binary_fill_holes(smooth), np.float32)
    return cv2.GaussianBlur(smooth, (0, 0), max(0.5 * radius, 0.6))[2 * size : -2 * size, 2 * size : -2 * size] - 0.5


def cut_mesh(
    nodes_m: Float[np.ndarray, "rows columns 3"],
    rgb: UInt8[np.ndarray, "rows columns 3"],
    field: Float[np.ndarray, "rows columns"],
) -> Mesh:
    """Triangles of a grid, facing across x upward, cut along the line where a field is zero; what is above is kept."""
    rows, columns = nodes_m.shape[:2]
    faces = grid_faces(rows, columns)[:, ::-1]
    points, colors, value = nodes_m.reshape(-1, 3), rgb.reshape(-1, 3).astype(np.float64), field.ravel()
    above = value[faces] > 0
    count = above.sum(1)
    corners = [faces[count == 3]]
    for kept, alone in ((1, above), (2, ~above)):
        some = faces[count == kept]
        # The corner that is alone on its side first; the other two follow in turn.
        turn = (np.argmax(alone[count == kept], axis=1)[:, None] + np.arange(3)) % 3
        first, second, third = np.take_along_axis(some, turn, axis=1).T
        ends = []
        for other in (second, third):
            share = (value[first] / (value[first] - value[other]))[:, None]
            ends.append(len(points) + np.arange(len(first)))
            points = np.concatenate([points, points[first] + share * (points[other] - points[first])])
            colors = np.concatenate([colors, colors[first] + share * (colors[other] - colors[first])])
        if kept == 1:
            corners.append(np.stack([first, ends[0], ends[1]], 1))
        else:
            corners += [np.stack([ends[0], second, third], 1), np.stack([ends[0], third, ends[1]], 1)]
    chosen = np.concatenate(corners)
    a, b, c = (points[chosen[:, k]] for k in range(3))
    chosen = chosen[np.linalg.norm(np.cross(b - a, c - a), axis=1) > _LEAST_M2]
    if not len(chosen):
        return empty_mesh()
    used, local = np.unique(chosen, return_inverse=True)
    rounded = np.round(colors[used]).astype(np.uint8)
    return Mesh(points[used].astype(np.float32), local.reshape(-1, 3).astype(np.int64), rounded)


def painted(
    nodes_m: Float[np.ndarray, "rows columns 3"],
    view: View,
    shown: Bool[np.ndarray, "height width"],
    plate_rgb: UInt8[np.ndarray, "height width 3"],
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Colors of a grid: the plate's where the view's pixels of `shown` show it, between and around a smooth blend.

    Args:
        plate_rgb: the view's picture at any size.
    """
    pixel, _, inside = view.pixels(nodes_m.reshape(-1, 3))
    column, row = (np.where(inside, np.round(pixel[:, k]), 0).astype(int) for k in (0, 1))
    told = (inside & shown[row, column]).reshape(nodes_m.shape[:2])
    if not told.any():
        usual = np.median(view.rgb[shown], axis=0) if shown.any() else np.full(3, _UNSEEN_RGB)
        return np.broadcast_to(usual.astype(np.uint8), (*told.shape, 3)).copy()
    scale = np.array([plate_rgb.shape[1] / view.shape[1], plate_rgb.shape[0] / view.shape[0]])
    at = ((pixel + 0.5) * scale - 0.5).astype(np.float32).reshape(*told.shape, 2)
    color = cv2.remap(plate_rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    filled = harmonic_fill(color.astype(np.float64), told)
    return np.clip(np.round(filled), 0, 255).astype(np.uint8)


def clear(mask: Bool[np.ndarray, "height width"], by_px: int) -> Bool[np.ndarray, "height width"]:
    """The mask without what is so near to its outline; the picture's border is none."""
    padded = np.pad(mask, by_px, mode="edge").astype(np.uint8)
    return cv2.erode(padded, np.ones((2 * by_px + 1,) * 2))[by_px:-by_px, by_px:-by_px].astype(bool)
