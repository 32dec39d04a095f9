"""Procedural textures: the color of a material at points in the object's frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.export.frames import linear_light
from video2anim.lab.synth.render.noise import cell_values, detail_weight, fractal, noise
from video2anim.lab.synth.render.surfaces import BAKED_COLOR, Points
from video2anim.lab.synth.render.vectors import dot
from video2anim.lab.synth.world import PERSON_ID, Material


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """Texture coordinates, in meters, of points of one material: on walls v is up and u along; on floors both are
    level."""

    u: Float[np.ndarray, "points"]
    v: Float[np.ndarray, "points"]
    footprint: Float[np.ndarray, "points"]
    """Width of a pixel on the surface, meters."""
    level: Float[np.ndarray, "points"]
    """1 on surfaces that face up or down, 0 elsewhere."""


def albedo(points: Points, materials: tuple[Material, ...]) -> Float[np.ndarray, "points 3"]:
    """Linear diffuse color of surface points."""
    out = points.baked_rgb.copy()
    for number, index in groups(points.material):
        if number != BAKED_COLOR:
            out[index] = material_rgb(materials[number], spot_of(points, index))
    return out


def groups(numbers: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Pairs (number, rows with that number), in ascending order."""
    order = np.argsort(numbers, kind="stable")
    values, start = np.unique(numbers[order], return_index=True)
    return [(int(v), rows) for v, rows in zip(values, np.split(order, start[1:]), strict=True)]


def spot_of(points: Points, index: np.ndarray) -> Spot:
    """Texture coordinates of points, projected along the axis that the surface faces most (never the vertical for
    people, so that stripes run around shoulders)."""
    at, facing = points.texture_m[index], np.abs(points.texture_normal[index])
    slant = np.abs(dot(points.face_normal[index], points.view[index]))
    footprint = points.footprint_m[index] / np.sqrt(np.maximum(slant, 0.05))
    return unrolled(at, facing, footprint, points.object_id[index] < PERSON_ID)


def unrolled(
    at_m: np.ndarray, facing: np.ndarray, footprint_m: np.ndarray, may_be_level: np.ndarray | bool = True
) -> Spot:
    """Texture coordinates of points (n, 3), projected along the axis with the largest absolute normal (n, 3)."""
    level = (facing[:, 1] >= facing[:, 0]) & (facing[:, 1] >= facing[:, 2]) & may_be_level
    side = ~level & (facing[:, 0] > facing[:, 2])
    u = np.where(side, at_m[:, 2], at_m[:, 0])
    v = np.where(level, at_m[:, 2], at_m[:, 1])
    return Spot(u, v, footprint_m, level.astype(np.float32))


def material_rgb(material: Material, spot: Spot) -> Float[np.ndarray, "points 3"]:
    """Linear color of one material."""
    share, tint = KINDS[material.kind](material, spot)
    first, second = np.asarray(material.rgb, np.float32), np.asarray(material.rgb2, np.float32)
    color = first + share[:, None] * (second - first)
    if material.stain > 0:
        dirt = fractal(spot.u / 0.9, spot.v / 0.9, spot.footprint / 0.9, material.seed + 77, 5)
        tint = tint * (1 - 0.6 * material.stain * np.clip(dirt - 0.45, 0, 1))
    return linear_light(np.clip(color * tint[:, None], 0, 1)).astype(np.float32)


Pattern = tuple[np.ndarray, np.ndarray]
"""(points,) share of the second color, and (points,) factor on the brightness."""


def _mottle(material: Material, spot: Spot, size: float, strength: float, octaves: int = 4) -> np.ndarray:
    f = fractal(spot.u / size, spot.v / size, spot.footprint / size, material.seed, octaves)
    return 1 + strength * (f - 0.5)


def _none(spot: Spot) -> np.ndarray:
    return np.zeros(len(spot.u), np.float32)


