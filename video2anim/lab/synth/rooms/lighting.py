"""Lamps, windows and sun, scaled so that a gray wall renders gray."""

from __future__ import annotations

import numpy as np

from video2anim.lab.synth.rooms.making import Maker, pose
from video2anim.lab.synth.rooms.materials import Palette, glowing, pick, plain
from video2anim.lab.synth.rooms.placing import Bounds, Boxes, Plan, wall_frame
from video2anim.lab.synth.rooms.primitives import bar, cylinder, lathe, moved
from video2anim.lab.synth.rooms.structure import Opening
from video2anim.lab.synth.world import Light, SceneObject

_SKY_AWAY_M = 1.1
"""Distance of a window's light outside the pane, so that light enters as from the sky (panes cast no shadow)."""
_TARGET_IRRADIANCE = np.pi * 0.95
"""Target irradiance E. A matte surface of albedo a reflects a E / pi: at E = pi it is as bright as its color."""


def _unit_rgb(rgb: tuple[float, float, float]) -> np.ndarray:
    """The color scaled to brightness 1."""
    tint = np.asarray(rgb)
    return tint / (tint @ [0.2126, 0.7152, 0.0722])


def make_lights(
    rng: np.random.Generator, palette: Palette, plan: Plan, openings: tuple[Opening, ...], lamps: list[SceneObject]
) -> tuple[tuple[Light, ...], tuple[float, float, float], list[SceneObject]]:
    """Lights, ambient irradiance (linear RGB) and the objects of the ceiling lamps."""
    warm = _unit_rgb(pick(rng, ((1.0, 0.86, 0.68), (1.0, 0.91, 0.78), (1.0, 0.96, 0.90))))
    day = _unit_rgb(pick(rng, ((0.86, 0.93, 1.0), (0.95, 0.97, 1.0), (1.0, 0.97, 0.92))))
    daylight = float(rng.uniform(0.25, 0.75))
    drawn: list[tuple[np.ndarray, np.ndarray, float, float]] = []  # position, tint, share, radius
    fixtures, places = _ceiling_lamps(rng, palette, plan)
    drawn += [(place, warm, (1 - daylight) / len(places), 0.14) for place in places]
    windows = [o for o in openings if o.kind == "window"]
    for o in windows:
        frame = wall_frame(plan.bounds_m, o.side)
        outside = frame @ [(o.x0 + o.x1) / 2, (o.y0 + o.y1) / 2 + 0.35, -_SKY_AWAY_M, 1.0]
        drawn.append((outside[:3], day, 4.0 * daylight / len(windows), 0.45))
    for lamp in lamps:
        top = max(part.vertices_m[:, 1].max() for part in lamp.parts)
        drawn.append((lamp.T_world_object[:3, 3] + [0, top - 0.12, 0], warm, 0.025, 0.04))
    ambient = (0.46 + 0.1 * daylight) * _TARGET_IRRADIANCE * (daylight * day + (1 - daylight) * warm)
    arriving = sum(share * _mean_reach(plan.bounds_m, place, windows) for place, _, share, _ in drawn)
    scale = (_TARGET_IRRADIANCE - float(ambient.mean())) / max(arriving, 1e-6)
    lights = [_light(place, tint * share * scale, radius) for place, tint, share, radius in drawn]
    if windows and rng.random() < 0.35:
        lights.append(_sun(rng, plan.bounds_m, windows[int(rng.integers(len(windows)))]))
    return tuple(lights), _triple(ambient), fixtures


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    r, g, b = (round(float(v), 6) for v in values)
    return r, g, b


def _light(position: np.ndarray, rgb: np.ndarray, radius: float) -> Light:
    return Light(_triple(position), _triple(rgb), radius)


def _mean_reach(bounds_m: Bounds, place: np.ndarray, windows: list[Opening]) -> float:
    """Mean of cos / d^2 over the floor and the walls at 1.2 m height. A light outside shines only through windows."""
    x0, x1, z0, z1 = bounds_m
    x, z = np.meshgrid(np.linspace(x0 + 0.3, x1 - 0.3, 7), np.linspace(z0 + 0.3, z1 - 0.3, 7))
    spots = [(np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], 1), np.array([0.0, 1.0, 0.0]))]
    for side in range(4):
        frame = wall_frame(bounds_m, side)
        half = (x1 - x0 if side % 2 == 0 else z1 - z0) / 2 - 0.3
        along = np.linspace(-half, half, 7)[:, None] * frame[:3, 0]
        spots.append((frame[:3, 3] + along + [0, 1.2, 0], frame[:3, 2]))
    total = []
    for points, normal in spots:
        way = place - points
        far2 = np.maximum((way**2).sum(1), 0.25)
        total.append(np.maximum(way @ normal, 0) / far2**1.5 * _seen_through(bounds_m, place, points, windows))
    return float(np.clip(np.concatenate(total), 0, 0.6).mean())


