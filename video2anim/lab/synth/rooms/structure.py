"""Structure of a room: floor, walls with windows and a door, ceiling, skirting, rugs, pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from video2anim.lab.synth.rooms.decor import curtain
from video2anim.lab.synth.rooms.making import Maker, pose
from video2anim.lab.synth.rooms.materials import Palette, glowing, metal, pick, plain, varied
from video2anim.lab.synth.rooms.placing import Bounds, wall_frame, wall_length
from video2anim.lab.synth.rooms.primitives import bar, lathe, plain_box, soft_box
from video2anim.lab.synth.world import Material, SceneObject

WALL_M = 0.16
RUG_M = 0.004
"""Thickness of rugs. Feet sink into them."""


@dataclass(frozen=True, slots=True)
class Opening:
    """A window or door in a wall: its range along the wall (x) and up (y), in the frame of `wall_frame`."""

    kind: str
    side: int
    x0: float
    x1: float
    y0: float
    y1: float
    curtains: bool = False


def draw_openings(
    rng: np.random.Generator,
    bounds_m: Bounds,
    height_m: float,
    style: str,
    avoid: tuple[tuple[int, float, float], ...] = (),
) -> tuple[Opening, ...]:
    """One door and one to three windows, none of them within the parts of walls (side, x0, x1) in `avoid`."""
    sides = [int(s) for s in rng.permutation(4)]
    found: list[Opening] = []
    width = float(rng.uniform(0.82, 0.95))
    for side in sides:
        room = wall_length(bounds_m, side) / 2 - width / 2 - 0.25
        for _ in range(6):
            x = float(rng.uniform(-room, room))
            if not any(s == side and a < x + width / 2 + 0.2 and b > x - width / 2 - 0.2 for s, a, b in avoid):
                found.append(Opening("door", side, x - width / 2, x + width / 2, 0.0, min(2.05, height_m - 0.2)))
                break
        if found:
            break
    for side in sides[1 : 2 + int(rng.random() < 0.45)]:
        length = wall_length(bounds_m, side)
        count = 2 if length > 5.0 and rng.random() < 0.6 else 1
        wide = float(rng.uniform(0.9, min(1.9, length / count - 1.0)))
        sill = 0.1 if style == "studio" and rng.random() < 0.3 else float(rng.uniform(0.8, 1.0))
        top = min(height_m - 0.2, sill + float(rng.uniform(1.1, 1.5)) if sill > 0.5 else 2.3)
        curtains = bool(rng.random() < 0.6)
        for k in range(count):
            x = (k - (count - 1) / 2) * length / count + float(rng.uniform(-0.2, 0.2))
            blocked = any(s == side and a < x + wide / 2 + 0.3 and b > x - wide / 2 - 0.3 for s, a, b in avoid)
            blocked |= any(o.side == side and o.x0 < x + wide / 2 + 0.4 and o.x1 > x - wide / 2 - 0.4 for o in found)
            if not blocked:
                found.append(Opening("window", side, x - wide / 2, x + wide / 2, sill, top, curtains))
    return tuple(found)


def make_shell(
    rng: np.random.Generator,
    palette: Palette,
    bounds_m: Bounds,
    height_m: float,
    openings: tuple[Opening, ...],
    bare: tuple[tuple[int, float, float], ...] = (),
) -> list[SceneObject]:
    """Floor, ceiling, four walls, skirting (but not on the parts of walls (side, x0, x1) in `bare`), doors, windows."""
    x0, x1, z0, z1 = bounds_m
    cx, cz = (x0 + x1) / 2, (z0 + z1) / 2
    wide, deep = x1 - x0 + 2 * WALL_M, z1 - z0 + 2 * WALL_M
    out = [
        _slab("floor", palette.floor, wide, deep, cx, cz, -0.1),
        _slab("ceiling", palette.ceiling, wide, deep, cx, cz, height_m),
    ]
    accent = int(rng.integers(4)) if rng.random() < 0.35 else -1
    tall = float(rng.uniform(0.06, 0.1))
    for side in range(4):
        own = tuple(o for o in openings if o.side == side)
        frame, length = wall_frame(bounds_m, side), wall_length(bounds_m, side)
        material = palette.accent_wall if side == accent else palette.wall
        out.append(_wall(rng, frame, length, height_m, own, material))
        gaps = [(o.x0 - 0.06, o.x1 + 0.06) for o in own if o.y0 < tall] + [(a, b) for s, a, b in bare if s == side]
        out.extend(_skirting(rng, frame, length, tall, gaps, palette))
        for opening in own:
            make = _door if opening.kind == "door" else _window
            out.append(make(rng, palette, frame, opening))
    return out


def _slab(label: str, material: Material, wide: float, deep: float, cx: float, cz: float, y: float) -> SceneObject:
    m = Maker(np.random.default_rng(0))
    m.add(plain_box(wide, 0.1, deep), material)
    return SceneObject(1, label, tuple(m.parts), pose(cx, cz, 0.0, y))


def _wall(
    rng: np.random.Generator,
    frame: np.ndarray,
    length: float,
    height: float,
    holes: tuple[Opening, ...],
    material: Material,
) -> SceneObject:
    """A wall as solid boxes around its holes. Walls on the Z sides include the corners."""
    m = Maker(rng)
    end = length / 2 + WALL_M - 0.002
    x = -end
    for hole in sorted(holes, key=lambda o: o.x0):
        _wall_box(m, x, hole.x0, 0.0, height, material)
        _wall_box(m, hole.x0, hole.x1, 0.0, hole.y0, material)
        _wall_box(m, hole.x0, hole.x1, hole.y1, height, material)
        x = hole.x1
    _wall_box(m, x, end, 0.0, height, material)
    return SceneObject(1, "wall", tuple(m.parts), frame)


def _wall_box(m: Maker, x0: float, x1: float, y0: float, y1: float, material: Material) -> None:
    if x1 - x0 > 1e-3 and y1 - y0 > 1e-3:
        m.add(plain_box(x1 - x0, y1 - y0, WALL_M, x=(x0 + x1) / 2, y=y0, z=-WALL_M / 2), material)


def _skirting(
    rng: np.random.Generator,
    frame: np.ndarray,
    length: float,
    tall: float,
    gaps: list[tuple[float, float]],
    palette: Palette,
) -> list[SceneObject]:
    m = Maker(rng)
    x = -length / 2
    for start, stop in sorted(gaps):
        if start > x:
            m.add(plain_box(start - x, tall, 0.012, x=(x + start) / 2, z=0.006), palette.trim)
        x = max(x, stop)
    if length / 2 > x:
        m.add(plain_box(length / 2 - x, tall, 0.012, x=(x + length / 2) / 2, z=0.006), palette.trim)
    return [SceneObject(1, "skirting", tuple(m.parts), frame)] if m.parts else []


def _door(rng: np.random.Generator, palette: Palette, frame: np.ndarray, o: Opening) -> SceneObject:
    """Door leaf with two panels, casing and handle, set back a little in the wall."""
    m = Maker(rng)
    w, h, cx = o.x1 - o.x0, o.y1, (o.x0 + o.x1) / 2
    leaf = pick(rng, (palette.trim, palette.wood, plain(rng, (0.88, 0.87, 0.85), 0.2)))
    m.add(plain_box(w, h - 0.005, 0.04, x=cx, y=0.005, z=-0.05), leaf)
    if m.chance(0.7):
        for y, tall in ((0.18, 0.75), (1.08, h - 1.08 - 0.18)):
            m.add(soft_box(w - 0.3, tall, 0.014, 0.005, x=cx, y=y, z=-0.028), leaf)
    for x in (o.x0 - 0.03, o.x1 + 0.03):
        m.add(soft_box(0.07, h + 0.065, 0.022, 0.006, x=x, z=0.0), palette.trim)
    m.add(soft_box(w + 0.13, 0.07, 0.022, 0.006, x=cx, y=h - 0.005), palette.trim)
    steel, side = metal(rng), pick(rng, (-1, 1))
    x = cx + side * (w / 2 - 0.07)
    m.add(bar((x, 1.02, -0.03), (x, 1.02, 0.025), 0.009), steel, True)
    m.add(bar((x, 1.02, 0.022), (x - side * 0.115, 1.02, 0.022), 0.009), steel, True)
    m.add(soft_box(0.035, 0.17, 0.008, 0.003, x=x, y=0.95, z=-0.027), steel)
    return SceneObject(1, "door", tuple(m.parts), frame)


def _window(rng: np.random.Generator, palette: Palette, frame: np.ndarray, o: Opening) -> SceneObject:
    """Window with a bright pane and a sill, and curtains on a rod if `o.curtains`."""
    m = Maker(rng)
    w, h, cx, z = o.x1 - o.x0, o.y1 - o.y0, (o.x0 + o.x1) / 2, -0.1
    sky = varied(rng, pick(rng, ((0.80, 0.88, 0.97), (0.93, 0.94, 0.95), (0.74, 0.84, 0.95))), 0.02)
    m.add(plain_box(w, h, 0.008, x=cx, y=o.y0, z=z - 0.02), glowing(sky, float(rng.uniform(1.1, 1.9))))
    bars = max(1, round(w / rng.uniform(0.5, 0.9)))
    for x in np.linspace(o.x0 + 0.03, o.x1 - 0.03, bars + 1):
        m.add(soft_box(0.06, h, 0.05, 0.006, x=float(x), y=o.y0, z=z), palette.trim)
    levels = [o.y0, o.y1 - 0.06] + ([o.y0 + 0.62 * h] if m.chance(0.4) else [])
    for y in levels:
        m.add(soft_box(w, 0.06, 0.05, 0.006, x=cx, y=y, z=z), palette.trim)
    if o.y0 > 0.3:
        m.add(soft_box(w + 0.06, 0.03, 0.14, 0.008, x=cx, y=o.y0 - 0.03, z=-0.04), palette.trim)
    if o.curtains:
        cloth = pick(rng, (palette.fabric2, palette.accent, palette.fabric, plain(rng, (0.88, 0.86, 0.82), 0.0)))
        top, bottom = o.y1 + 0.09, 0.03 if m.chance(0.7) or o.y0 < 0.3 else o.y0 - 0.12
        reach = m.uniform(0.18, 0.35)
        curtain(m, o.x0 - reach, o.x0 + m.uniform(0.05, 0.2), top, bottom, 0.075, cloth)
        curtain(m, o.x1 - m.uniform(0.05, 0.2), o.x1 + reach, top, bottom, 0.075, cloth)
        m.add(
            bar((o.x0 - reach - 0.05, top + 0.01, 0.075), (o.x1 + reach + 0.05, top + 0.01, 0.075), 0.011),
            palette.metal,
            True,
        )
    return SceneObject(1, "window", tuple(m.parts), frame)


def make_rug(
    rng: np.random.Generator, palette: Palette, size_m: tuple[float, float], x: float, z: float, yaw: float
) -> SceneObject:
    """Rug at (x, z) on the floor, sometimes round."""
    m = Maker(rng)
    if rng.random() < 0.2:
        r = min(size_m) / 2
        m.add(lathe([(r, 0.0), (r, 0.5 * RUG_M), (r - 0.004, RUG_M)], 48), palette.rug)
    else:
        m.add(soft_box(size_m[0], RUG_M, size_m[1], 0.0018, steps=1), palette.rug)
    return SceneObject(1, "rug", tuple(m.parts), pose(x, z, yaw), note="rug")


def make_picture(rng: np.random.Generator, palette: Palette, size_m: tuple[float, float]) -> SceneObject:
    """Framed picture; origin at the center of its lower edge, back on z = 0."""
    m = Maker(rng)
    w, h = size_m
    edge = float(rng.uniform(0.015, 0.04))
    frame = pick(rng, (palette.wood, palette.metal, palette.lacquer, plain(rng, (0.1, 0.1, 0.1))))
    for sx in (-1, 1):
        m.add(soft_box(edge, h, 0.025, 0.004, x=sx * (w - edge) / 2, z=0.0135), frame)
    for y in (0.0, h - edge):
        m.add(soft_box(w - edge, edge, 0.025, 0.004, y=y, z=0.0135), frame)
    first = varied(rng, pick(rng, (palette.fabric.rgb, palette.accent.rgb, (0.6, 0.55, 0.45), (0.4, 0.5, 0.6))), 0.1)
    second = varied(rng, pick(rng, (palette.fabric2.rgb, palette.accent.rgb, (0.85, 0.8, 0.7))), 0.1)
    art = Material("picture", first, second, float(rng.uniform(0.1, 0.4)), 0.1, 0.0, 0.0, int(rng.integers(2**31)))
    m.add(plain_box(w - edge, h - edge, 0.012, y=edge / 2, z=0.008), art)
    return SceneObject(1, "picture", tuple(m.parts), np.eye(4), note="picture")
