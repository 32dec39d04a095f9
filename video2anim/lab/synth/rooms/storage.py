"""Shelves, cabinets, wardrobes and kitchen rows. Their backs are flat and stand at the rear (-Z)."""

from __future__ import annotations

import numpy as np

from video2anim.lab.synth.rooms.making import Maker
from video2anim.lab.synth.rooms.materials import BOOK_RGB, Palette, paper, pick, plain
from video2anim.lab.synth.rooms.primitives import (
    Mesh,
    bar,
    block,
    cylinder,
    lathe,
    merge,
    moved,
    plain_box,
    soft_box,
    taper,
)
from video2anim.lab.synth.world import Material, SceneObject

Size = tuple[float, float]


def make_shelf(
    rng: np.random.Generator,
    palette: Palette,
    size_m: Size | None,
    height_m: float | None,
    *,
    board_m: float | None = None,
    fill: float = 0.75,
) -> SceneObject:
    """Open shelf 0.6-1.2 x 0.26-0.38 m, 0.8-2.1 m high, with books and boxes.

    Args:
        rng: Random numbers.
        palette: Materials of the room.
        size_m: Width and depth; random if None.
        height_m: Total height; random if None.
        board_m: Height of the top of a board that stays empty, with 0.35 m of space above it; None = no such board.
        fill: Probability that another board is filled.
    """
    m = Maker(rng)
    w, d = size_m or (m.uniform(0.6, 1.2), m.uniform(0.26, 0.38))
    levels = _board_levels(m, height_m, board_m)
    tall = levels[-1]
    wood = pick(rng, (palette.wood, palette.wood2, palette.lacquer))
    thick = 0.022
    backed = m.chance(0.6)
    if m.chance(0.25):  # metal posts
        for sx in (-1, 1):
            for sz in (-1, 1):
                m.add(block(0.025, tall, 0.025, x=sx * (w / 2 - 0.0125), z=sz * (d / 2 - 0.0125)), palette.metal)
    else:
        for sx in (-1, 1):
            m.add(block(thick, tall, d, x=sx * (w / 2 - thick / 2)), wood)
    if backed:
        m.add(block(w - thick, tall - 0.02, 0.008, y=0.01, z=-d / 2 + 0.004, edge=0.001), wood)
    inner = w - 2 * thick - 0.006
    for k, top in enumerate(levels):
        m.add(block(inner + 0.004, thick, d - 0.012, y=top - thick), wood)
        clear = (levels[k + 1] - thick if k + 1 < len(levels) else top + 0.3) - top
        used = board_m is not None and abs(top - board_m) < 1e-6
        if used or k + 1 == len(levels):
            m.surface("top", top, (inner, d - 0.02))
        if not used and k + 1 < len(levels) and rng.random() < fill:
            _fill_board(m, top, inner, d - 0.03, clear - 0.02)
    return m.done("shelf", f"shelf, {len(levels)} boards")


def _board_levels(m: Maker, height_m: float | None, board_m: float | None) -> list[float]:
    tall = height_m or m.uniform(0.85, 2.1)
    if board_m is None:
        count = max(2, round(tall / m.uniform(0.3, 0.4)))
        return [float(v) for v in np.linspace(0.08, tall, count + 1)]
    below = [board_m]
    while below[0] > 0.42:
        below.insert(0, max(0.08, below[0] - m.uniform(0.3, 0.38)))
    if height_m is not None and height_m > board_m + 0.3:
        below.append(max(height_m, board_m + 0.4))
    return below


def _fill_board(m: Maker, level: float, width: float, depth: float, clear: float) -> None:
    """Fill a board with books, some of them lying, and sometimes a storage box; solids are merged by color."""
    x, end = -width / 2 + 0.004, width / 2 - 0.004
    rows: dict[int, list[Mesh]] = {}
    if m.chance(0.2) and clear > 0.16:
        wide = min(0.32, end - x)
        box = soft_box(wide, min(0.24, clear - 0.02), min(depth, 0.3) - 0.02, 0.01, x=x + wide / 2, y=level)
        m.add(box, pick(m.rng, (plain(m.rng, (0.62, 0.55, 0.45)), plain(m.rng, (0.45, 0.48, 0.5)))))
        x += wide + 0.02
    stop = end - (0.0 if m.chance(0.5) else m.uniform(0.05, 0.5) * (end - x))
    while x < stop - 0.03:
        thick = m.uniform(0.014, 0.042)
        tall = min(m.uniform(0.17, 0.29), clear - 0.005)
        deep = min(m.uniform(0.13, 0.21), depth - 0.01)
        color = int(m.rng.integers(len(BOOK_RGB)))
        z = depth / 2 - deep / 2 - m.uniform(0.005, 0.03)
        if m.chance(0.05) and stop - x > 0.25:  # a lying pile
            y = level
            for _ in range(int(m.rng.integers(2, 5))):
                flat = m.uniform(0.015, 0.035)
                if y + flat > level + clear - 0.005:
                    break
                rows.setdefault(int(m.rng.integers(len(BOOK_RGB))), []).append(
                    plain_box(m.uniform(0.19, 0.23), flat, deep, x=x + 0.12, y=y, z=z)
                )
                y += flat
            x += 0.25
            continue
        rows.setdefault(color, []).append(plain_box(thick, tall, deep, x=x + thick / 2, y=level, z=z))
        x += thick + 0.0008
    for color, meshes in sorted(rows.items()):
        m.add(merge(meshes), paper(m.rng, BOOK_RGB[color]))


