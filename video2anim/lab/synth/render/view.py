"""Surfaces rendered from one camera pose: G-buffer at pixel centers, light components, anti-aliased edges."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.lab.synth.render import sampling
from video2anim.lab.synth.render.caster import Hits, RayCaster
from video2anim.lab.synth.render.denoise import Links, link, smooth_tiles
from video2anim.lab.synth.render.lens import pixel_directions
from video2anim.lab.synth.render.lighting import Response, response_of, visibility_of
from video2anim.lab.synth.render.surfaces import Points, Surfaces, points_at
from video2anim.lab.synth.render.vectors import dot
from video2anim.lab.synth.world import Light
from video2anim.types import Intrinsics

SUBPIXELS = np.array([[-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]])
"""Rotated grid of the four rays of an edge pixel."""
_SMALL_SHARE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Lamps:
    """All lights of a room, and the number of rays that sample them."""

    lights: tuple[Light, ...]
    ambient_rgb: tuple[float, float, float]
    rays: tuple[int, int]
    """Rays per pixel for each light, and for the hemisphere."""


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """A camera: intrinsics, pose and radial distortion."""

    intrinsics: Intrinsics
    T_world_camera: Float[np.ndarray, "4 4"]
    k1: float = 0.0
    k2: float = 0.0

    @property
    def origin_m(self) -> Float[np.ndarray, "3"]:
        return self.T_world_camera[:3, 3].astype(np.float32)

    @property
    def pixel_angle(self) -> float:
        return 1.0 / self.intrinsics.fx_px

    def directions(self, pixel: Int[np.ndarray, "pixels"], shift: np.ndarray | float = 0.0) -> np.ndarray:
        """(pixels, 3) world ray directions through pixels given by flat index, scaled so that distances are
        z-depths."""
        width = self.intrinsics.width_px
        at = np.stack([pixel % width, pixel // width], -1) + shift
        rays = pixel_directions(at, self.intrinsics, self.k1, self.k2)
        return (rays @ self.T_world_camera[:3, :3].T).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class GBuffer:
    """Geometry buffer of a rectangle of the picture: labels, normals and surface points at pixel centers."""

    rows: slice
    columns: slice
    depth_m: Float[np.ndarray, "height width"]
    """z-depth; infinite = no surface."""
    object_id: Int[np.ndarray, "height width"]
    normal: Float[np.ndarray, "height width 3"]
    """World frame."""
    position_m: Float[np.ndarray, "height width 3"]
    links: Links
    seen: Int[np.ndarray, "seen"]
    """Flat index, within the rectangle, of the pixels that show a surface."""
    points: Points
    """Surface points, one row for each pixel of `seen`."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.depth_m.shape[0], self.depth_m.shape[1]


def rectangle_pixels(rows: slice, columns: slice, width: int) -> Int[np.ndarray, "pixels"]:
    """Flat picture indices of a rectangle, row by row."""
    y, x = np.mgrid[rows.start : rows.stop, columns.start : columns.stop]
    return (y * width + x).reshape(-1)


def trace_gbuffer(
    eye: Eye, surfaces: Surfaces, caster: RayCaster, rows: slice, columns: slice, nearer_than: np.ndarray | None = None
) -> GBuffer:
    """Cast the rays of a rectangle; hits that are not nearer than the given depth (height, width) are dropped."""
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    pixel = rectangle_pixels(rows, columns, eye.intrinsics.width_px)
    directions = eye.directions(pixel)
    origins = np.broadcast_to(eye.origin_m, directions.shape)
    hits = caster.first_hits(origins, directions)
    hit = hits.face >= 0
    if nearer_than is not None:
        hit &= hits.distance < nearer_than.reshape(-1)
    seen = np.flatnonzero(hit)
    points = points_at(surfaces, select_hits(hits, seen), eye.origin_m, directions[seen], eye.pixel_angle)
    depth = np.where(hit, hits.distance, np.float32(np.inf)).reshape(shape)
    object_id = _spread(points.object_id, seen, shape)
    normal, position = _spread(points.normal, seen, shape), _spread(points.position_m, seen, shape)
    label = object_id * 65536 + _spread(points.material + 2, seen, shape)
    near = np.where(np.isfinite(depth), depth, 0)
    return GBuffer(rows, columns, depth, object_id, normal, position, link(label, normal, position, near), seen, points)