def _plain(material: Material, spot: Spot) -> Pattern:
    return _none(spot), _mottle(material, spot, 0.35, 0.05, 3)


def _plaster(material: Material, spot: Spot) -> Pattern:
    coarse = _mottle(material, spot, 0.8, 0.05, 4)
    return _none(spot), coarse * _mottle(material, spot, 0.012, 0.05, 2)


def _grain(material: Material, along: np.ndarray, across: np.ndarray, spot: Spot, width: float) -> Pattern:
    """Wood grain: annual rings cut lengthwise, warped by stretched noise, with fine pores."""
    warp = fractal(along / (6 * width), across / (0.8 * width), spot.footprint / width, material.seed, 3)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (across / (0.45 * width) + 2.2 * warp))
    rings = 0.5 + (rings - 0.5) * detail_weight(spot.footprint, 0.4 * width)
    pores = noise(along / (0.5 * width), across / (0.03 * width), material.seed + 5) - 0.5
    share = 0.15 + 0.55 * rings * warp + 0.25 * pores * detail_weight(spot.footprint, 0.05 * width)
    return np.clip(share, 0, 1), 1 + 0.12 * (warp - 0.5)


def _wood(material: Material, spot: Spot) -> Pattern:
    """Wood; the grain runs upward on vertical faces and along x on level ones."""
    level = spot.level > 0
    along, across = np.where(level, spot.u, spot.v), np.where(level, spot.v, spot.u)
    return _grain(material, along, across, spot, max(material.scale_m, 0.03))


def _joint(offset: np.ndarray, width: float, spot: Spot) -> np.ndarray:
    """1 inside a joint (gap) of this width, from the distance to its center line; anti-aliased by pixel footprint."""
    wide = np.maximum(width, spot.footprint)
    line = np.clip(1.5 - np.abs(offset) / (0.5 * wide), 0, 1)
    return line * np.minimum(1, 1.2 * width / wide)


def _planks(material: Material, spot: Spot) -> Pattern:
    width = max(material.scale_m, 0.04)
    row = np.floor(spot.v / width)
    length = 9.0 * width
    shift = cell_values(row.astype(np.int64), material.seed) * length
    column = np.floor((spot.u + shift) / length)
    plank = (row * 7919 + column * 104729).astype(np.int64)
    one, two = cell_values(plank, material.seed + 1), cell_values(plank, material.seed + 2)
    share, tint = _grain(material, spot.u + 50 * one, spot.v + 50 * two, spot, 0.6 * width)
    gap = np.maximum(
        _joint(spot.v - np.round(spot.v / width) * width, 0.003, spot),
        _joint(spot.u + shift - np.round((spot.u + shift) / length) * length, 0.003, spot),
    )
    fade = detail_weight(spot.footprint, width)
    return np.clip(share + 0.5 * (one - 0.5) * fade, 0, 1), tint * (1 + 0.22 * (two - 0.5) * fade) * (1 - 0.6 * gap)


def _parquet(material: Material, spot: Spot) -> Pattern:
    """Basket weave: squares of five strips in alternating directions."""
    strip = max(material.scale_m, 0.02)
    square = 5 * strip
    i, j = np.floor(spot.u / square), np.floor(spot.v / square)
    turned = (i + j) % 2 > 0
    along, across = np.where(turned, spot.v, spot.u), np.where(turned, spot.u, spot.v)
    row = np.floor(across / strip)
    one = cell_values((row * 7919 + np.where(turned, j, i) * 15485863).astype(np.int64), material.seed)
    share, tint = _grain(material, along + 50 * one, across + 31 * one, spot, 0.8 * strip)
    gap = np.maximum(
        _joint(across - np.round(across / strip) * strip, 0.002, spot),
        _joint(along - np.round(along / square) * square, 0.002, spot),
    )
    fade = detail_weight(spot.footprint, strip)
    return np.clip(share + 0.6 * (one - 0.5) * fade, 0, 1), tint * (1 + 0.16 * (one - 0.5) * fade) * (1 - 0.55 * gap)


