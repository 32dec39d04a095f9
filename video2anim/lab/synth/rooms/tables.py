"""Tables, desks, beds, steps and boxes. Their tops are flat and exactly at the given height."""

from __future__ import annotations

import numpy as np

from video2anim.lab.synth.rooms.making import Maker
from video2anim.lab.synth.rooms.materials import Palette, pick, plain, shaded
from video2anim.lab.synth.rooms.primitives import bar, block, cylinder, lathe, moved, pillow, soft_box, taper, tube
from video2anim.lab.synth.world import Material, SceneObject

Size = tuple[float, float]


def make_table(rng: np.random.Generator, palette: Palette, size_m: Size | None, height_m: float | None) -> SceneObject:
    """Dining table 1.1-1.9 x 0.75-0.95 x 0.71-0.77 m, round 0.85-1.2, or coffee table 0.8-1.2 x 0.5-0.7 x 0.34-0.48."""
    m = Maker(rng)
    if height_m is None:
        height_m = m.uniform(0.71, 0.77) if m.chance(0.6) else m.uniform(0.34, 0.48)
    low = height_m < 0.6
    given = size_m is not None
    if size_m is None:
        size_m = (m.uniform(0.8, 1.2), m.uniform(0.5, 0.7)) if low else (m.uniform(1.1, 1.9), m.uniform(0.75, 0.95))
    wood = pick(rng, (palette.wood, palette.wood2, palette.lacquer))
    if not given and m.chance(0.3):
        return _round_table(m, palette, wood, m.uniform(0.6, 0.9) if low else m.uniform(0.85, 1.2), height_m)
    w, d = size_m
    thick = m.uniform(0.018, 0.045)
    m.surface("top", height_m, (w, d))
    m.add(soft_box(w, thick, d, pick(rng, (0.003, 0.008, 0.012)), y=height_m - thick), wood)
    style = pick(rng, ("square", "square", "splayed", "frame", "panel"))
    legs_under(m, style, wood if style != "frame" else palette.metal, w, d, height_m - thick)
    if low and m.chance(0.4) and style == "square":
        m.add(block(w - 0.08, 0.018, d - 0.08, y=0.12), wood)
    return m.done("table", f"{'coffee' if low else 'dining'} table, {style} legs")


def _round_table(m: Maker, palette: Palette, wood: Material, across: float, height: float) -> SceneObject:
    thick = m.uniform(0.02, 0.035)
    inner = across * 0.7
    m.surface("top", height, (inner, inner))
    r = across / 2
    m.add(lathe([(r - 0.008, 0), (r, 0.008), (r, thick - 0.004), (r - 0.004, thick)], 48, y=height - thick), wood, True)
    if m.chance(0.5):
        foot = [
            (r * 0.55, 0),
            (r * 0.55, 0.012),
            (r * 0.2, 0.03),
            (0.04, 0.07),
            (0.035, height - 0.1),
            (0.09, height - thick),
        ]
        m.add(lathe(foot, 32), pick(m.rng, (palette.metal, wood)), True)
        return m.done("table", "round table, pedestal")
    for k in range(4):
        a = k * np.pi / 2 + np.pi / 4
        reach = r * 0.72
        line = [
            (reach * np.sin(a), 0, reach * np.cos(a)),
            (0.8 * reach * np.sin(a), height - thick, 0.8 * reach * np.cos(a)),
        ]
        m.add(tube(np.array(line), [0.015, 0.025], 12), wood, True)
    return m.done("table", "round table, four legs")