def _spread(values: np.ndarray, index: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Scatter rows into a rectangle, zero elsewhere."""
    out = np.zeros((shape[0] * shape[1], *values.shape[1:]), values.dtype)
    out[index] = values
    return out.reshape(*shape, *values.shape[1:])


def select_hits(hits: Hits, index: np.ndarray) -> Hits:
    """The hits of some of the rays."""
    return Hits(hits.face[index], hits.distance[index], hits.barycentric[index])


def gbuffer_visibility(gbuffer: GBuffer, lamps: Lamps, casters: Sequence[RayCaster], width: int) -> np.ndarray:
    """(height, width, lights + 1) denoised visibility of the lights at each pixel; the last channel is the ambient
    light."""
    pixel = rectangle_pixels(gbuffer.rows, gbuffer.columns, width)[gbuffer.seen]
    reach = visibility_of(gbuffer.points, sampling.tile_of(pixel, width), lamps.lights, casters, lamps.rays)
    return smooth_tiles(_spread(reach.stacked(), gbuffer.seen, gbuffer.shape), gbuffer.links)


def borrowed_visibility(
    points: Points, at: Int[np.ndarray, "points"], gbuffer: GBuffer, reach: np.ndarray
) -> tuple[Float[np.ndarray, "points channels"], Bool[np.ndarray, "points"]]:
    """Visibility at points inside edge pixels, as the mean of the neighboring pixels that show the same surface.

    Args:
        points: Surface points hit by subpixel rays.
        at: Flat index of their pixel within the G-buffer.
        gbuffer: The G-buffer of the rectangle.
        reach: Visibility of its pixels, (height, width, channels).

    Returns:
        Visibility of each point, and whether it has such a neighbor.
    """
    height, width = gbuffer.shape
    flat_reach, ids = reach.reshape(height * width, -1), gbuffer.object_id.reshape(-1)
    normals, positions = gbuffer.normal.reshape(-1, 3), gbuffer.position_m.reshape(-1, 3)
    total = np.zeros((len(points), reach.shape[-1]), np.float32)
    weight = np.zeros(len(points), np.float32)
    y, x = at // width, at % width
    tolerance = 3 * points.footprint_m + 0.002
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            other = np.clip(y + dy, 0, height - 1) * width + np.clip(x + dx, 0, width - 1)
            alike = (ids[other] == points.object_id) & (dot(normals[other], points.normal) > 0.85)
            step = np.abs(dot(positions[other] - points.position_m, points.normal))
            share = (alike & (step < tolerance)).astype(np.float32)
            total += share[:, None] * flat_reach[other]
            weight += share
    return total / np.maximum(weight, 1)[:, None], weight > 0


@dataclass(frozen=True, eq=False)
class Components:
    """Radiance of a whole picture, split by light source, so that shadows can be subtracted later."""

    lamp: Float[np.ndarray, "lights pixels 3"]
    ambient: Float[np.ndarray, "pixels 3"]
    glow: Float[np.ndarray, "pixels 3"]

    @classmethod
    def dark(cls, lights: int, count: int) -> Components:
        """Components of a black picture."""
        return cls(np.zeros((lights, count, 3), np.float32), *(np.zeros((count, 3), np.float32) for _ in range(2)))

    @functools.cached_property
    def matters(self) -> Bool[np.ndarray, "lights pixels"]:
        """Where a light contributes a visible share of a pixel's brightness, so that its shadows have to be sampled."""
        bright = _SMALL_SHARE * self.radiance().sum(-1)
        return np.stack([lamp.sum(-1) > bright for lamp in self.lamp]) if len(self.lamp) else np.zeros((0, 0), bool)

    def radiance(self) -> Float[np.ndarray, "pixels 3"]:
        return self.glow + self.ambient + self.lamp.sum(0)

    def pixel_means(self, rays: int) -> Components:
        """Mean over the rays of each pixel; ray r belongs to pixel r % pixels."""
        lights, count = self.lamp.shape[:2]
        return Components(
            self.lamp.reshape(lights, rays, count // rays, 3).mean(1),
            self.ambient.reshape(rays, -1, 3).mean(0),
            self.glow.reshape(rays, -1, 3).mean(0),
        )

    def shaded(self, pixel: Int[np.ndarray, "chosen"], reach: Float[np.ndarray, "chosen lights+1"]) -> np.ndarray:
        """(chosen, 3) radiance of some pixels with the visible share `reach` of each light."""
        out = self.glow[pixel] + self.ambient[pixel] * reach[:, -1:]
        for number, lamp in enumerate(self.lamp):
            out += lamp[pixel] * reach[:, number, None]
        return out


def room_components(
    eye: Eye, surfaces: Surfaces, caster: RayCaster, opaque: RayCaster, lamps: Lamps, gbuffer: GBuffer
) -> Components:
    """Light components of a picture of static objects; pixels at edges are the mean of four rays."""
    count = gbuffer.shape[0] * gbuffer.shape[1]
    reach = gbuffer_visibility(gbuffer, lamps, [opaque], eye.intrinsics.width_px)
    edge = np.flatnonzero(gbuffer.links.edges())
    points, ray = subpixel_points(eye, surfaces, caster, edge)
    every = response_of(gbuffer.points.joined(points), surfaces.materials, lamps.lights, lamps.ambient_rgb)
    response, fine = every.split(len(gbuffer.points))
    out = Components.dark(len(lamps.lights), count)
    _add_light(out, gbuffer.seen, response, reach.reshape(count, -1)[gbuffer.seen])
    if not len(edge):
        return out
    borrowed, found = borrowed_visibility(points, edge[ray % len(edge)], gbuffer, reach)
    lost = np.flatnonzero(~found)
    if len(lost):
        tile = sampling.tile_of(edge[ray[lost] % len(edge)], eye.intrinsics.width_px)
        borrowed[lost] = visibility_of(points.chosen(lost), tile, lamps.lights, [opaque], lamps.rays).stacked()
    rays = Components.dark(len(lamps.lights), len(SUBPIXELS) * len(edge))
    _add_light(rays, ray, fine, borrowed)
    mean = rays.pixel_means(len(SUBPIXELS))
    out.lamp[:, edge], out.ambient[edge], out.glow[edge] = mean.lamp, mean.ambient, mean.glow
    return out


def _add_light(out: Components, index: np.ndarray, response: Response, reach: np.ndarray) -> None:
    """Write the radiance of points into the components of their pixels."""
    for number in range(len(out.lamp)):
        out.lamp[number, index] = response.lamp[:, number] * reach[:, number, None]
    out.ambient[index] = response.ambient * reach[:, -1:]
    out.glow[index] = response.glow


def subpixel_points(
    eye: Eye, surfaces: Surfaces, caster: RayCaster, pixel: np.ndarray, depth_m: np.ndarray | None = None
) -> tuple[Points, Int[np.ndarray, "points"]]:
    """Surface points hit by the `SUBPIXELS` rays of pixels (nearer than `depth_m`, if given), and the rays' indices.

    Ray r belongs to pixel r % len(pixel).
    """
    count, every = len(pixel), len(SUBPIXELS)
    directions = eye.directions(np.tile(pixel, every), np.repeat(SUBPIXELS, count, axis=0))
    hits = caster.first_hits(np.broadcast_to(eye.origin_m, directions.shape), directions)
    hit = hits.face >= 0
    if depth_m is not None:
        hit &= hits.distance < np.tile(depth_m, every)
    ray = np.flatnonzero(hit)
    return points_at(surfaces, select_hits(hits, ray), eye.origin_m, directions[ray], eye.pixel_angle), ray
