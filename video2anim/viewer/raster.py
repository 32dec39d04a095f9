"""A small z-buffer renderer in numpy: shaded triangles and lines, no graphics driver needed.

Camera axes are OpenCV's; pixel (0, 0) is the center of the top-left pixel. Triangles are grouped by the size of
their pixel box, and each group is tested against a square of pixels at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from video2anim.geometry.vertex_normals import vertex_normals
from video2anim.types import Intrinsics
from video2anim.viewer.clipping import clip_segments_near, clip_triangles_near

_LIGHT = np.array([-0.35, -0.65, -0.67])
"""Unit direction towards the light in camera axes: over the viewer's left shoulder."""
_AMBIENT = 0.42
"""Brightness of a surface that the light only grazes, chosen by eye."""
_BATCH_PIXELS = 1 << 19
"""Pixels tested at once, which bounds memory."""
_TILE_PX = 256
"""Pixel boxes of larger triangles are split, which bounds memory."""

Light = Literal["none", "flat", "smooth"]
_EDGE_SLACK = 1e-9
"""Rounding allowed in the inside test, so that neighbors leave no gap along their common edge."""
_LINE_BIAS = 0.995
"""Lines are drawn this much nearer, so that they win against the surface they lie on."""


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """A picture under construction; drawing changes its arrays in place."""

    rgb: UInt8[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "height width"]
    """Distance along the view axis, infinite where nothing is drawn."""

    @classmethod
    def blank(cls, width_px: int, height_px: int, rgb: tuple[int, int, int] = (238, 240, 243)) -> Canvas:
        """A canvas of one color."""
        picture = np.empty((height_px, width_px, 3), np.uint8)
        picture[:] = rgb
        return cls(picture, np.full((height_px, width_px), np.inf, np.float32))

    @classmethod
    def over(cls, rgb: UInt8[np.ndarray, "height width 3"]) -> Canvas:
        """A canvas that starts as a copy of a picture."""
        return cls(rgb.copy(), np.full(rgb.shape[:2], np.inf, np.float32))

    def copy(self) -> Canvas:
        return Canvas(self.rgb.copy(), self.depth_m.copy())