def _seen_through(bounds_m: Bounds, place: np.ndarray, points: np.ndarray, windows: list[Opening]) -> np.ndarray:
    """1 for points that a light inside the room, or outside one of the windows, reaches; else 0."""
    for o in windows:
        T_wall = np.linalg.inv(wall_frame(bounds_m, o.side))
        light, local = T_wall[:3, :3] @ place + T_wall[:3, 3], points @ T_wall[:3, :3].T + T_wall[:3, 3]
        if light[2] < 0:
            share = light[2] / (light[2] - local[:, 2])
            at = light + share[:, None] * (local - light)
            return ((at[:, 0] > o.x0) & (at[:, 0] < o.x1) & (at[:, 1] > o.y0) & (at[:, 1] < o.y1)).astype(float)
    return np.ones(len(points))


def _sun(rng: np.random.Generator, bounds_m: Bounds, window: Opening) -> Light:
    """Parallel sunlight through one of the windows."""
    frame = wall_frame(bounds_m, window.side)
    height, aside = float(rng.uniform(0.45, 0.95)), float(rng.uniform(-0.7, 0.7))
    local = np.array([np.cos(height) * np.sin(aside), -np.sin(height), np.cos(height) * np.cos(aside)])
    way = frame[:3, :3] @ local
    strength = _unit_rgb((1.0, 0.93, 0.80)) * np.pi * float(rng.uniform(1.0, 2.2))
    center = frame @ [(window.x0 + window.x1) / 2, (window.y0 + window.y1) / 2, 0, 1.0]
    return Light(_triple(center[:3] - 6.0 * way), _triple(strength), 0.1, _triple(way))


def _ceiling_lamps(
    rng: np.random.Generator, palette: Palette, plan: Plan
) -> tuple[list[SceneObject], list[np.ndarray]]:
    """One ceiling lamp, or a grid of them in large rooms: pendants if the ceiling is high enough, else flush."""
    x0, x1, z0, z1 = plan.bounds_m
    nx, nz = max(1, round((x1 - x0) / 4.5)), max(1, round((z1 - z0) / 4.5))
    drop = float(rng.uniform(0.35, 0.7)) if rng.random() < 0.45 else 0.0
    shade = float(rng.uniform(0.16, 0.24))
    number = int(rng.integers(2**31))
    fixtures, places = [], []
    for ix in range(nx):
        for iz in range(nz):
            x, z = x0 + (ix + 0.5) * (x1 - x0) / nx, z0 + (iz + 0.5) * (z1 - z0) / nz
            lamp = _pendant(np.random.default_rng(number), palette, drop, shade)
            T = pose(x, z, 0.0, plan.height_m)
            if not plan.fits(Boxes.of(lamp).at(T), clear_m=0.12, ignore_free=True):
                lamp = _pendant(np.random.default_rng(number), palette, 0.0, shade)
                if not plan.fits(Boxes.of(lamp).at(T), clear_m=0.02, ignore_free=True):
                    continue
            fixtures.append(plan.add(lamp.moved(T)))
            low = min(part.vertices_m[:, 1].min() for part in lamp.parts)
            places.append(np.array([x, plan.height_m + low + (0.03 if drop else -0.05), z]))
    return fixtures, places or [np.array([(x0 + x1) / 2, plan.height_m - 0.2, (z0 + z1) / 2])]


def _pendant(rng: np.random.Generator, palette: Palette, drop: float, r: float) -> SceneObject:
    """Ceiling lamp below y = 0: a flush bowl, or a shade on a cord."""
    m = Maker(rng)
    if drop == 0.0:
        bowl = [(0.4 * r, -0.085), (0.85 * r, -0.065), (r, -0.03), (r, -0.012)]
        m.add(lathe(bowl, 28), glowing((0.98, 0.95, 0.88), 1.5), True)
        m.add(cylinder(r * 1.05, 0.014, y=-0.014, sides=28), palette.metal, True)
    else:
        m.add(bar((0, -drop + 0.1, 0), (0, -0.02, 0), 0.004, 6), plain(rng, (0.15, 0.15, 0.15)))
        m.add(cylinder(0.05, 0.025, y=-0.025), palette.metal, True)
        top, tall = r * float(rng.uniform(0.25, 0.9)), float(rng.uniform(0.16, 0.24))
        ring = [(r, 0.0), (top, tall), (top - 0.004, tall), (r - 0.004, 0.0)]
        glow = glowing((0.97, 0.90, 0.78), 0.9) if rng.random() < 0.6 else pick(rng, (palette.metal, palette.lacquer))
        m.add(moved(lathe(ring, 32, closed=True), y=-drop - 0.1), glow, True)
        m.add(
            bar((-top + 0.003, -drop + tall - 0.13, 0), (top - 0.003, -drop + tall - 0.13, 0), 0.003, 6), palette.metal
        )
        m.add(bar((0, -drop + tall - 0.13, 0), (0, -drop + 0.1, 0), 0.004, 6), palette.metal)
    return SceneObject(1, "lamp", tuple(m.parts), np.eye(4), note="ceiling lamp")