def make_cabinet(
    rng: np.random.Generator,
    palette: Palette,
    size_m: Size | None,
    height_m: float | None,
    *,
    kind: str | None = None,
    plain_back: bool = False,
) -> SceneObject:
    """Sideboard 1.0-1.7 x 0.38-0.46 x 0.7-0.95 m, chest of drawers 0.7-1.0 x 0.42-0.5 x 0.75-1.15, wardrobe
    0.9-1.9 x 0.56-0.62 x 1.85-2.2, night table 0.38-0.5 x 0.34-0.42 x 0.42-0.6, media board 1.1-1.7 x 0.38-0.45 x
    0.38-0.52, kitchen row 1.2-2.4 x 0.6 x 0.86-0.92 (with a counter, sink or hob)."""
    m = Maker(rng)
    if kind is None:
        kind = pick(rng, ("sideboard", "sideboard", "chest", "wardrobe")) if height_m is None else _kind_for(height_m)
    ranges = {
        "sideboard": ((1.0, 1.7), (0.38, 0.46), (0.7, 0.95)),
        "chest": ((0.7, 1.0), (0.42, 0.5), (0.75, 1.15)),
        "wardrobe": ((0.9, 1.9), (0.56, 0.62), (1.85, 2.2)),
        "night": ((0.38, 0.5), (0.34, 0.42), (0.42, 0.6)),
        "media": ((1.1, 1.7), (0.38, 0.45), (0.38, 0.52)),
        "kitchen": ((1.2, 2.4), (0.6, 0.62), (0.86, 0.92)),
    }[kind]
    drawn = [m.uniform(*r) for r in ranges]
    w, d = size_m or (drawn[0], drawn[1])
    h = height_m or drawn[2]
    body = pick(rng, (palette.wood, palette.wood2, palette.lacquer))
    front = body if m.chance(0.6) else pick(rng, (palette.wood, palette.lacquer))
    if kind == "kitchen":
        return _kitchen(m, palette, w, d, h, body)
    legs = 0.0 if kind == "wardrobe" or plain_back else pick(rng, (0.0, 0.12, 0.15)) * (h > 0.4)
    plinth = 0.06 if legs == 0 else 0.0
    if plinth:
        m.add(block(w - 0.04, plinth, d - 0.05, z=-0.015), body)
    low = legs + plinth
    m.add(soft_box(w, h - low, d - 0.02, 0.003, y=low, z=-0.01, steps=1), body)
    m.surface("top", h, (w, d))
    if legs:
        for sx in (-1, 1):
            for sz in (-1, 1):
                m.add(
                    taper(
                        (0.025, 0.025),
                        (0.045, 0.045),
                        legs + 0.005,
                        x=sx * (w / 2 - 0.06),
                        z=sz * (d / 2 - 0.06),
                        lean=(sx * 0.02, sz * 0.02),
                    ),
                    body,
                )
    _fronts(m, palette, kind, front, w, h, low, d / 2)
    return m.done("cabinet", kind)


def _kind_for(height_m: float) -> str:
    for limit, kind in ((0.55, "media"), (0.62, "night"), (1.0, "sideboard"), (1.4, "chest")):
        if height_m < limit:
            return kind
    return "wardrobe"


def _fronts(m: Maker, p: Palette, kind: str, front: Material, w: float, h: float, low: float, z: float) -> None:
    """Doors and drawers with handles in front of the body."""
    knob = m.chance(0.5)
    columns = max(1, round(w / (0.5 if kind != "chest" else 0.95)))
    each = (w - 0.012) / columns
    tall = h - low - 0.03
    for column in range(columns):
        x = -w / 2 + 0.006 + (column + 0.5) * each
        drawers = {
            "chest": 4,
            "night": 2,
            "wardrobe": 0,
            "media": pick(m.rng, (1, 0)),
            "sideboard": pick(m.rng, (0, 3)),
        }[kind]
        rows = drawers or 1
        for row in range(rows):
            face = tall / rows
            y = low + 0.008 + row * face
            m.add(soft_box(each - 0.006, face - 0.006, 0.018, 0.003, x=x, y=y, z=z - 0.01, steps=1), front)
            if drawers:
                hx, hy, upright = x, y + face / 2, False
            else:
                side = 1 if column % 2 == 0 else -1
                hx, hy, upright = x + side * (each / 2 - 0.05), low + tall * (0.5 if kind == "wardrobe" else 0.75), True
            _handle(m, p, hx, hy, z, upright, knob, min(0.14, 0.5 * each))


