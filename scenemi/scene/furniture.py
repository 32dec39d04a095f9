"""Furniture as boxes in its own frame: front at z = 0 toward +z, its depth behind (z < 0), floor at y = 0.

Sizes are those of usual furniture in meters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_LEG_HALF_M = 0.025
"""Half the thickness of a leg of furniture."""


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Boxes given by their lowest and highest corners."""

    kind: str
    low_m: Float[np.ndarray, "parts 3"]
    high_m: Float[np.ndarray, "parts 3"]


def piece(kind: str, *parts: tuple[float, float, float, float, float, float]) -> Piece:
    """A piece from parts (x0, x1, y0, y1, z0, z1)."""
    corners = np.array(parts, np.float64)
    return Piece(kind, corners[:, 0::2], corners[:, 1::2])


def table(rng: np.random.Generator) -> Piece:
    """A top on four legs or two side panels, free beneath."""
    width, depth, top = rng.uniform(0.8, 2.0), rng.uniform(0.5, 1.0), rng.uniform(0.68, 0.8)
    if rng.random() < 0.25:
        width, depth, top = rng.uniform(0.5, 1.2), rng.uniform(0.4, 0.7), rng.uniform(0.35, 0.5)
    return table_of("table", width, depth, top, rng)


def table_of(kind: str, width: float, depth: float, top: float, rng: np.random.Generator) -> Piece:
    """A table of given size."""
    board = (-width / 2, width / 2, top - rng.uniform(0.02, 0.06), top, -depth, 0.0)
    inset = rng.uniform(0.0, 0.1)
    if rng.random() < 0.5:
        x, thick = width / 2 - inset, 0.04
        panels = [(s * x - thick / 2, s * x + thick / 2, 0.0, board[2], -depth + 0.05, -0.05) for s in (-1, 1)]
        return piece(kind, board, *panels)
    return piece(kind, board, *_legs(width, depth, board[2], inset))


def _legs(width: float, depth: float, top: float, inset: float = 0.02) -> list[tuple]:
    x, z = inset + _LEG_HALF_M, 0.5 * depth
    x, z = 0.5 * width - x, z - x
    sides = [(sx * x, sz * z - 0.5 * depth) for sx in (-1, 1) for sz in (-1, 1)]
    half = _LEG_HALF_M
    return [(x - half, x + half, 0.0, top, z - half, z + half) for x, z in sides]


def chair(rng: np.random.Generator) -> Piece:
    """A dining chair."""
    return seat_of("chair", rng.uniform(0.42, 0.5), rng)


def seat_of(kind: str, top: float, rng: np.random.Generator) -> Piece:
    """A chair, stool, bench or sofa whose seat has this height."""
    form = rng.choice(["chair", "stool", "bench", "sofa", "block"])
    depth, width = rng.uniform(0.36, 0.5), rng.uniform(0.38, 0.5)
    if form == "sofa":
        depth, width = rng.uniform(0.5, 0.6), rng.uniform(0.8, 2.0)
        arm, back = top + rng.uniform(0.1, 0.25), top + rng.uniform(0.3, 0.45)
        sides = [(s * width / 2 - 0.1, s * width / 2 + 0.1, 0.0, arm, -depth, -0.05) for s in (-1, 1)]
        behind = (-width / 2, width / 2, 0.0, back, -depth - 0.2, -depth)
        return piece(kind, (-width / 2, width / 2, 0.0, top, -depth, 0.0), behind, *sides)
    if form == "bench":
        width = rng.uniform(0.9, 1.8)
    if form == "block":
        return piece(kind, (-width / 2, width / 2, 0.0, top, -depth, 0.0))
    board = (-width / 2, width / 2, max(top - 0.05, 0.5 * top), top, -depth, 0.0)
    parts = [board, *_legs(width, depth, board[2])]
    if form == "chair":
        parts.append((-width / 2, width / 2, top, top + rng.uniform(0.3, 0.5), -depth - 0.04, -depth))
    return piece(kind, *parts)