def legs_under(m: Maker, style: str, material: Material, w: float, d: float, top: float) -> None:
    """Legs of a rectangular table up to `top`."""
    inset = min(0.05, 0.1 * min(w, d))
    x, z = w / 2 - inset, d / 2 - inset
    if style in ("square", "splayed"):
        thick = m.uniform(0.035, 0.065)
        for sx in (-1, 1):
            for sz in (-1, 1):
                lean = (sx * 0.03, sz * 0.03) if style == "splayed" else (0.0, 0.0)
                foot = 0.6 * thick if style == "splayed" else thick
                m.add(
                    taper((foot, foot), (thick, thick), top, x=sx * (x - 0.01), z=sz * (z - 0.01), lean=lean), material
                )
        rail = min(0.08, 0.2 * top)
        for sz in (-1, 1):
            m.add(block(2 * x - 0.04, rail, 0.02, y=top - rail, z=sz * (z - 0.01)), material)
        for sx in (-1, 1):
            m.add(block(0.02, rail, 2 * z - 0.04, x=sx * (x - 0.01), y=top - rail), material)
    elif style == "frame":
        for sx in (-1, 1):
            for sz in (-1, 1):
                m.add(block(0.03, top, 0.03, x=sx * x, z=sz * z), material)
            m.add(block(0.03, 0.03, 2 * z, x=sx * x), material)
            m.add(block(0.03, 0.03, 2 * z, x=sx * x, y=top - 0.03), material)
        m.add(block(2 * x, 0.03, 0.03, y=top - 0.03, z=-z), material)
    else:
        for sx in (-1, 1):
            m.add(block(0.03, top, d - 2 * inset, x=sx * x), material)
        m.add(block(2 * x, min(0.3, 0.5 * top), 0.018, y=top - min(0.3, 0.5 * top) - 0.02, z=-0.3 * d), material)


def make_desk(rng: np.random.Generator, palette: Palette, size_m: Size | None, height_m: float | None) -> SceneObject:
    """Writing desk 1.0-1.7 x 0.55-0.8 x 0.70-0.76 m, to sit at on its +Z side, often with drawers."""
    m = Maker(rng)
    w, d = size_m or (m.uniform(1.0, 1.7), m.uniform(0.55, 0.8))
    h = height_m or m.uniform(0.70, 0.76)
    wood, body = pick(rng, (palette.wood, palette.wood2)), pick(rng, (palette.wood, palette.lacquer))
    thick = m.uniform(0.022, 0.035)
    m.surface("top", h, (w, d))
    m.add(soft_box(w, thick, d, 0.005, y=h - thick), wood)
    style = pick(rng, ("frame", "square", "panel"))
    legs_under(m, style, palette.metal if style == "frame" else body, w, d, h - thick)
    drawers = w > 0.95 and d > 0.45 and m.chance(0.6)
    if drawers:
        side = pick(rng, (-1, 1))
        width, tall = 0.4, h - thick - 0.06
        x = side * (w / 2 - width / 2 - 0.06)
        m.add(block(width, tall, d - 0.14, x=x, y=0.05), body)
        count = int(rng.integers(2, 4))
        for k in range(count):
            face = tall / count
            m.add(
                soft_box(width - 0.02, face - 0.012, 0.018, 0.004, x=x, y=0.05 + k * face + 0.006, z=d / 2 - 0.062),
                body,
            )
            y = 0.05 + (k + 0.5) * face
            m.add(bar((x - 0.06, y, d / 2 - 0.038), (x + 0.06, y, d / 2 - 0.038), 0.006, 8), palette.metal, True)
    return m.done("desk", f"desk, {style} legs{', drawers' if drawers else ''}")


