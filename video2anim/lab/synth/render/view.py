"""A set of surfaces seen from one camera pose: labels at pixel centers, light components, anti-aliased edges."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.lab.synth.render import sampling
from video2anim.lab.synth.render.caster import Caster, Hits
from video2anim.lab.synth.render.denoise import Links, link, smooth_tiles
from video2anim.lab.synth.render.lens import pixel_directions
from video2anim.lab.synth.render.lighting import Response, reach_of, response_of
from video2anim.lab.synth.render.surfaces import Points, Surfaces, points_at
from video2anim.lab.synth.render.vectors import dot
from video2anim.lab.synth.world import Light
from video2anim.types import Intrinsics

SUBPIXELS = np.array([[-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]])
"""Rotated grid of the four rays of an edge pixel."""
_SMALL_SHARE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Lamps:
    """All light of a room and how finely it is sampled."""

    lights: tuple[Light, ...]
    ambient_rgb: tuple[float, float, float]
    rays: tuple[int, int]
    """Rays per pixel for each light, and for the hemisphere."""


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """A camera pose with its lens."""

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
        """(pixels, 3) world directions through pixels given by flat index; their length makes distances z-depths."""
        width = self.intrinsics.width_px
        at = np.stack([pixel % width, pixel // width], -1) + shift
        rays = pixel_directions(at, self.intrinsics, self.k1, self.k2)
        return (rays @ self.T_world_camera[:3, :3].T).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """Labels and points at the centers of some pixels of a rectangle."""

    rows: slice
    columns: slice
    depth_m: Float[np.ndarray, "height width"]
    """Infinite where nothing is seen."""
    object_id: Int[np.ndarray, "height width"]
    normal: Float[np.ndarray, "height width 3"]
    """World frame."""
    position_m: Float[np.ndarray, "height width 3"]
    links: Links
    seen: Int[np.ndarray, "seen"]
    """Flat index, within the rectangle, of the pixels that show something."""
    points: Points
    """One row for each of `seen`."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.depth_m.shape[0], self.depth_m.shape[1]


def rectangle_pixels(rows: slice, columns: slice, width: int) -> Int[np.ndarray, "pixels"]:
    """Flat picture indices of a rectangle, row by row."""
    y, x = np.mgrid[rows.start : rows.stop, columns.start : columns.stop]
    return (y * width + x).reshape(-1)


def sheet_of(
    eye: Eye, surfaces: Surfaces, caster: Caster, rows: slice, columns: slice, nearer_than: np.ndarray | None = None
) -> Sheet:
    """Cast the rays of a rectangle; hits that are not nearer than a given depth are dropped."""
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    pixel = rectangle_pixels(rows, columns, eye.intrinsics.width_px)
    directions = eye.directions(pixel)
    origins = np.broadcast_to(eye.origin_m, directions.shape)
    hits = caster.first_hits(origins, directions)
    hit = hits.face >= 0
    if nearer_than is not None:
        hit &= hits.distance < nearer_than.reshape(-1)
    seen = np.flatnonzero(hit)
    points = points_at(surfaces, taken(hits, seen), eye.origin_m, directions[seen], eye.pixel_angle)
    depth = np.where(hit, hits.distance, np.float32(np.inf)).reshape(shape)
    object_id = _spread(points.object_id, seen, shape)
    normal, position = _spread(points.normal, seen, shape), _spread(points.position_m, seen, shape)
    label = object_id * 65536 + _spread(points.material + 2, seen, shape)
    near = np.where(np.isfinite(depth), depth, 0)
    return Sheet(rows, columns, depth, object_id, normal, position, link(label, normal, position, near), seen, points)


