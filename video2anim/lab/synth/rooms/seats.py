"""Chairs, stools, armchairs and sofas. The top of the seat is flat and exactly at the given height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from video2anim.lab.synth.rooms.making import Maker
from video2anim.lab.synth.rooms.materials import Palette, pick
from video2anim.lab.synth.rooms.primitives import (
    Mesh,
    bar,
    block,
    cylinder,
    lathe,
    moved,
    ribbon,
    soft_box,
    taper,
    tube,
)
from video2anim.lab.synth.world import Material, SceneObject


@dataclass(frozen=True, slots=True)
class Back:
    """A backrest whose front starts at the rear edge of the seat."""

    tilt_rad: float
    height_m: float
    """Height of the top above the seat."""


@dataclass(frozen=True, slots=True)
class Seat:
    """Sizes of a seat: the flat rectangle to sit on, backrest and armrests."""

    width_m: float
    depth_m: float
    height_m: float
    back: Back | None = None
    arms: bool = False


def draw_seat(label: str, rng: np.random.Generator, size_m: tuple[float, float] | None = None) -> Seat:
    """Random usual sizes (meters). `size_m`: width and depth, if they are given.

    chair: seat 0.40-0.50 wide, 0.40-0.46 deep, 0.43-0.48 high; stool 0.30-0.42, 0.42-0.50 or 0.62-0.75 (bar) high;
    armchair 0.52-0.62, 0.50-0.58, 0.38-0.45; sofa 1.25-2.0, 0.52-0.62, 0.38-0.46.
    """
    u = rng.uniform
    if label == "stool":
        width, depth, height = u(0.30, 0.42), u(0.30, 0.40), u(0.42, 0.50) if rng.random() < 0.75 else u(0.62, 0.75)
        back, arms = None, False
    elif label == "chair":
        width, depth, height = u(0.40, 0.50), u(0.40, 0.46), u(0.43, 0.48)
        back, arms = Back(float(u(0.05, 0.2)), float(u(0.36, 0.56))), rng.random() < 0.2
    elif label == "armchair":
        width, depth, height = u(0.52, 0.62), u(0.50, 0.58), u(0.38, 0.45)
        back, arms = Back(float(u(0.12, 0.28)), float(u(0.36, 0.6))), True
    else:
        width, depth, height = u(1.25, 2.0), u(0.52, 0.62), u(0.38, 0.46)
        back, arms = Back(float(u(0.1, 0.25)), float(u(0.34, 0.5))), rng.random() < 0.85
    if size_m is not None:
        width, depth = size_m
    return Seat(float(width), float(depth), float(height), back, bool(arms))


def make_seat(label: str, seat: Seat, rng: np.random.Generator, palette: Palette) -> SceneObject:
    """A seat of given sizes in a random design."""
    m = Maker(rng)
    m.surface("seat", seat.height_m, (seat.width_m, seat.depth_m))
    if label == "stool":
        note = _stool(m, palette, seat)
    elif label == "chair":
        note = _chair(m, palette, seat)
    else:
        note = _upholstered(m, palette, seat, label)
    return m.done(label, note)


def _leaned(mesh: Mesh, seat: Seat) -> Mesh:
    """A solid moved from the frame of the back (origin at the center of its lower front edge) to that of the seat."""
    assert seat.back is not None
    return moved(mesh, y=seat.height_m, z=-seat.depth_m / 2, pitch=-seat.back.tilt_rad)


def _legs(m: Maker, frame: Material, seat: Seat, top_m: float, style: str) -> None:
    """Four legs, a pedestal or two runners up to `top_m`."""
    w, d = seat.width_m - 0.05, seat.depth_m - 0.05
    corners = [(sx * w / 2, sz * d / 2, sx, sz) for sx in (-1, 1) for sz in (-1, 1)]
    if style == "square":
        for x, z, _, sz in corners:
            m.add(
                taper(
                    (0.028, 0.028),
                    (0.04, 0.04),
                    top_m,
                    x=x,
                    z=z,
                    lean=(0, 0.03 if sz < 0 else 0.0) if sz > 0 else (0, -0.03),
                ),
                frame,
            )
        rail = 0.05
        for sz in (-1, 1):
            m.add(block(w, rail, 0.02, y=top_m - rail, z=sz * d / 2), frame)
        for sx in (-1, 1):
            m.add(block(0.02, rail, d, x=sx * w / 2, y=top_m - rail), frame)
    elif style == "round":
        for x, z, sx, sz in corners:
            foot = (x + sx * 0.035, 0.0, z + sz * 0.035)
            m.add(tube(np.array([foot, (x * 0.85, top_m, z * 0.85)]), [0.012, 0.019], 12), frame, True)
        if m.chance(0.5):
            for sx in (-1, 1):
                m.add(bar((sx * w * 0.48, 0.16, d / 2), (sx * w * 0.48, 0.16, -d / 2), 0.009), frame, True)
    elif style == "tube":
        for sx in (-1, 1):
            x = sx * w / 2
            line = [(x, top_m - 0.012, d / 2), (x, 0.05, d / 2 + 0.01), (x, 0.0112, d / 2 - 0.03)]
            line += [(x, 0.0112, -d / 2 + 0.03), (x, 0.05, -d / 2 - 0.01), (x, top_m - 0.012, -d / 2)]
            m.add(tube(np.array(line), 0.012), frame, True)
    else:
        star = 5
        for k in range(star):
            a = 2 * np.pi * k / star + 0.3
            reach = 0.5 * min(seat.width_m, 0.56) + 0.04
            end = (reach * np.sin(a), 0.06, reach * np.cos(a))
            m.add(tube(np.array([(0, 0.1, 0), end]), [0.022, 0.015], 8), frame, True)
            m.add(
                moved(
                    lathe([(0.012, -0.012), (0.0312, -0.009), (0.0312, 0.009), (0.012, 0.012)], 14),
                    x=end[0],
                    y=0.03,
                    z=end[2],
                    roll=np.pi / 2,
                    yaw=a,
                ),
                frame,
            )
        m.add(cylinder(0.028, top_m - 0.08, y=0.08), frame, True)
        m.add(cylinder(0.09, 0.03, y=top_m - 0.03, top=0.11), frame, True)


def _stool(m: Maker, p: Palette, seat: Seat) -> str:
    wood, h = pick(m.rng, (p.wood, p.wood2, p.lacquer)), seat.height_m
    round_seat = m.chance(0.5)
    thick = m.uniform(0.03, 0.09)
    cover = pick(m.rng, (wood, p.fabric, p.accent, p.leather)) if thick > 0.05 else wood
    if h < 0.55 and m.chance(0.3):  # pouffe: an upholstered block
        cover = pick(m.rng, (p.fabric, p.fabric2, p.accent, p.leather))
        m.add(soft_box(seat.width_m + 0.06, h - 0.03, seat.depth_m + 0.06, 0.03, y=0.03, steps=3), cover, True)
        m.add(block(seat.width_m - 0.04, 0.04, seat.depth_m - 0.04), wood)
        return "pouffe"
    if round_seat:
        across = (
            float(np.hypot(seat.width_m, seat.depth_m))
            if min(seat.width_m, seat.depth_m) < 0.3
            else max(seat.width_m, seat.depth_m) * 1.1
        )
        edge = 0.4 * thick
        profile = [(across / 2 - edge, 0), (across / 2, edge), (across / 2, thick - edge), (across / 2 - edge, thick)]
        m.add(lathe(profile, 32, y=h - thick), cover, True)
    else:
        m.add(soft_box(seat.width_m + 0.02, thick, seat.depth_m + 0.02, 0.3 * thick, y=h - thick), cover)
    style = pick(m.rng, ("round", "tube", "square", "pedestal") if not round_seat else ("round", "pedestal"))
    frame = p.metal if style in ("tube", "pedestal") else wood
    _legs(m, frame, Seat(seat.width_m * 0.9, seat.depth_m * 0.9, h), h - thick, style)
    if h > 0.6:
        for sx in (-1, 1):
            m.add(bar((sx * 0.14, 0.22, -0.14), (sx * 0.14, 0.22, 0.14), 0.009), frame, True)
    return f"stool, {style} legs"


def _chair(m: Maker, p: Palette, seat: Seat) -> str:
    wood = pick(m.rng, (p.wood, p.wood2, p.wood, p.lacquer))
    style = pick(m.rng, ("square", "square", "round", "tube", "pedestal"))
    frame = p.metal if style in ("tube", "pedestal") else wood
    padded = style == "pedestal" or m.chance(0.45)
    thick = m.uniform(0.05, 0.08) if padded else m.uniform(0.018, 0.03)
    cover = pick(m.rng, (p.fabric, p.fabric2, p.accent, p.leather)) if padded else wood
    m.add(
        soft_box(seat.width_m + 0.02, thick, seat.depth_m + 0.02, 0.35 * thick, y=seat.height_m - thick, steps=3),
        cover,
        padded,
    )
    _legs(m, frame, seat, seat.height_m - thick, style)
    kind = "backless"
    if seat.back is not None:
        kind = pick(
            m.rng, ("slats", "ladder", "panel", "curved") if not padded else ("padded", "padded", "curved", "slats")
        )
        _chair_back(m, seat, kind, frame if style != "pedestal" else wood, cover)
    if seat.arms:
        _chair_arms(m, seat, frame)
    return f"chair, {style} legs, {kind} back"


def _chair_back(m: Maker, seat: Seat, kind: str, frame: Material, cover: Material) -> None:
    assert seat.back is not None
    h, w = seat.back.height_m, seat.width_m
    add = lambda mesh, material, smooth=False: m.add(_leaned(mesh, seat), material, smooth)  # noqa: E731
    posts = [block(0.032, h + 0.05, 0.028, x=sx * (w / 2 - 0.016), y=-0.05, z=-0.02) for sx in (-1, 1)]
    if kind in ("slats", "ladder"):
        for post in posts:
            add(post, frame)
        add(soft_box(w, 0.07, 0.024, 0.01, y=h - 0.07, z=-0.018), frame)
        if kind == "slats":
            add(block(w - 0.05, 0.035, 0.018, y=0.1, z=-0.018), frame)
            count = int(m.rng.integers(3, 7))
            for x in np.linspace(-w / 2 + 0.07, w / 2 - 0.07, count):
                add(block(0.025, h - 0.17, 0.012, x=float(x), y=0.115, z=-0.018), frame)
        else:
            for y in np.linspace(0.12, h - 0.16, int(m.rng.integers(2, 4))):
                add(soft_box(w - 0.05, 0.055, 0.018, 0.008, y=float(y), z=-0.018), frame)
    elif kind == "curved":
        x = np.linspace(-w / 2, w / 2, 13)
        line = np.stack([x, -0.03 + 0.06 * (2 * x / w) ** 2 - 0.035], 1)
        add(ribbon(line, 0.016, 0.55 * h, 0.45 * h), frame, True)
        for sx in (-1, 1):
            add(bar((sx * w * 0.36, -0.05, -0.06), (sx * w * 0.36, h * 0.5, -0.058), 0.011), frame, True)
    else:
        low = 0.02 if m.chance(0.5) else 0.14
        depth = 0.045 if kind == "padded" else 0.016
        add(
            soft_box(w - 0.01, h - low, depth, 0.45 * depth, y=low, z=-depth / 2 - 0.002, steps=3),
            cover,
            kind == "padded",
        )
        for post in posts:
            add(moved(post, z=-depth), frame)


def _chair_arms(m: Maker, seat: Seat, frame: Material) -> None:
    low, rise = seat.height_m - 0.04, m.uniform(0.18, 0.24)
    for sx in (-1, 1):
        x = sx * (seat.width_m / 2 + 0.022)
        m.add(soft_box(0.045, 0.025, seat.depth_m * 0.85, 0.008, x=x, y=seat.height_m + rise, z=-0.02), frame)
        for z in (seat.depth_m / 2 - 0.1, -seat.depth_m / 2 + 0.05):
            m.add(block(0.026, seat.height_m + rise - low, 0.03, x=x, y=low, z=z), frame)


def _upholstered(m: Maker, p: Palette, seat: Seat, label: str) -> str:
    """Armchair or sofa: base, seat cushions, back cushions, armrests."""
    cover = pick(m.rng, (p.fabric, p.fabric, p.fabric2, p.leather))
    w, d, h = seat.width_m, seat.depth_m, seat.height_m
    back_m, arm_m = m.uniform(0.12, 0.2), m.uniform(0.09, 0.2)
    legs_m = pick(m.rng, (0.03, 0.1, 0.14))
    cushion_m = m.uniform(0.1, 0.16)
    outer = w + (2 * arm_m if seat.arms else 0.0)
    rear = -d / 2 - (back_m + 0.02 if seat.back is not None else 0.0)
    depth = d / 2 + 0.01 - rear
    m.add(soft_box(outer - 0.01, h - cushion_m - legs_m, depth, 0.02, y=legs_m, z=rear + depth / 2), cover)
    seats = 1 if w < 1.0 else round(w / m.uniform(0.55, 0.8))
    each = w / seats
    for k in range(seats):
        x = -w / 2 + (k + 0.5) * each
        m.add(
            soft_box(each - 0.004, cushion_m, d + 0.02, 0.3 * cushion_m, x=x, y=h - cushion_m, z=0.01, steps=4),
            cover,
            True,
        )
        if seat.back is not None:
            rest = soft_box(each - 0.01, seat.back.height_m, back_m, 0.35 * back_m, x=x, z=-back_m / 2, steps=4)
            m.add(_leaned(rest, seat), cover, True)
    if seat.back is not None and m.chance(0.6):
        lean = seat.back.height_m * np.sin(seat.back.tilt_rad)
        m.add(
            soft_box(outer - 0.01, h + seat.back.height_m * 0.8 - legs_m, 0.06, 0.02, y=legs_m, z=rear - lean * 0.8),
            cover,
        )
    if seat.arms:
        rise = m.uniform(0.14, 0.24)
        for sx in (-1, 1):
            x = sx * (w / 2 + arm_m / 2)
            m.add(
                soft_box(arm_m, h + rise - legs_m, depth, 0.3 * arm_m, x=x, y=legs_m, z=rear + depth / 2, steps=4),
                cover,
                True,
            )
    wood = pick(m.rng, (p.wood, p.wood2, p.metal))
    for sx in (-1, 1):
        for z in (d / 2 - 0.06, rear + 0.06):
            m.add(cylinder(0.016, legs_m + 0.01, x=sx * (outer / 2 - 0.07), z=z, top=0.024), wood, True)
    return f"{label}, {seats} seat{'s' if seats > 1 else ''}, {cover.kind}, {arm_m:.2f} m arms"


def seat_pad(seat: Seat, rng: np.random.Generator, palette: Palette) -> SceneObject:
    """The simplest seat: an upholstered cube without backrest and armrests."""
    m = Maker(rng)
    m.surface("seat", seat.height_m, (seat.width_m, seat.depth_m))
    cover = pick(rng, (palette.fabric, palette.accent, palette.leather))
    m.add(soft_box(seat.width_m, seat.height_m, seat.depth_m, 0.02, steps=3), cover, True)
    return m.done("stool", "cube")
