"""Plants, lamps and small objects."""

from __future__ import annotations

import numpy as np

from video2anim.lab.synth.rooms.making import Maker
from video2anim.lab.synth.rooms.materials import (
    BOOK_RGB,
    LEAF_RGB,
    TOY_RGB,
    Palette,
    fabric,
    glowing,
    leather,
    paper,
    pick,
    plain,
    shaded,
    varied,
)
from video2anim.lab.synth.rooms.primitives import (
    bar,
    block,
    cylinder,
    lathe,
    leaf,
    merge,
    moved,
    pillow,
    plain_box,
    ribbon,
    soft_box,
    tube,
)
from video2anim.lab.synth.world import Material, SceneObject

ITEM_LABELS = ("book", "cup", "toy", "bag", "box", "vase")
"""Labels of objects that people pick up."""


def make_plant(rng: np.random.Generator, height_m: float | None = None) -> SceneObject:
    """Pot plant 0.25-1.8 m high, with long leaves or with branches of broad leaves. Leaves are thin closed solids."""
    m = Maker(rng)
    tall = height_m or m.uniform(0.5, 1.7)
    pot_r = float(np.clip(0.14 * tall + m.uniform(0.02, 0.06), 0.05, 0.2))
    pot_h = float(np.clip(pot_r * m.uniform(1.3, 2.0), 0.07, 0.4 * tall + 0.03))
    pot = pick(
        rng, (plain(rng, (0.64, 0.36, 0.25)), plain(rng, (0.88, 0.87, 0.85), 0.3), plain(rng, (0.25, 0.26, 0.28)))
    )
    foot = pot_r * m.uniform(0.65, 0.95)
    m.add(lathe([(foot, 0), (pot_r, pot_h), (pot_r * 0.9, pot_h), (pot_r * 0.88, pot_h * 0.86)], 28), pot, True)
    m.add(cylinder(pot_r * 0.88, 0.012, y=pot_h * 0.86, sides=20), plain(rng, (0.2, 0.15, 0.11)))
    rgb = pick(rng, LEAF_RGB)
    green = Material("leaf", varied(rng, rgb), shaded(rgb, 0.65), 0.03, 0.15, 0, 0, int(rng.integers(2**31)))
    leaves = []
    if m.chance(0.45):
        count = int(rng.integers(14, 30))
        for k in range(count):
            turn = k * 2.4 + m.uniform(-0.3, 0.3)
            long = (tall - pot_h) * m.uniform(0.6, 1.0)
            rise = m.uniform(0.9, 1.45)
            mesh = leaf(long, m.uniform(0.03, 0.07) * (0.5 + 0.5 * tall), long * m.uniform(0.05, 0.35))
            leaves.append(moved(mesh, y=pot_h * 0.86, yaw=turn, pitch=-rise))
        kind = "tuft"
    else:
        stems = int(rng.integers(2, 6))
        for s in range(stems):
            lean, turn = m.uniform(0.02, 0.3), s * 2.1 + m.uniform(-0.4, 0.4)
            top = (tall - pot_h) * m.uniform(0.7, 1.0)
            share = np.linspace(0, 1, 7)[:, None]
            out = np.array([np.sin(turn), 0, np.cos(turn)])
            line = share * np.array([0, top, 0]) + share**1.6 * out * top * lean + [0, pot_h * 0.8, 0]
            m.add(
                tube(line, np.linspace(0.012, 0.005, 7) * (0.5 + 0.5 * tall), 7), plain(rng, (0.33, 0.27, 0.17)), True
            )
            for _ in range(int(rng.integers(9, 17))):
                place = float(rng.uniform(0.3, 1.0))
                base = np.array([np.interp(place, share[:, 0], line[:, a]) for a in range(3)])
                long = m.uniform(0.1, 0.2) * (0.5 + 0.5 * tall)
                mesh = leaf(long, long * m.uniform(0.4, 0.65), long * m.uniform(0.1, 0.5))
                leaves.append(
                    moved(mesh, x=base[0], y=base[1], z=base[2], yaw=m.uniform(0, 6.28), pitch=-m.uniform(-0.2, 0.9))
                )
        kind = "branches"
    m.add(merge(leaves), green, True)
    return m.done("plant", kind)


