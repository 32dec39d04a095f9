"""Usual arrangements of furniture. Each piece is placed only where it fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from video2anim.lab.synth.rooms.decor import make_clutter, make_lamp, make_plant, make_television
from video2anim.lab.synth.rooms.furniture import make_furniture
from video2anim.lab.synth.rooms.making import pose
from video2anim.lab.synth.rooms.materials import Palette
from video2anim.lab.synth.rooms.placing import Boxes, Plan
from video2anim.lab.synth.rooms.storage import make_cabinet, make_shelf
from video2anim.lab.synth.rooms.tables import make_desk, make_table
from video2anim.lab.synth.world import SceneObject

STYLES = ("living", "bedroom", "dining", "office", "studio")


@dataclass(slots=True)
class Furnisher:
    """Makes and places the furniture of one room."""

    plan: Plan
    rng: np.random.Generator
    palette: Palette
    clutter: float

    def make(self, label: str) -> SceneObject:
        return make_furniture(label, self.rng, palette=self.palette)

    def beside(
        self, anchor: SceneObject | None, obj: SceneObject, x: float, z: float, yaw: float = 0.0, **rules
    ) -> SceneObject | None:
        """Place an object at (x, z) of the anchor's frame if it fits; None if not, or if there is no anchor."""
        if anchor is None:
            return None
        return self.plan.try_at(obj, anchor.T_world_object @ pose(x, z, yaw), **rules)

    def on_top(
        self, base: SceneObject | None, obj: SceneObject, x: float = 0.0, z: float = 0.0, yaw: float = 0.0
    ) -> None:
        """Place an object on the first surface of another, at (x, z) from the surface's center."""
        if base is None or not base.surfaces:
            return
        s = base.surfaces[0]
        T = base.T_world_object @ pose(s.center_m[0] + x, s.center_m[1] + z, yaw, s.height_m)
        self.plan.try_at(obj, T, apart_m=0.0, ignore_free=True)

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def u(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))


def _size(obj: SceneObject) -> tuple[float, float, float]:
    whole = Boxes.of(obj).whole()
    x, y, z = whole.high_m[0] - whole.low_m[0]
    return float(x), float(y), float(z)


def living(f: Furnisher) -> None:
    """Living room: sofa, coffee table, armchair, lamp; media board with television; shelves."""
    sofa = f.plan.against_wall(f.make("sofa"), f.rng, tries=40)
    if sofa is None:
        small = make_furniture("sofa", f.rng, size_m=(1.25, 0.55), palette=f.palette)
        sofa = f.plan.against_wall(small, f.rng, tries=40)
    if sofa is not None:
        w, _, d = _size(sofa)
        table = make_table(f.rng, f.palette, None, f.u(0.36, 0.46))
        _tw, _, td = _size(table)
        f.beside(sofa, table, f.u(-0.15, 0.15), d / 2 + f.u(0.32, 0.42) + td / 2)
        side = 1 if f.chance(0.5) else -1
        lamp = make_lamp(f.rng, f.palette, f.u(1.4, 1.7))
        if f.beside(sofa, lamp, side * (w / 2 + 0.3), 0.0) is None:
            f.beside(sofa, lamp, -side * (w / 2 + 0.3), 0.0)
        chair = f.make("armchair")
        for s in (side, -side):
            turn = -s * f.u(1.1, 1.7)
            if f.beside(sofa, chair, s * (w / 2 + f.u(0.3, 0.5)), d / 2 + f.u(0.5, 0.8), turn) is not None:
                break
    else:
        f.plan.against_wall(f.make("armchair"), f.rng, tries=24)
    board = f.plan.against_wall(make_cabinet(f.rng, f.palette, None, None, kind="media"), f.rng, tries=20)
    f.on_top(board, make_television(f.rng))
    f.plan.against_wall(f.make("shelf"), f.rng)
    if f.chance(0.6):
        f.plan.against_wall(make_cabinet(f.rng, f.palette, None, None, kind="sideboard"), f.rng)


def bedroom(f: Furnisher) -> None:
    """Bedroom: bed with night tables, wardrobe, chest or desk, armchair."""
    bed = f.plan.against_wall(f.make("bed"), f.rng, tries=60)
    for width in (1.4, 0.9):
        for turn in (0.0, np.pi / 2, -np.pi / 2):
            if bed is None:
                small = make_furniture("bed", f.rng, size_m=(width, 1.98), palette=f.palette)
                bed = f.plan.against_wall(small, f.rng, tries=50, turn=turn)
    if bed is not None:
        w, _, d = _size(bed)
        for side in (-1, 1):
            table = make_cabinet(f.rng, f.palette, None, None, kind="night")
            tw, _, td = _size(table)
            placed = f.beside(bed, table, side * (w / 2 + tw / 2 + 0.04), -d / 2 + td / 2)
            if f.chance(0.7):
                f.on_top(placed, make_lamp(f.rng, f.palette, f.u(0.32, 0.48)))
    f.plan.against_wall(make_cabinet(f.rng, f.palette, None, None, kind="wardrobe"), f.rng, tries=24)
    if f.chance(0.5):
        _desk_group(f)
    else:
        f.plan.against_wall(make_cabinet(f.rng, f.palette, None, None, kind="chest"), f.rng)
    f.plan.against_wall(f.make("armchair" if f.chance(0.5) else "chair"), f.rng)