def cabinet(rng: np.random.Generator) -> Piece:
    """A closed block: chest, fridge, wardrobe, kitchen counter."""
    width, height, depth = rng.uniform(0.4, 2.0), rng.uniform(0.5, 2.1), rng.uniform(0.35, 0.65)
    return piece("cabinet", (-width / 2, width / 2, 0.0, height, -depth, 0.0))


def bed(rng: np.random.Generator) -> Piece:
    """A bed from its side or its foot."""
    long, wide, top = rng.uniform(1.9, 2.1), rng.uniform(0.9, 1.8), rng.uniform(0.35, 0.6)
    width, depth = (long, wide) if rng.random() < 0.5 else (wide, long)
    return piece("bed", (-width / 2, width / 2, 0.0, top, -depth, 0.0))


def shelf(rng: np.random.Generator) -> Piece:
    """Boards between two sides."""
    width, height, depth = rng.uniform(0.5, 1.4), rng.uniform(0.9, 2.1), rng.uniform(0.25, 0.4)
    sides = [(s * width / 2 - 0.015, s * width / 2 + 0.015, 0.0, height, -depth, 0.0) for s in (-1, 1)]
    heights = np.linspace(0.1, height, rng.integers(3, 6))
    return piece("shelf", *sides, *((-width / 2, width / 2, y - 0.03, y, -depth, 0.0) for y in heights))


def wall_board(rng: np.random.Generator) -> Piece:
    """A board or hanging cabinet on the wall, free beneath."""
    width, depth, low = rng.uniform(0.5, 1.6), rng.uniform(0.2, 0.4), rng.uniform(1.1, 1.8)
    return piece("wall_board", (-width / 2, width / 2, low, low + rng.uniform(0.03, 0.5), -depth, 0.0))


def carton(rng: np.random.Generator) -> Piece:
    """A low object on the floor."""
    width, height, depth = rng.uniform(0.2, 0.6), rng.uniform(0.1, 0.5), rng.uniform(0.2, 0.5)
    return piece("carton", (-width / 2, width / 2, 0.0, height, -depth, 0.0))


def post(rng: np.random.Generator) -> Piece:
    """A pillar or standing lamp."""
    half = rng.uniform(0.03, 0.2)
    return piece("post", (-half, half, 0.0, rng.uniform(1.4, 2.6), -2 * half, 0.0))


def wall(rng: np.random.Generator) -> Piece:
    """A wall, long enough to close a side of the grid or short as a partition."""
    width = 8.0 if rng.random() < 0.7 else rng.uniform(0.6, 3.0)
    return piece("wall", (-width / 2, width / 2, 0.0, rng.uniform(2.3, 2.8), -rng.uniform(0.08, 0.25), 0.0))


def doorway(rng: np.random.Generator) -> Piece:
    """A wall with an opening in its middle, with or without lintel."""
    half, height, thick = 0.5 * rng.uniform(0.7, 1.3), rng.uniform(2.3, 2.8), rng.uniform(0.08, 0.2)
    parts = [(-4.0, -half, 0.0, height, -thick, 0.0), (half, 4.0, 0.0, height, -thick, 0.0)]
    if rng.random() < 0.7:
        parts.append((-half, half, rng.uniform(1.95, 2.15), height, -thick, 0.0))
    return piece("doorway", *parts)


def block(kind: str, width: float, top: float, depth: float, *, low: float = 0.0) -> Piece:
    """One box."""
    return piece(kind, (-width / 2, width / 2, low, top, -depth, 0.0))


FURNITURE: tuple[tuple[Callable[[np.random.Generator], Piece], float], ...] = (
    (table, 0.22), (chair, 0.18), (cabinet, 0.18), (bed, 0.08), (shelf, 0.1), (wall_board, 0.06), (carton, 0.12),
    (post, 0.06),
)  # fmt: skip
"""Makers and how often each is drawn."""