def draw_mesh(
    canvas: Canvas,
    vertices_camera_m: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    vertex_rgb: UInt8[np.ndarray, "vertices 3"],
    intrinsics: Intrinsics,
    *,
    closed: bool = False,
    light: Light = "flat",
) -> None:
    """Draw triangles with depth test.

    Args:
        canvas: Picture of the size the intrinsics say.
        vertices_camera_m: Corners in camera axes.
        faces: Vertex numbers, counter-clockwise seen from outside.
        vertex_rgb: Color of each vertex.
        intrinsics: Camera.
        closed: Leave out faces turned away (right only for closed surfaces).
        light: Shade by the angle to a light beside the viewer, per face (`flat`) or per vertex (`smooth`); with
            `none` colors are shown as they are.
    """
    if len(faces) == 0:
        return
    corners = np.asarray(vertices_camera_m, np.float64)[faces]
    colors = vertex_rgb[faces].astype(np.float32)
    if light == "flat":
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
        colors *= _brightness(normals / length)[:, None, None]
    elif light == "smooth":
        colors *= _brightness(vertex_normals(vertices_camera_m, faces))[faces][..., None]
    corners, colors = clip_triangles_near(corners, colors)
    inverse_depth = 1.0 / corners[..., 2]
    u = intrinsics.fx_px * corners[..., 0] * inverse_depth + intrinsics.cx_px
    v = intrinsics.fy_px * corners[..., 1] * inverse_depth + intrinsics.cy_px
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    # Counter-clockwise from outside has negative area where +v points down.
    facing = area < 0 if closed else area != 0
    height_px, width_px = canvas.depth_m.shape
    u_low, u_high = _pixel_range(u, width_px)
    v_low, v_high = _pixel_range(v, height_px)
    keep = facing & (u_high >= u_low) & (v_high >= v_low)
    if not keep.any():
        return
    index, column, row, size = _boxes(np.flatnonzero(keep), u_low, u_high, v_low, v_high)
    triangles = _Triangles(u[index], v[index], inverse_depth[index], colors[index], area[index], column, row)
    bucket = np.ceil(np.log2(size)).astype(int)
    for exponent in np.unique(bucket):
        members = np.flatnonzero(bucket == exponent)
        side = 1 << int(exponent)
        batch = max(1, _BATCH_PIXELS // side**2)
        for start in range(0, len(members), batch):
            _fill(canvas, triangles, members[start : start + batch], side)


def draw_lines(
    canvas: Canvas,
    starts_camera_m: Float[np.ndarray, "lines 3"],
    ends_camera_m: Float[np.ndarray, "lines 3"],
    rgb: tuple[int, int, int],
    intrinsics: Intrinsics,
) -> None:
    """Draw straight lines one pixel wide with depth test."""
    starts, ends = clip_segments_near(starts_camera_m, ends_camera_m)
    if len(starts) == 0:
        return
    height_px, width_px = canvas.depth_m.shape
    points = np.stack([starts, ends])
    inverse_depth = 1.0 / points[..., 2]
    u = intrinsics.fx_px * points[..., 0] * inverse_depth + intrinsics.cx_px
    v = intrinsics.fy_px * points[..., 1] * inverse_depth + intrinsics.cy_px
    steps = int(np.clip(max(np.ptp(u, axis=0).max(), np.ptp(v, axis=0).max()), 1, 4 * (width_px + height_px)))
    share = np.linspace(0.0, 1.0, steps + 1)[:, None]
    columns = np.rint(u[0] + share * (u[1] - u[0])).ravel()
    rows = np.rint(v[0] + share * (v[1] - v[0])).ravel()
    depth_m = (_LINE_BIAS / (inverse_depth[0] + share * (inverse_depth[1] - inverse_depth[0]))).ravel()
    inside = (columns >= 0) & (columns < width_px) & (rows >= 0) & (rows < height_px)
    pixel = rows[inside].astype(np.int64) * width_px + columns[inside].astype(np.int64)
    depth_flat = canvas.depth_m.reshape(-1)
    depth_inside = depth_m[inside].astype(np.float32)
    np.minimum.at(depth_flat, pixel, depth_inside)
    canvas.rgb.reshape(-1, 3)[pixel[depth_inside <= depth_flat[pixel]]] = rgb


@dataclass(frozen=True, slots=True, eq=False)
class _Triangles:
    u: np.ndarray
    v: np.ndarray
    inverse_depth: np.ndarray
    colors: np.ndarray
    area: np.ndarray
    u_low: np.ndarray
    v_low: np.ndarray


def _brightness(normals: np.ndarray) -> np.ndarray:
    """Brightness in [ambient, 1] of unit normals (N, 3), the same for both sides of a surface."""
    return _AMBIENT + (1.0 - _AMBIENT) * np.abs(normals.astype(np.float32) @ _LIGHT.astype(np.float32))


def _pixel_range(coordinate: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last pixel center within each triangle's extent, cut to the picture."""
    # Pairwise, because a reduction over an axis of three is slow in numpy.
    least = np.minimum(np.minimum(coordinate[:, 0], coordinate[:, 1]), coordinate[:, 2])
    most = np.maximum(np.maximum(coordinate[:, 0], coordinate[:, 1]), coordinate[:, 2])
    low = np.ceil(np.clip(least, 0, size)).astype(np.int64)
    high = np.floor(np.clip(most, -1, size - 1)).astype(np.int64)
    return low, high


def _boxes(
    index: np.ndarray, u_low: np.ndarray, u_high: np.ndarray, v_low: np.ndarray, v_high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixel boxes of at most a tile: triangle number, first column, first row, side."""
    size = np.maximum(u_high - u_low, v_high - v_low)[index] + 1
    small = size <= _TILE_PX
    parts = [np.stack([index, u_low[index], v_low[index], size])[:, small]]
    for triangle in index[~small].tolist():
        rows, columns = np.meshgrid(
            np.arange(int(v_low[triangle]), int(v_high[triangle]) + 1, _TILE_PX),
            np.arange(int(u_low[triangle]), int(u_high[triangle]) + 1, _TILE_PX),
        )
        full = np.ones(rows.size, np.int64)
        parts.append(np.stack([triangle * full, columns.ravel(), rows.ravel(), _TILE_PX * full]))
    triangle_index, column, row, side = np.concatenate(parts, axis=1)
    return triangle_index, column, row, side


def _fill(canvas: Canvas, triangles: _Triangles, members: np.ndarray, side: int) -> None:
    """Test a square of `side` pixels for each triangle and keep the nearest surface."""
    height_px, width_px = canvas.depth_m.shape
    offset_v, offset_u = np.divmod(np.arange(side * side), side)
    column = triangles.u_low[members, None] + offset_u
    row = triangles.v_low[members, None] + offset_v
    u, v = triangles.u[members], triangles.v[members]
    inverse_area = 1.0 / triangles.area[members, None]

    def weight(a: int, b: int) -> np.ndarray:
        along = (u[:, b] - u[:, a])[:, None] * (row - v[:, a, None])
        return (along - (v[:, b] - v[:, a])[:, None] * (column - u[:, a, None])) * inverse_area

    weights = [weight(1, 2), weight(2, 0), weight(0, 1)]
    hit = (column < width_px) & (row < height_px)
    for share in weights:
        hit &= share >= -_EDGE_SLACK
    which, where = np.nonzero(hit)
    barycentric = np.stack([w[which, where] for w in weights], -1) * triangles.inverse_depth[members[which]]
    total = barycentric.sum(1)
    depth_m = (1.0 / total).astype(np.float32)
    pixel = row[which, where] * width_px + column[which, where]
    depth_flat = canvas.depth_m.reshape(-1)
    np.minimum.at(depth_flat, pixel, depth_m)
    seen = depth_m <= depth_flat[pixel]
    shares = barycentric[seen] / total[seen, None]
    rgb = np.einsum("pc,pck->pk", shares, triangles.colors[members[which[seen]]])
    canvas.rgb.reshape(-1, 3)[pixel[seen]] = np.clip(rgb + 0.5, 0, 255).astype(np.uint8)