def _handle(m: Maker, p: Palette, x: float, y: float, z: float, upright: bool, knob: bool, length: float) -> None:
    if knob:
        shape = lathe([(0.006, 0), (0.006, 0.012), (0.014, 0.018), (0.012, 0.026)], 12)
        m.add(moved(shape, x=x, y=y, z=z - 0.002, pitch=np.pi / 2), p.metal, True)
        return
    a, b = ((0, -length / 2), (0, length / 2)) if upright else ((-length / 2, 0), (length / 2, 0))
    m.add(bar((x + a[0], y + a[1], z + 0.02), (x + b[0], y + b[1], z + 0.02), 0.005, 8), p.metal, True)
    for end in (a, b):
        m.add(
            bar(
                (x + end[0] * 0.8, y + end[1] * 0.8, z - 0.004),
                (x + end[0] * 0.8, y + end[1] * 0.8, z + 0.02),
                0.004,
                8,
            ),
            p.metal,
        )


def _kitchen(m: Maker, p: Palette, w: float, d: float, h: float, body: Material) -> SceneObject:
    """Base units below a counter; a hob or a sink with a tap; sometimes wall units above."""
    counter = pick(m.rng, (p.wood, plain(m.rng, (0.25, 0.25, 0.26), 0.4), plain(m.rng, (0.75, 0.73, 0.70), 0.4)))
    front = pick(m.rng, (p.lacquer, body))
    m.surface("top", h, (w * 0.45, d - 0.06), x=-w * 0.25)
    m.add(block(w - 0.02, 0.09, d - 0.1, z=-0.04), plain(m.rng, (0.2, 0.2, 0.2)))
    m.add(soft_box(w - 0.004, h - 0.13, d - 0.04, 0.002, y=0.09, z=-0.02, steps=1), front)
    m.add(soft_box(w, 0.038, d + 0.01, 0.006, y=h - 0.038), counter)
    units = max(2, round(w / 0.6))
    each = w / units
    for k in range(units):
        x = -w / 2 + (k + 0.5) * each
        rows = 3 if m.chance(0.35) else 1
        for row in range(rows):
            tall = (h - 0.14) / rows
            y = 0.095 + row * tall
            m.add(soft_box(each - 0.006, tall - 0.006, 0.018, 0.003, x=x, y=y, z=d / 2 - 0.032, steps=1), front)
            _handle(m, p, x, y + tall - 0.06, d / 2 - 0.022, False, False, min(0.3, 0.6 * each))
    x = w * 0.25
    steel = Material("metal", (0.66, 0.67, 0.68), (0.5, 0.5, 0.5), 0.02, 0.6)
    if m.chance(0.5):
        m.add(soft_box(0.56, 0.006, 0.5, 0.002, x=x, y=h), plain(m.rng, (0.07, 0.07, 0.08), 0.7))
        for sx in (-1, 1):
            for sz in (-1, 1):
                m.add(
                    cylinder(0.08, 0.003, x=x + sx * 0.13, y=h + 0.006, z=sz * 0.12),
                    plain(m.rng, (0.2, 0.2, 0.21), 0.3),
                    True,
                )
    else:
        m.add(soft_box(0.5, 0.008, 0.44, 0.003, x=x, y=h), steel)
        m.add(soft_box(0.4, 0.01, 0.32, 0.004, x=x, y=h), plain(m.rng, (0.38, 0.39, 0.40), 0.5))
        m.add(bar((x, h, -d / 2 + 0.1), (x, h + 0.24, -d / 2 + 0.1), 0.013), steel, True)
        m.add(bar((x, h + 0.235, -d / 2 + 0.1), (x, h + 0.2, -d / 2 + 0.26), 0.011), steel, True)
    hung = m.chance(0.5)
    if hung:
        for k in range(units):
            x = -w / 2 + (k + 0.5) * each
            m.add(soft_box(each - 0.004, 0.68, 0.33, 0.003, x=x, y=1.42, z=-d / 2 + 0.165, steps=1), front)
            _handle(m, p, x + each * 0.32, 1.52, -d / 2 + 0.33, True, False, 0.12)
    return m.done("cabinet", f"kitchen row{', wall units' if hung else ''}")