def _spread(values: np.ndarray, index: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Scatter rows into a rectangle, zero elsewhere."""
    out = np.zeros((shape[0] * shape[1], *values.shape[1:]), values.dtype)
    out[index] = values
    return out.reshape(*shape, *values.shape[1:])


def taken(hits: Hits, index: np.ndarray) -> Hits:
    """Some rays of a bundle."""
    return Hits(hits.face[index], hits.distance[index], hits.barycentric[index])


def sheet_reach(sheet: Sheet, lamps: Lamps, casters: Sequence[Caster], width: int) -> np.ndarray:
    """(height, width, lights + 1) light that reaches each pixel of a sheet, without noise; last = ambient."""
    pixel = rectangle_pixels(sheet.rows, sheet.columns, width)[sheet.seen]
    reach = reach_of(sheet.points, sampling.tile_of(pixel, width), lamps.lights, casters, lamps.rays)
    return smooth_tiles(_spread(reach.stacked(), sheet.seen, sheet.shape), sheet.links)


def borrowed_reach(
    points: Points, at: Int[np.ndarray, "points"], sheet: Sheet, reach: np.ndarray
) -> tuple[Float[np.ndarray, "points channels"], Bool[np.ndarray, "points"]]:
    """Light at points inside edge pixels, from pixels around that show the same surface.

    `at` is the flat index of the pixel within the sheet. Also says which points found such a pixel.
    """
    height, width = sheet.shape
    flat_reach, ids = reach.reshape(height * width, -1), sheet.object_id.reshape(-1)
    normals, positions = sheet.normal.reshape(-1, 3), sheet.position_m.reshape(-1, 3)
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
    """Radiance of a whole picture, split by where the light comes from, so that later shadows can be taken off."""

    lamp: Float[np.ndarray, "lights pixels 3"]
    ambient: Float[np.ndarray, "pixels 3"]
    glow: Float[np.ndarray, "pixels 3"]

    @classmethod
    def dark(cls, lights: int, count: int) -> Components:
        """No light at all."""
        return cls(np.zeros((lights, count, 3), np.float32), *(np.zeros((count, 3), np.float32) for _ in range(2)))

    @functools.cached_property
    def matters(self) -> Bool[np.ndarray, "lights pixels"]:
        """Where a light makes a visible part of a pixel's brightness, so that its shadows are worth a look."""
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
        """(chosen, 3) radiance of some pixels where only part of the light still arrives."""
        out = self.glow[pixel] + self.ambient[pixel] * reach[:, -1:]
        for number, lamp in enumerate(self.lamp):
            out += lamp[pixel] * reach[:, number, None]
        return out


def room_components(
    eye: Eye, surfaces: Surfaces, caster: Caster, opaque: Caster, lamps: Lamps, sheet: Sheet
) -> Components:
    """Light components of a picture of still objects; pixels at edges are the mean of four rays."""
    count = sheet.shape[0] * sheet.shape[1]
    reach = sheet_reach(sheet, lamps, [opaque], eye.intrinsics.width_px)
    edge = np.flatnonzero(sheet.links.edges())
    points, ray = subpixel_points(eye, surfaces, caster, edge)
    every = response_of(sheet.points.joined(points), surfaces.materials, lamps.lights, lamps.ambient_rgb)
    response, fine = every.split(len(sheet.points))
    out = Components.dark(len(lamps.lights), count)
    _put(out, sheet.seen, response, reach.reshape(count, -1)[sheet.seen])
    if not len(edge):
        return out
    borrowed, found = borrowed_reach(points, edge[ray % len(edge)], sheet, reach)
    lost = np.flatnonzero(~found)
    if len(lost):
        tile = sampling.tile_of(edge[ray[lost] % len(edge)], eye.intrinsics.width_px)
        borrowed[lost] = reach_of(points.chosen(lost), tile, lamps.lights, [opaque], lamps.rays).stacked()
    rays = Components.dark(len(lamps.lights), len(SUBPIXELS) * len(edge))
    _put(rays, ray, fine, borrowed)
    mean = rays.pixel_means(len(SUBPIXELS))
    out.lamp[:, edge], out.ambient[edge], out.glow[edge] = mean.lamp, mean.ambient, mean.glow
    return out


def _put(out: Components, index: np.ndarray, response: Response, reach: np.ndarray) -> None:
    """Write points' light into the components of their pixels."""
    for number in range(len(out.lamp)):
        out.lamp[number, index] = response.lamp[:, number] * reach[:, number, None]
    out.ambient[index] = response.ambient * reach[:, -1:]
    out.glow[index] = response.glow


def subpixel_points(
    eye: Eye, surfaces: Surfaces, caster: Caster, pixel: np.ndarray, depth_m: np.ndarray | None = None
) -> tuple[Points, Int[np.ndarray, "points"]]:
    """What the `SUBPIXELS` rays of pixels hit (nearer than `depth_m`, if given), and which rays did.

    Ray r belongs to pixel r % len(pixel).
    """
    count, every = len(pixel), len(SUBPIXELS)
    directions = eye.directions(np.tile(pixel, every), np.repeat(SUBPIXELS, count, axis=0))
    hits = caster.first_hits(np.broadcast_to(eye.origin_m, directions.shape), directions)
    hit = hits.face >= 0
    if depth_m is not None:
        hit &= hits.distance < np.tile(depth_m, every)
    ray = np.flatnonzero(hit)
    return points_at(surfaces, taken(hits, ray), eye.origin_m, directions[ray], eye.pixel_angle), ray