def make_lamp(rng: np.random.Generator, palette: Palette, height_m: float | None = None) -> SceneObject:
    """Floor lamp 1.3-1.75 m or table lamp 0.32-0.6 m with a glowing shade, open above and below."""
    m = Maker(rng)
    tall = height_m or (m.uniform(1.3, 1.75) if m.chance(0.6) else m.uniform(0.32, 0.6))
    floor = tall > 0.9
    shade_h = m.uniform(0.2, 0.3) if floor else tall * m.uniform(0.35, 0.45)
    low_r = m.uniform(0.15, 0.24) if floor else shade_h * m.uniform(0.6, 0.8)
    top_r = low_r * m.uniform(0.55, 1.0)
    stem = pick(rng, (palette.metal, palette.wood))
    base_r = m.uniform(0.12, 0.17) if floor else low_r * 0.6
    if floor and m.chance(0.3):
        for k in range(3):
            a = 2 * np.pi * k / 3
            m.add(
                bar(
                    (0.26 * np.sin(a), 0, 0.26 * np.cos(a)), (0.02 * np.sin(a), tall - shade_h, 0.02 * np.cos(a)), 0.012
                ),
                palette.wood,
                True,
            )
    elif not floor and m.chance(0.5):
        belly = [
            (0.6 * base_r, 0),
            (base_r, 0.3 * (tall - shade_h)),
            (0.25 * base_r, tall - shade_h),
            (0.2 * base_r, tall - shade_h + 0.02),
        ]
        m.add(lathe(belly, 24), pick(rng, (palette.lacquer, plain(rng, pick(rng, TOY_RGB), 0.4))), True)
    else:
        m.add(lathe([(base_r, 0), (base_r, 0.012), (0.015, 0.03)], 28), stem, True)
        m.add(cylinder(0.01, tall - shade_h * 0.6), stem, True)
    low = tall - shade_h
    ring = [(low_r, low), (top_r, tall), (top_r - 0.004, tall), (low_r - 0.004, low)]
    m.add(lathe(ring, 32, closed=True), glowing((0.97, 0.88, 0.72), m.uniform(0.6, 1.2)), True)
    m.add(bar((-top_r + 0.004, tall - 0.02, 0), (top_r - 0.004, tall - 0.02, 0), 0.003, 6), palette.metal)
    return m.done("lamp", "floor lamp" if floor else "table lamp")


def make_clutter(
    label: str, rng: np.random.Generator, palette: Palette, *, size_m: tuple[float, float] | None = None
) -> SceneObject:
    """A pile of books, cup, vase, toy, cushion, monitor or bag that fits the footprint `size_m` (width, depth)."""
    m = Maker(rng)
    note = {
        "book": _books,
        "cup": _cup,
        "vase": _vase,
        "toy": _toy,
        "cushion": _cushion,
        "monitor": _monitor,
        "bag": _bag,
    }[label](m, palette)
    obj = m.done(label, note)
    return obj if size_m is None else scaled_into(obj, size_m)


def scaled_into(obj: SceneObject, size_m: tuple[float, float]) -> SceneObject:
    """The object, shrunk if its footprint is larger than `size_m`."""
    points = np.concatenate([part.vertices_m for part in obj.parts])
    extent = np.ptp(points, axis=0)
    factor = min(1.0, size_m[0] / extent[0], size_m[1] / extent[2])
    if factor == 1.0:
        return obj
    m = Maker(np.random.default_rng(0))
    for part in obj.parts:
        m.add((part.vertices_m * factor, part.faces), part.material, part.smooth)
    return m.done(obj.label, obj.note)


def _books(m: Maker, palette: Palette) -> str:
    y, count = 0.0, int(m.rng.integers(1, 5))
    for _ in range(count):
        w, d, h = m.uniform(0.13, 0.24), m.uniform(0.18, 0.3), m.uniform(0.012, 0.04)
        yaw = m.uniform(-0.25, 0.25)
        rgb = pick(m.rng, BOOK_RGB)
        m.add(
            moved(block(w - 0.006, h - 0.004, d - 0.006, y=0.002), x=0.002, y=y, yaw=yaw),
            paper(m.rng, (0.88, 0.85, 0.78)),
        )
        cover = [plain_box(w, 0.002, d), plain_box(w, 0.002, d, y=h - 0.002), plain_box(0.002, h, d, x=-w / 2)]
        m.add(moved(merge(cover), y=y, yaw=yaw), paper(m.rng, rgb))
        y += h
    return f"{count} books"