def _tiles(material: Material, spot: Spot) -> Pattern:
    edge = max(material.scale_m, 0.03)
    i, j = np.floor(spot.u / edge), np.floor(spot.v / edge)
    one = cell_values((i * 7919 + j * 104729).astype(np.int64), material.seed)
    grout = np.maximum(
        _joint(spot.u - np.round(spot.u / edge) * edge, 0.005, spot),
        _joint(spot.v - np.round(spot.v / edge) * edge, 0.005, spot),
    )
    marble = fractal(spot.u / 0.3 + 9 * one, spot.v / 0.3 + 5 * one, spot.footprint / 0.3, material.seed, 4)
    fade = detail_weight(spot.footprint, edge)
    return grout, 1 + 0.10 * (one - 0.5) * fade + 0.10 * (marble - 0.5)


def _carpet(material: Material, spot: Spot) -> Pattern:
    pile = _mottle(material, spot, 0.008, 0.35, 2) * _mottle(material, spot, 0.25, 0.10, 3)
    motif = fractal(spot.u / material.scale_m, spot.v / material.scale_m, spot.footprint / material.scale_m, 3, 2)
    return 0.5 * np.clip(4 * (motif - 0.55), 0, 1), pile


def _fabric(material: Material, spot: Spot) -> Pattern:
    weave = noise(spot.u / 0.0015, spot.v / 0.006, material.seed) + noise(spot.u / 0.006, spot.v / 0.0015, 3)
    weave = (weave - 1) * detail_weight(spot.footprint, 0.003)
    soft = fractal(spot.u / 0.15, spot.v / 0.15, spot.footprint / 0.15, material.seed, 4)
    return np.clip(0.25 * (soft - 0.35) + 0.2 * weave, 0, 1), 1 + 0.10 * (soft - 0.5) + 0.15 * weave


def _wave(position: np.ndarray, period: float, spot: Spot, duty: float = 0.5) -> np.ndarray:
    """Periodic bands: 1 inside, with edges as soft as a pixel; their mean where they are finer than pixels."""
    phase = np.abs(position / period - np.round(position / period)) * period
    soft = np.maximum(spot.footprint, 0.002)
    band = np.clip(0.5 + (0.5 * duty * period - phase) / soft, 0, 1)
    return duty + (band - duty) * detail_weight(spot.footprint, 0.5 * period)