def make_bed(
    rng: np.random.Generator, palette: Palette, size_m: Size | None, height_m: float | None, *, flat: bool = False
) -> SceneObject:
    """Bed 0.9-1.8 x 1.95-2.1 m, surface at 0.40-0.60 m, head towards -Z.

    With `flat` there is no bedding: only the headboard, beyond the end, is higher than the surface.
    """
    m = Maker(rng)
    w, length = size_m or (pick(rng, (0.9, 1.2, 1.4, 1.6, 1.8)), m.uniform(1.95, 2.1))
    h = height_m or m.uniform(0.40, 0.58)
    wood = pick(rng, (palette.wood, palette.wood2, palette.lacquer))
    boxed = m.chance(0.4)
    mattress = min(m.uniform(0.16, 0.24), 0.6 * h)
    m.surface("bed", h, (w, length))
    sheet = plain(rng, (0.88, 0.87, 0.85), 0.0)
    cover = pick(rng, (palette.fabric, palette.fabric2, palette.accent))
    m.add(soft_box(w, mattress, length, 0.05, y=h - mattress, steps=4), sheet if not flat else cover, True)
    base = h - mattress
    if boxed:
        cloth = pick(rng, (palette.fabric, palette.fabric2))
        m.add(soft_box(w, base - 0.04, length, 0.02, y=0.045), cloth)
    else:
        for sx in (-1, 1):
            m.add(block(0.035, 0.5 * base + 0.06, length + 0.05, x=sx * (w / 2 + 0.02), y=0.5 * base - 0.02), wood)
        m.add(block(w + 0.07, 0.5 * base + 0.06, 0.035, y=0.5 * base - 0.02, z=length / 2 + 0.03), wood)
        m.add(block(w, 0.03, length, y=base - 0.032), wood)
    for sx in (-1, 1):
        for sz in (-1, 1):
            m.add(
                taper((0.04, 0.04), (0.06, 0.06), 0.6 * base, x=sx * (w / 2 - 0.03), z=sz * (length / 2 - 0.03)), wood
            )
    _headboard(m, palette, wood, w, h, length)
    if not flat:
        _bedding(m, palette, cover, w, h, length)
    return m.done("bed", f"{'boxed' if boxed else 'framed'} bed, {w:.1f} m wide")


def _headboard(m: Maker, palette: Palette, wood: Material, w: float, h: float, length: float) -> None:
    z, tall = -length / 2 - 0.045, h + m.uniform(0.3, 0.6)
    kind = pick(m.rng, ("padded", "panel", "bars"))
    if kind == "padded":
        m.add(soft_box(w + 0.06, tall, 0.08, 0.03, z=z, steps=4), pick(m.rng, (palette.fabric, palette.leather)), True)
    elif kind == "panel":
        m.add(soft_box(w + 0.08, tall, 0.04, 0.01, z=z), wood)
    else:
        for x in np.linspace(-w / 2, w / 2, max(5, int(w / 0.14))):
            edge = abs(x) > w / 2 - 1e-6
            m.add(bar((x, 0 if edge else h * 0.5, z), (x, tall, z), 0.02 if edge else 0.01), palette.metal, True)
        for y in (h * 0.5, tall - 0.02):
            m.add(bar((-w / 2, y, z), (w / 2, y, z), 0.015), palette.metal, True)


def _bedding(m: Maker, palette: Palette, cover: Material, w: float, h: float, length: float) -> None:
    """Duvet and pillows."""
    reach = m.uniform(0.55, 0.72) * length
    rise = m.uniform(0.04, 0.08)
    duvet = soft_box(w + 0.06, rise + 0.16, reach, 0.05, y=h - 0.16, z=length / 2 + 0.03 - reach / 2, steps=4)
    m.add(duvet, cover, True)
    if m.chance(0.5):  # turned-down end
        edge = length / 2 + 0.03 - reach
        m.add(
            soft_box(w + 0.065, 0.05, 0.22, 0.02, y=h + rise - 0.01, z=edge + 0.12, steps=3),
            plain(m.rng, (0.88, 0.87, 0.85), 0.0),
            True,
        )
    count = 1 if w < 1.3 else 2
    for k in range(count):
        x = (k - (count - 1) / 2) * w / count
        tint = pick(m.rng, ((0.9, 0.89, 0.87), palette.fabric2.rgb, shaded(palette.fabric.rgb, 1.1)))
        mesh = pillow(min(0.68, w / count - 0.06), 0.16, 0.42)
        m.add(
            moved(mesh, x=x, y=h - 0.025, z=-length / 2 + 0.25, yaw=m.uniform(-0.08, 0.08)),
            plain(m.rng, tint, 0.0),
            True,
        )