def _cup(m: Maker, palette: Palette) -> str:
    r, h = m.uniform(0.033, 0.045), m.uniform(0.075, 0.11)
    rgb = pick(m.rng, (*TOY_RGB, (0.9, 0.9, 0.88), (0.3, 0.32, 0.34)))
    glaze = plain(m.rng, rgb, 0.5)
    wall = [(0.7 * r, 0), (r, 0.25 * h), (r, h), (r - 0.004, h), (r - 0.004, 0.25 * h), (0.5 * r, 0.08 * h)]
    m.add(lathe(wall, 24), glaze, True)
    a = np.linspace(-np.pi / 2, np.pi / 2, 9)
    line = np.stack([r - 0.003 + 0.022 * np.cos(a), h * 0.5 + 0.026 * np.sin(a), 0 * a], 1)
    m.add(tube(line, 0.005, 8), glaze, True)
    m.add(cylinder(r - 0.004, 0.004, y=0.75 * h), plain(m.rng, (0.25, 0.15, 0.09), 0.3))
    return "mug"


def _vase(m: Maker, palette: Palette) -> str:
    h, r = m.uniform(0.15, 0.32), m.uniform(0.04, 0.09)
    neck = r * m.uniform(0.3, 0.8)
    shape = [
        (0.6 * r, 0),
        (r, 0.35 * h),
        (0.8 * r, 0.65 * h),
        (neck, 0.88 * h),
        (neck * 1.2, h),
        (neck, h),
        (neck * 0.7, 0.85 * h),
    ]
    m.add(lathe(shape, 28), plain(m.rng, pick(m.rng, (*TOY_RGB, (0.85, 0.83, 0.78), (0.35, 0.42, 0.45))), 0.4), True)
    if m.chance(0.5):
        green = Material("leaf", pick(m.rng, LEAF_RGB), (0.2, 0.3, 0.15), 0.03)
        stems, heads = [], []
        for k in range(int(m.rng.integers(3, 8))):
            a, lean, up = k * 2.4, m.uniform(0.05, 0.4), m.uniform(0.12, 0.25)
            end = np.array([np.sin(a) * lean * up, h + up, np.cos(a) * lean * up])
            stems.append(bar((0, 0.6 * h, 0), end, 0.0025, 6))
            heads.append(
                lathe(
                    [(0.003, -0.015), (0.02, -0.004), (0.024, 0.006), (0.008, 0.016)], 10, x=end[0], y=end[1], z=end[2]
                )
            )
        m.add(merge(stems), green)
        m.add(merge(heads), plain(m.rng, pick(m.rng, TOY_RGB)), True)
    return "vase"


def _toy(m: Maker, palette: Palette) -> str:
    kind = pick(m.rng, ("ball", "blocks", "car", "bear"))
    first, second = plain(m.rng, pick(m.rng, TOY_RGB), 0.3), plain(m.rng, pick(m.rng, TOY_RGB), 0.3)
    if kind == "ball":
        r = m.uniform(0.06, 0.12)
        a = np.linspace(-np.pi / 2, np.pi / 2, 15)
        m.add(
            lathe([(r * np.cos(v), r + r * np.sin(v)) for v in a], 28),
            Material("stripes", first.rgb, second.rgb, r * 0.8, 0.2),
            True,
        )
    elif kind == "blocks":
        for k, (x, z) in enumerate(((0, 0), (0.055, 0.01), (0.02, 0.055), (0.02, 0.015))):
            m.add(
                moved(soft_box(0.045, 0.045, 0.045, 0.004), x=x, y=0.045 * (k == 3), z=z, yaw=m.uniform(-0.4, 0.4)),
                plain(m.rng, pick(m.rng, TOY_RGB), 0.3),
            )
    elif kind == "car":
        m.add(soft_box(0.1, 0.05, 0.2, 0.02, y=0.025), first, True)
        m.add(soft_box(0.085, 0.045, 0.1, 0.02, y=0.07, z=-0.015), second, True)
        wheel = lathe([(0.012, -0.01), (0.028, -0.008), (0.028, 0.008), (0.012, 0.01)], 16)
        wheels = [moved(wheel, x=sx * 0.047, y=0.028, z=sz * 0.065, roll=np.pi / 2) for sx in (-1, 1) for sz in (-1, 1)]
        m.add(merge(wheels), plain(m.rng, (0.1, 0.1, 0.1)), True)
    else:
        fur = fabric(m.rng, pick(m.rng, ((0.55, 0.38, 0.24), (0.75, 0.66, 0.52), (0.5, 0.48, 0.47))), patterned=0)
        a = np.linspace(-np.pi / 2, np.pi / 2, 9)
        ball = lambda r, tall: lathe([(r * np.cos(v), tall * (1 + np.sin(v))) for v in a], 16)  # noqa: E731
        m.add(ball(0.07, 0.08), fur, True)
        m.add(moved(ball(0.055, 0.052), y=0.135), fur, True)
        for sx in (-1, 1):
            m.add(moved(ball(0.02, 0.02), x=sx * 0.045, y=0.215), fur, True)
            m.add(moved(ball(0.027, 0.06), x=sx * 0.075, y=0.06, roll=-sx * 0.5), fur, True)
            m.add(moved(ball(0.032, 0.055), x=sx * 0.05, y=0.03, z=0.03, pitch=np.pi / 2), fur, True)
    return kind