def _stripes(material: Material, spot: Spot) -> Pattern:
    """Horizontal bands for even seeds, vertical ones for odd seeds."""
    across = spot.u if material.seed % 2 else spot.v
    duty = (0.5, 0.3, 0.18)[material.seed // 2 % 3]
    return _wave(across, material.scale_m, spot, duty), _fabric(material, spot)[1]


def _checks(material: Material, spot: Spot) -> Pattern:
    a, b = _wave(spot.u, material.scale_m, spot), _wave(spot.v, material.scale_m, spot)
    return 0.5 * (a + b), _fabric(material, spot)[1]


def _leather(material: Material, spot: Spot) -> Pattern:
    creases = np.abs(fractal(spot.u / 0.03, spot.v / 0.03, spot.footprint / 0.03, material.seed, 3) - 0.5)
    return 0.35 * np.clip(0.08 - creases, 0, 1) / 0.08, _mottle(material, spot, 0.2, 0.18)


def _metal(material: Material, spot: Spot) -> Pattern:
    brushed = noise(spot.u / 0.002, spot.v / 0.08, material.seed) - 0.5
    return _none(spot), 1 + 0.10 * brushed * detail_weight(spot.footprint, 0.002)


def _brick(material: Material, spot: Spot) -> Pattern:
    high = max(material.scale_m, 0.03)
    row = np.floor(spot.v / high)
    u = spot.u + np.where(row % 2 > 0, 1.5 * high, 0)
    column = np.floor(u / (3 * high))
    one = cell_values((row * 7919 + column * 104729).astype(np.int64), material.seed)
    mortar = np.maximum(
        _joint(spot.v - np.round(spot.v / high) * high, 0.012, spot),
        _joint(u - np.round(u / (3 * high)) * 3 * high, 0.012, spot),
    )
    return mortar, (1 + 0.4 * (one - 0.5) * detail_weight(spot.footprint, high)) * _mottle(material, spot, 0.05, 0.25)


def _leaf(material: Material, spot: Spot) -> Pattern:
    patch = fractal(spot.u / 0.06, spot.v / 0.06, spot.footprint / 0.06, material.seed, 3)
    return np.clip(2 * (patch - 0.4), 0, 1), 1 + 0.3 * (patch - 0.5)


def _picture(material: Material, spot: Spot) -> Pattern:
    """An abstract landscape: bands bent by noise, between the two colors, with dark strokes."""
    size = max(material.scale_m, 0.05)
    u, v, fine = spot.u / size, spot.v / size, spot.footprint / size
    warp = fractal(2 * u, 2 * v, 2 * fine, material.seed, 4)
    bands = 0.5 + 0.5 * np.sin(5 * v + 6 * warp + material.seed)
    stroke = np.clip(8 * (fractal(5 * u + 3, v * 3, 5 * fine, material.seed + 9, 3) - 0.62), 0, 1)
    return np.clip(1.6 * bands - 0.3, 0, 1), (0.75 + 0.5 * warp) * (1 - 0.55 * stroke)


def _screen(material: Material, spot: Spot) -> Pattern:
    """Windows and lines of text on a glowing panel."""
    block = cell_values((np.floor(spot.u / 0.12) * 31 + np.floor(spot.v / 0.09) * 17).astype(np.int64), material.seed)
    line = _wave(spot.v, 0.012, spot) * noise(spot.u / 0.02, np.floor(spot.v / 0.012) * 3.3, material.seed)
    return np.clip(0.7 * (block > 0.6) + 0.4 * line * (block < 0.4), 0, 1), 0.85 + 0.3 * block


def _paper(material: Material, spot: Spot) -> Pattern:
    words = (noise(spot.u / 0.012, np.floor(spot.v / 0.006) * 7.7, material.seed) > 0.45).astype(np.float32)
    return 0.5 * words * _wave(spot.v, 0.006, spot), _mottle(material, spot, 0.1, 0.05)


def _skin(material: Material, spot: Spot) -> Pattern:
    """Skin; the second color is flush in soft patches."""
    patch = fractal(spot.u / 0.07, spot.v / 0.07, spot.footprint / 0.07, material.seed, 3)
    return 0.5 * np.clip(patch - 0.4, 0, 1), _mottle(material, spot, 0.01, 0.06, 2)


def _hair(material: Material, spot: Spot) -> Pattern:
    strand = noise(spot.u / 0.004, spot.v / 0.06, material.seed) - 0.5
    lock = fractal(spot.u / 0.02, spot.v / 0.1, spot.footprint / 0.02, material.seed + 1, 2)
    return np.clip(lock - 0.35, 0, 1), 1 + 0.5 * (lock - 0.5) + 0.4 * strand * detail_weight(spot.footprint, 0.004)


KINDS: dict[str, Callable[[Material, Spot], Pattern]] = {
    "plain": _plain,
    "plaster": _plaster,
    "wood": _wood,
    "planks": _planks,
    "parquet": _parquet,
    "tiles": _tiles,
    "carpet": _carpet,
    "fabric": _fabric,
    "stripes": _stripes,
    "checks": _checks,
    "leather": _leather,
    "metal": _metal,
    "brick": _brick,
    "leaf": _leaf,
    "picture": _picture,
    "screen": _screen,
    "paper": _paper,
    "skin": _skin,
    "hair": _hair,
}