def dining(f: Furnisher) -> None:
    """Dining room: kitchen row, and a table with chairs."""
    f.plan.against_wall(make_cabinet(f.rng, f.palette, None, None, kind="kitchen"), f.rng, tries=24)
    table = make_table(f.rng, f.palette, None, f.u(0.72, 0.77))
    placed = f.plan.anywhere(table, f.rng, yaw=float(f.rng.choice([0, np.pi / 2])), tries=40, apart_m=0.6)
    placed = placed or f.plan.against_wall(table, f.rng, tries=24)
    if placed is not None:
        chairs_around(f, placed)
    f.plan.against_wall(make_cabinet(f.rng, f.palette, None, None, kind="sideboard"), f.rng)
    if f.chance(0.5):
        f.plan.against_wall(f.make("shelf"), f.rng)


def chairs_around(f: Furnisher, table: SceneObject) -> None:
    """Equal chairs around a table, pushed in or pulled out a little."""
    w, _, d = _size(table)
    spots = []
    if "round" in table.note:
        count = int(f.rng.integers(3, 5))
        for k in range(count):
            a = 2 * np.pi * k / count
            spots.append((a, w / 2))
    else:
        per_side = 2 if w > 1.35 else 1
        spots = [(a, d / 2) for a in (0.0, np.pi) for _ in range(per_side)] + [(np.pi / 2, w / 2), (-np.pi / 2, w / 2)]
    number = int(f.rng.integers(2**31))
    for k, (a, reach) in enumerate(spots):
        if f.chance(0.12):
            continue
        chair = make_furniture("chair", np.random.default_rng(number), palette=f.palette)
        _, _, cd = _size(chair)
        out = reach + cd / 2 - f.u(-0.08, 0.14)
        aside = 0.0
        if "round" not in table.note and abs(np.cos(a)) > 0.5 and w > 1.35:
            aside = (w / 4) * (1 if k % 2 == 0 else -1)
        x, z = out * np.sin(a) + aside * np.cos(a), out * np.cos(a) - aside * np.sin(a)
        turn = a + np.pi + f.u(-0.12, 0.12)
        if f.beside(table, chair, float(x), float(z), float(turn)) is None:
            grown = 0.12
            x, z = x + grown * np.sin(a), z + grown * np.cos(a)
            f.beside(table, chair, float(x), float(z), float(turn))


def _desk_group(f: Furnisher) -> None:
    """Desk with a screen, and a chair in front of it."""
    desk = f.plan.against_wall(make_desk(f.rng, f.palette, None, None), f.rng, tries=24)
    if desk is None:
        return
    _, _, d = _size(desk)
    chair = f.make("chair")
    f.beside(desk, chair, f.u(-0.15, 0.15), d / 2 + f.u(0.05, 0.4), np.pi + f.u(-0.5, 0.5))
    f.on_top(desk, make_clutter("monitor", f.rng, f.palette), f.u(-0.15, 0.15), -0.12, f.u(-0.1, 0.1))
    if f.chance(0.4):
        f.on_top(desk, make_lamp(f.rng, f.palette, f.u(0.35, 0.5)), f.u(-0.5, 0.5), -0.15)


def office(f: Furnisher) -> None:
    """Office: desks, shelves, a cabinet."""
    area = (f.plan.bounds_m[1] - f.plan.bounds_m[0]) * (f.plan.bounds_m[3] - f.plan.bounds_m[2])
    for _ in range(1 + int(area > 20) + int(area > 34)):
        _desk_group(f)
    f.plan.against_wall(make_shelf(f.rng, f.palette, None, None), f.rng)
    f.plan.against_wall(
        make_cabinet(f.rng, f.palette, None, None, kind="chest" if f.chance(0.5) else "sideboard"), f.rng
    )
    if f.chance(0.5):
        f.plan.against_wall(f.make("armchair"), f.rng)


def studio(f: Furnisher) -> None:
    """Sparsely furnished hall: chairs along a wall, stools, boxes, a platform."""
    chairs = int(f.rng.integers(1, 4))
    number = int(f.rng.integers(2**31))
    for _ in range(chairs):
        f.plan.against_wall(make_furniture("chair", np.random.default_rng(number), palette=f.palette), f.rng)
    for label in ("box", "step", "stool", "shelf"):
        if f.chance(0.6):
            f.plan.against_wall(f.make(label), f.rng)
    if f.chance(0.4):
        f.plan.against_wall(f.make("sofa"), f.rng)


ARRANGE: dict[str, Callable[[Furnisher], None]] = {
    "living": living,
    "bedroom": bedroom,
    "dining": dining,
    "office": office,
    "studio": studio,
}


def extras(f: Furnisher, least: int) -> None:
    """Plants and small furniture; more until there are `least` pieces besides those that the plan began with."""
    if f.chance(0.75):
        f.plan.against_wall(make_plant(f.rng), f.rng)
    if f.chance(0.3):
        f.plan.against_wall(make_lamp(f.rng, f.palette, f.u(1.35, 1.7)), f.rng)
    if f.chance(0.35 * f.clutter * 2):
        f.plan.against_wall(f.make("box"), f.rng)
    order = ("plant", "shelf", "cabinet", "box", "stool", "lamp", "chair", "table")
    for _ in range(3 * len(order)):
        if len([obj for obj in f.plan.placed if obj.label in order or obj.surfaces]) >= least:
            break
        f.plan.against_wall(f.make(order[int(f.rng.integers(len(order)))]), f.rng)