def _cushion(m: Maker, palette: Palette) -> str:
    side = m.uniform(0.38, 0.5)
    material = pick(
        m.rng, (palette.accent, palette.fabric2, fabric(m.rng, pick(m.rng, TOY_RGB), (0.8, 0.78, 0.72), 0.5))
    )
    m.add(pillow(side, 0.13, side * m.uniform(0.75, 1.0)), material, True)
    return "cushion"


def _monitor(m: Maker, palette: Palette) -> str:
    """Desktop screen 0.5-0.65 m wide, facing +Z."""
    w = m.uniform(0.5, 0.65)
    h = 0.58 * w
    dark = plain(m.rng, (0.08, 0.08, 0.09), 0.3)
    m.add(soft_box(w, h, 0.03, 0.006, y=0.1), dark)
    shown = varied(m.rng, (0.35, 0.45, 0.6), 0.1)
    screen = Material("screen", shown, (0.85, 0.86, 0.88), 0.05, 0.4, 0.5, 0.0, int(m.rng.integers(2**31)))
    m.add(plain_box(w - 0.02, h - 0.02, 0.002, y=0.11, z=0.0155), screen)
    m.add(block(0.05, 0.2, 0.015, z=-0.02), dark)
    m.add(block(0.24, 0.012, 0.18, z=-0.02), dark)
    return "monitor"


def make_television(rng: np.random.Generator) -> SceneObject:
    """Television 0.9-1.3 m wide on feet, facing +Z."""
    m = Maker(rng)
    w = m.uniform(0.9, 1.3)
    h = 0.57 * w
    dark = plain(rng, (0.06, 0.06, 0.07), 0.4)
    m.add(soft_box(w, h, 0.035, 0.006, y=0.06), dark)
    on = m.chance(0.3)
    rgb = varied(rng, (0.3, 0.4, 0.5), 0.1) if on else (0.03, 0.03, 0.035)
    kind = "screen" if on else "plain"
    m.add(
        plain_box(w - 0.025, h - 0.025, 0.002, y=0.0725, z=0.018),
        Material(kind, rgb, (0.8, 0.8, 0.75), 0.1, 0.6, 0.4 if on else 0.0),
    )
    for sx in (-1, 1):
        m.add(block(0.03, 0.065, 0.2, x=sx * w * 0.36), dark)
    return m.done("monitor", "television")


def _bag(m: Maker, palette: Palette) -> str:
    w, d, h = m.uniform(0.28, 0.42), m.uniform(0.12, 0.2), m.uniform(0.26, 0.36)
    skin = pick(m.rng, (leather(m.rng), fabric(m.rng, pick(m.rng, TOY_RGB), patterned=0), palette.accent))
    m.add(soft_box(w, h, d, 0.045, steps=4), skin, True)
    m.add(soft_box(w * 0.8, h * 0.4, 0.03, 0.012, y=0.05, z=d / 2, steps=3), skin, True)
    a = np.linspace(0, np.pi, 11)
    for z in (-0.03, 0.03):
        line = np.stack([0.09 * np.cos(a), h - 0.02 + 0.09 * np.sin(a), 0 * a + z], 1)
        m.add(tube(line, 0.008, 8), skin, True)
    return "bag"


def curtain(m: Maker, x0: float, x1: float, top: float, bottom: float, z: float, material: Material) -> None:
    """Adds hanging cloth in folds between x0 and x1."""
    count = max(9, int((x1 - x0) / 0.025))
    x = np.linspace(x0, x1, count)
    wave = 0.028 * np.sin(np.linspace(0, count * 0.9, count) + m.uniform(0, 6.28))
    m.add(ribbon(np.stack([x, z + wave], 1), 0.006, top - bottom, bottom), material, True)