def make_step(
    rng: np.random.Generator, palette: Palette, size_m: Size | None, height_m: float | None, count: int | None = None
) -> SceneObject:
    """Platform or stairs of 1-3 steps of 0.15-0.2 m (single: up to 0.45), rising towards -Z; top at `height_m`."""
    m = Maker(rng)
    count = int(rng.integers(1, 4)) if count is None else count
    w, d = size_m or (m.uniform(0.6, 1.1), m.uniform(0.28, 0.4) if count > 1 else m.uniform(0.35, 0.6))
    h = height_m or (m.uniform(0.15, 0.2) * count if count > 1 else m.uniform(0.15, 0.4))
    material = pick(rng, (palette.wood, palette.wood2, palette.lacquer, plain(rng, (0.6, 0.6, 0.58))))
    tread = pick(rng, (material, palette.wood))
    for k in range(count):
        top = h * (k + 1) / count
        z, deep = -k * d, d * (count - k)
        m.surface("tread", top, (w, d), z=z)
        m.add(soft_box(w, top - 0.02, deep, 0.004, z=z + d / 2 - deep / 2, steps=1), material)
        lip = 0.012 if k else 0.0
        m.add(soft_box(w + 0.01, 0.022, d + lip, 0.006, y=top - 0.022, z=z + lip / 2), tread)
    return m.done("step", f"{count} step{'s' if count > 1 else ''}")


def make_box(rng: np.random.Generator, palette: Palette, size_m: Size | None, height_m: float | None) -> SceneObject:
    """Cardboard box, crate or chest, 0.28-0.7 m."""
    m = Maker(rng)
    w, d = size_m or (m.uniform(0.3, 0.7), m.uniform(0.28, 0.5))
    h = height_m or m.uniform(0.22, 0.5)
    m.surface("top", h, (w, d))
    kind = pick(rng, ("cardboard", "crate", "chest"))
    if kind == "cardboard":
        card = Material("paper", (0.66, 0.52, 0.37), (0.56, 0.43, 0.30), 0.01, 0, 0, 0.3, int(rng.integers(2**31)))
        m.add(soft_box(w, h, d, 0.006, steps=3), card)
        tape = plain(rng, (0.74, 0.63, 0.46), 0.3)
        m.add(soft_box(0.05, 0.02, d + 0.002, 0.001, y=h - 0.02), tape)
        m.add(soft_box(0.05, 0.12, 0.002, 0.0005, y=h - 0.12, z=d / 2), tape)
        m.add(soft_box(0.16, 0.1, 0.002, 0.0005, x=0.2 * w, y=0.4 * h, z=d / 2), plain(rng, (0.9, 0.9, 0.88)))
    elif kind == "crate":
        boards = max(2, int(h / 0.09))
        m.add(block(w - 0.03, h - 0.012, d - 0.03), palette.wood2)
        for k in range(boards):
            y, tall = k * h / boards, h / boards - 0.012
            for sz in (-1, 1):
                m.add(block(w, tall, 0.015, y=y, z=sz * (d / 2 - 0.0075)), palette.wood)
            for sx in (-1, 1):
                m.add(block(0.015, tall, d - 0.03, x=sx * (w / 2 - 0.0075), y=y), palette.wood)
        m.add(block(w, 0.012, d, y=h - 0.012), palette.wood)
    else:
        wood = pick(rng, (palette.wood, palette.lacquer))
        m.add(soft_box(w - 0.01, h - 0.05, d - 0.01, 0.006), wood)
        m.add(soft_box(w, 0.05, d, 0.01, y=h - 0.05), wood)
        m.add(cylinder(0.02, 0.012, y=h - 0.1, z=0), palette.metal, True)
        for sx in (-1, 1):
            m.add(bar((sx * w * 0.5, h * 0.6, -0.05), (sx * w * 0.5, h * 0.6, 0.05), 0.01), palette.metal, True)
    return m.done("box", kind)
