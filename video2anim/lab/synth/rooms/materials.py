"""Palettes: paints, woods, fabrics and floors that match, drawn from the ranges of real interiors (sRGB)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from video2anim.lab.synth.colors import COLORS, Rgb
from video2anim.lab.synth.world import Material

WALL_RGB: tuple[Rgb, ...] = COLORS["wall"]
ACCENT_WALL_RGB: tuple[Rgb, ...] = COLORS["accent_wall"]
WOODS: tuple[tuple[Rgb, Rgb], ...] = COLORS["wood"]
LACQUERS: tuple[Rgb, ...] = COLORS["lacquer"]
FABRIC_SETS: tuple[tuple[Rgb, Rgb, Rgb], ...] = COLORS["fabrics"]
LEATHERS: tuple[Rgb, ...] = COLORS["leather"]
METALS: tuple[Rgb, ...] = COLORS["metal"]
TOY_RGB: tuple[Rgb, ...] = COLORS["toy"]
BOOK_RGB: tuple[Rgb, ...] = COLORS["book"]
LEAF_RGB: tuple[Rgb, ...] = COLORS["leaf"]


@dataclass(frozen=True, slots=True)
class Palette:
    """The materials of the furniture and structure of a room."""

    wall: Material
    accent_wall: Material
    ceiling: Material
    floor: Material
    trim: Material
    """Skirting, window and door frames."""
    wood: Material
    wood2: Material
    lacquer: Material
    metal: Material
    fabric: Material
    fabric2: Material
    accent: Material
    leather: Material
    rug: Material


Choice = TypeVar("Choice")


def _number(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def pick(rng: np.random.Generator, choices: tuple[Choice, ...]) -> Choice:
    """A random choice."""
    return choices[int(rng.integers(len(choices)))]


def varied(rng: np.random.Generator, rgb: Rgb, amount: float = 0.02) -> Rgb:
    """The same color, a little lighter or darker and warmer or colder."""
    shift = rng.normal(0, amount) + rng.normal(0, amount / 3, 3)
    r, g, b = np.clip(np.asarray(rgb) + shift, 0.02, 0.97).round(4)
    return float(r), float(g), float(b)


def shaded(rgb: Rgb, factor: float) -> Rgb:
    """Darker or lighter by a factor."""
    r, g, b = (min(0.97, channel * factor) for channel in rgb)
    return r, g, b


def wood(rng: np.random.Generator, pair: tuple[Rgb, Rgb] | None = None, gloss: float | None = None) -> Material:
    """Wood with grain from a (light, dark) pair of colors."""
    light, dark = pick(rng, WOODS) if pair is None else pair
    gloss = float(rng.uniform(0.05, 0.25)) if gloss is None else gloss
    return Material(
        "wood", varied(rng, light), varied(rng, dark), float(rng.uniform(0.02, 0.05)), gloss, 0, 0.1, _number(rng)
    )


def plain(rng: np.random.Generator, rgb: Rgb, gloss: float = 0.1, amount: float = 0.015) -> Material:
    """A plain material with a slightly varied color: paint, plastic or lacquer."""
    return Material("plain", varied(rng, rgb, amount), shaded(rgb, 0.8), 0.1, gloss, 0.0, 0.0, _number(rng))


def metal(rng: np.random.Generator) -> Material:
    """Bare or painted metal."""
    rgb = pick(rng, METALS)
    return Material("metal", varied(rng, rgb), shaded(rgb, 0.8), 0.02, float(rng.uniform(0.4, 0.8)), 0, 0, _number(rng))


def fabric(rng: np.random.Generator, rgb: Rgb, rgb2: Rgb | None = None, patterned: float = 0.15) -> Material:
    """Woven cloth, sometimes striped or checked with a second color."""
    kind, scale = "fabric", float(rng.uniform(0.004, 0.012))
    if rng.random() < patterned:
        kind = pick(rng, ("stripes", "checks"))
        scale = float(rng.uniform(0.03, 0.12))
    second = shaded(rgb, 0.85) if rgb2 is None or kind == "fabric" else rgb2
    return Material(kind, varied(rng, rgb), second, scale, 0.0, 0.0, float(rng.uniform(0, 0.15)), _number(rng))


def leather(rng: np.random.Generator) -> Material:
    """Leather of a random color."""
    rgb = pick(rng, LEATHERS)
    return Material("leather", varied(rng, rgb), shaded(rgb, 0.75), 0.01, 0.3, 0.0, 0.1, _number(rng))


def paper(rng: np.random.Generator, rgb: Rgb) -> Material:
    """Paper or card of a color."""
    return Material("paper", varied(rng, rgb), shaded(rgb, 0.9), 0.02, 0.0, 0.0, 0.0, _number(rng))


def glowing(rgb: Rgb, emission: float) -> Material:
    """A light-emitting material: lampshade, window pane."""
    return Material("plain", rgb, rgb, 0.1, 0.0, emission)


def draw_palette(rng: np.random.Generator, style: str = "living") -> Palette:
    """Random materials of one room; the floor depends on the style."""
    main, second, accent = pick(rng, FABRIC_SETS)
    pair = pick(rng, WOODS)
    wall = Material(
        "plaster",
        varied(rng, pick(rng, WALL_RGB)),
        (0.8, 0.8, 0.8),
        0.03,
        0,
        0,
        float(rng.uniform(0, 0.3)),
        _number(rng),
    )
    return Palette(
        wall=wall,
        accent_wall=_accent_wall(rng, style),
        ceiling=Material(
            "plaster", varied(rng, (0.92, 0.92, 0.91), 0.01), (0.9, 0.9, 0.9), 0.03, 0, 0, 0, _number(rng)
        ),
        floor=_floor(rng, style, pair),
        trim=plain(rng, (0.91, 0.90, 0.88)) if rng.random() < 0.7 else wood(rng, pair),
        wood=wood(rng, pair),
        wood2=wood(rng, pair if rng.random() < 0.6 else None),
        lacquer=plain(rng, pick(rng, LACQUERS), 0.3),
        metal=metal(rng),
        fabric=fabric(rng, main, second, 0.1),
        fabric2=fabric(rng, second, main, 0.2),
        accent=fabric(rng, accent, second, 0.35),
        leather=leather(rng),
        rug=_rug(rng, main, second, accent),
    )


def _accent_wall(rng: np.random.Generator, style: str) -> Material:
    if style in ("studio", "living") and rng.random() < 0.25:
        rgb = pick(rng, ((0.58, 0.34, 0.26), (0.80, 0.78, 0.75), (0.47, 0.40, 0.36)))
        return Material("brick", varied(rng, rgb), (0.72, 0.70, 0.66), 0.075, 0, 0, 0.3, _number(rng))
    rgb = pick(rng, ACCENT_WALL_RGB)
    return Material("plaster", varied(rng, rgb), shaded(rgb, 0.9), 0.03, 0, 0, float(rng.uniform(0, 0.3)), _number(rng))


def _floor(rng: np.random.Generator, style: str, pair: tuple[Rgb, Rgb]) -> Material:
    kinds = {
        "living": ("planks", "planks", "parquet", "parquet", "carpet"),
        "bedroom": ("planks", "planks", "carpet", "parquet"),
        "dining": ("tiles", "tiles", "planks", "parquet"),
        "office": ("carpet", "planks", "tiles"),
        "studio": ("planks", "parquet", "tiles", "plain"),
    }[style]
    kind = pick(rng, kinds)
    stain, number = float(rng.uniform(0, 0.4)), _number(rng)
    if kind in ("planks", "parquet"):
        light, dark = pair if rng.random() < 0.3 else pick(rng, WOODS)
        scale = float(rng.uniform(0.09, 0.2)) if kind == "planks" else float(rng.uniform(0.06, 0.09))
        return Material(kind, varied(rng, light), dark, scale, float(rng.uniform(0.05, 0.3)), 0, stain, number)
    if kind == "tiles":
        rgb = pick(rng, ((0.78, 0.75, 0.70), (0.60, 0.59, 0.57), (0.86, 0.85, 0.82), (0.66, 0.50, 0.40)))
        return Material(
            kind, varied(rng, rgb), shaded(rgb, 0.75), pick(rng, (0.2, 0.3, 0.45, 0.6)), 0.25, 0, stain, number
        )
    rgb = pick(rng, ((0.56, 0.54, 0.51), (0.44, 0.45, 0.48), (0.68, 0.62, 0.54), (0.42, 0.36, 0.33)))
    return Material(
        kind, varied(rng, rgb), shaded(rgb, 0.85), 0.01, 0.0 if kind == "carpet" else 0.15, 0, stain, number
    )


def _rug(rng: np.random.Generator, main: Rgb, second: Rgb, accent: Rgb) -> Material:
    kind = pick(rng, ("carpet", "carpet", "stripes", "checks"))
    first, other = pick(rng, ((main, second), (second, accent), (accent, second), (second, main)))
    scale = 0.01 if kind == "carpet" else float(rng.uniform(0.12, 0.3))
    return Material(
        kind, varied(rng, first), shaded(other, 0.9), scale, 0.0, 0.0, float(rng.uniform(0, 0.2)), _number(rng)
    )
