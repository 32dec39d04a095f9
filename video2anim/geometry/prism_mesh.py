"""A closed mesh from one view: the outline on an upright front plane, carried back by an assumed thickness.

The front is the plane through the foot line (or, failing that, through the visible points), the outline lies on it, and
the back is the front carried away from the camera. What is not seen is an assumption, and the method's name says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_fill_holes

_LEAST_THICKNESS_M = 0.08


@dataclass(frozen=True, slots=True, eq=False)
class FrontPlane:
    """An upright plane in the world with axes: x along the front to the right, y up, z out towards the camera."""

    R_world_front: Float[np.ndarray, "3 3"]
    origin_world_m: Float[np.ndarray, "3"]
    """On the floor."""

    @property
    def yaw_rad(self) -> float:
        """Turn about +Y that brings the world's +Z to the front's normal."""
        return float(np.arctan2(self.R_world_front[0, 2], self.R_world_front[2, 2]))


def front_plane(points_world_m: Float[np.ndarray, "points 3"], camera_world_m: Float[np.ndarray, "3"]) -> FrontPlane:
    """Upright plane through the visible points: its direction is their main horizontal one, unless they form a blob,
    which faces the camera.

    Points of a broad front scatter along it; the direction is taken by an iteratively trimmed principal axis.
    """
    flat = points_world_m[:, [0, 2]]
    kept = np.ones(len(flat), dtype=bool)
    along, middle = np.array([1.0, 0.0]), np.median(flat, axis=0)
    spread = np.ones(2)
    for _ in range(4):
        middle = np.median(flat[kept], axis=0)
        values, vectors = np.linalg.eigh(np.cov((flat[kept] - middle).T) + 1e-9 * np.eye(2))
        spread, along = np.sqrt(values), vectors[:, 1]
        across = np.abs((flat - middle) @ vectors[:, 0])
        kept = across <= max(np.percentile(across, 85), 1e-3)
    view = camera_world_m[[0, 2]] - middle
    view = view / max(float(np.linalg.norm(view)), 1e-9)
    normal = np.array([-along[1], along[0]])
    if spread[1] < 1.8 * spread[0] or abs(normal @ view) < 0.35:
        normal = view
    normal = normal * (1.0 if normal @ view >= 0 else -1.0)
    z = np.array([normal[0], 0.0, normal[1]])
    y = np.array([0.0, 1.0, 0.0])
    return FrontPlane(np.stack([np.cross(y, z), y, z], -1), np.array([middle[0], 0.0, middle[1]]))


def pixel_outline(
    rays_world: Float[np.ndarray, "pixels 3"], camera_world_m: Float[np.ndarray, "3"], plane: FrontPlane
) -> Float[np.ndarray, "pixels 2"]:
    """Where rays meet the front plane, in its x and y; NaN where they do not."""
    normal = plane.R_world_front[:, 2]
    towards = rays_world @ normal
    reach = ((plane.origin_world_m - camera_world_m) @ normal) / np.where(np.abs(towards) < 1e-6, np.nan, towards)
    hit = camera_world_m + rays_world * np.where(reach > 0, reach, np.nan)[:, None]
    return ((hit - plane.origin_world_m) @ plane.R_world_front)[:, :2]


@dataclass(frozen=True, slots=True, eq=False)
class OutlineCells:
    """An outline as cells of the front plane."""

    cells: Bool[np.ndarray, "rows columns"]
    """Row 0 is the lowest, column 0 the leftmost."""
    corner_m: Float[np.ndarray, "2"]
    """Lower-left corner."""
    size_m: Float[np.ndarray, "2"]
    """Width and height of a cell."""


@dataclass(frozen=True, slots=True, eq=False)
class Prism:
    """Closed mesh on a grid of cells, in front-plane coordinates."""

    vertices_m: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


def outline_cells(outline_m: Float[np.ndarray, "pixels 2"], most_cells: int) -> OutlineCells:
    """Cells that the outline covers.

    One connected piece without holes and without cells that touch at a corner only, so that its prism is watertight.
    """
    finite = outline_m[np.isfinite(outline_m).all(1)]
    low, high = np.percentile(finite, [0.5, 99.5], axis=0)
    extent = np.maximum(high - low, 0.02)
    cell_m = float(np.sqrt(extent.prod() / most_cells))
    shape = np.maximum(np.round(extent / cell_m).astype(int), 1)
    index = np.floor((finite - low) / extent * shape).astype(int)
    index = index[((index >= 0) & (index < shape)).all(1)]
    counts = np.zeros((shape[1], shape[0]))
    np.add.at(counts, (index[:, 1], index[:, 0]), 1)
    usual = np.median(counts[counts > 0]) if counts.any() else 1
    cells = counts >= 0.4 * usual
    count, pieces = cv2.connectedComponents(cells.astype(np.uint8), connectivity=4)
    if count > 2:
        cells = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])
    return OutlineCells(_no_pinches(cells), low, extent / shape)


def _no_pinches(cells: np.ndarray) -> np.ndarray:
    """Fill holes, and one of the empty cells wherever two cells touch at a corner only."""
    while True:
        cells = np.asarray(binary_fill_holes(cells), dtype=bool)
        a, b, c, d = cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]
        falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
        if not falling.any() and not rising.any():
            return cells
        rows, columns = np.nonzero(falling)
        cells[rows, columns + 1] = True
        rows, columns = np.nonzero(rising)
        cells[rows, columns] = True


def cell_relief(
    outline: OutlineCells, pixels_m: Float[np.ndarray, "pixels 2"], relief_m: Float[np.ndarray, "pixels"]
) -> Float[np.ndarray, "rows columns"]:
    """Median height of visible points over the front plane, per cell; 0 where a cell has none."""
    index = np.floor((pixels_m - outline.corner_m) / outline.size_m).astype(int)
    rows, columns = outline.cells.shape
    inside = ((index >= 0) & (index < [columns, rows])).all(1) & np.isfinite(relief_m)
    key, height = index[inside, 1] * columns + index[inside, 0], relief_m[inside]
    relief = np.zeros(rows * columns)
    order = np.argsort(key, kind="stable")
    cell, start = np.unique(key[order], return_index=True)
    for k, values in zip(cell, np.split(height[order], start[1:]), strict=True):
        relief[k] = np.median(values)
    return relief.reshape(rows, columns)


def prism_of_outline(
    outline: OutlineCells, thickness_m: float, relief_m: Float[np.ndarray, "rows columns"] | None = None
) -> Prism:
    """Watertight mesh: front near z = 0 facing +z, raised by the relief, and a flat back at z = -thickness.

    The first half of the vertices is the front, the second half the same places on the back.

    Raises:
        ValueError: no cell is set.
    """
    cells = outline.cells
    if not cells.any():
        raise ValueError("prism_of_outline: want at least one cell, got none")
    thickness_m = max(thickness_m, _LEAST_THICKNESS_M)
    rows, columns = np.nonzero(cells)
    wide = cells.shape[1] + 1
    low_left = rows * wide + columns
    corner = np.stack([low_left, low_left + 1, low_left + wide + 1, low_left + wide], -1)
    used, local = np.unique(corner, return_inverse=True)
    quad, count = local.reshape(corner.shape), len(used)
    front = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    edges = np.concatenate([quad[:, [k, (k + 1) % 4]] for k in range(4)])
    rim = edges[~np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])]
    start, stop = rim[:, 0], rim[:, 1]
    sides = [np.stack([stop, start, start + count], -1), np.stack([stop, start + count, stop + count], -1)]
    flat = np.stack([used % wide, used // wide], -1) * outline.size_m + outline.corner_m
    raised = np.zeros(count)
    if relief_m is not None:
        np.add.at(raised, quad.ravel(), np.repeat(relief_m[rows, columns], 4))
        raised /= np.bincount(quad.ravel(), minlength=count)
    raised = np.clip(raised, 0.3 * _LEAST_THICKNESS_M - thickness_m, thickness_m)
    vertices = np.concatenate([np.column_stack([flat, raised]), np.column_stack([flat, np.full(count, -thickness_m)])])
    return Prism(vertices, np.concatenate([front, front[:, ::-1] + count, *sides]).astype(np.int64))
