"""Builds the objects that a procedural motion needs, with the size and place that it needs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError
from video2anim.lab.synth.rooms.clearance import PointSet
from video2anim.lab.synth.rooms.decor import ITEM_LABELS, make_clutter, scaled_into
from video2anim.lab.synth.rooms.making import Maker, pose
from video2anim.lab.synth.rooms.materials import Palette, pick
from video2anim.lab.synth.rooms.placing import Bounds, Boxes, overlap
from video2anim.lab.synth.rooms.primitives import cylinder, plain_box, soft_box
from video2anim.lab.synth.rooms.seats import Back, Seat, draw_seat, make_seat, seat_pad
from video2anim.lab.synth.rooms.storage import make_cabinet, make_shelf
from video2anim.lab.synth.rooms.tables import make_bed, make_box, make_desk, make_step, make_table
from video2anim.lab.synth.world import Prop, SceneObject

MAX_PENETRATION_M = 0.002
"""Largest allowed depth of a body point in an object."""
_SCREENED = 150_000
"""Approximate number of body points for a first test of a design."""
ITEM_NOTE = "item of prop "
"""Start of the note of an object that is picked up; the index of its prop follows."""


def prop_pose(prop: Prop) -> Float[np.ndarray, "4 4"]:
    """Frame of a prop: origin on the floor under its position, +Z the way it faces."""
    x, _, z = prop.position_m
    return pose(x, z, prop.yaw_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """Room and body points that limit how props are built."""

    palette: Palette
    points: PointSet
    bounds_m: Bounds
    allowed_m: float = MAX_PENETRATION_M
    """Allowed depth of body points in the best design, if no design is free of them."""


def build_props(props: tuple[Prop, ...], rng: np.random.Generator, site: Site) -> list[SceneObject]:
    """One object per prop, in a design that no body and no other object enters.

    There is none for a `wall` prop that is a wall of the room.

    Raises:
        InputError: no design for a prop fits.
    """
    made: list[SceneObject] = []
    alike = int(rng.integers(2**31))  # steps of a flight
    for number, prop in enumerate(props):
        if prop.kind == "item" or (prop.kind == "wall" and serving_wall(prop, site.bounds_m) is not None):
            continue
        own = np.random.default_rng(alike) if prop.kind == "step" else rng
        made.append(_first_clear(number, prop, own, site, made))
    for number, prop in enumerate(props):
        if prop.kind == "item":
            made.extend(_item(number, prop, rng, site, made))
    return made


def serving_wall(prop: Prop, bounds_m: Bounds) -> int | None:
    """Side of the room's wall on which a `wall` prop lies (0 = -Z, 1 = +X, 2 = +Z, 3 = -X); None if there is none."""
    facing = np.array([np.sin(prop.yaw_rad), np.cos(prop.yaw_rad)])
    for side, (axis, sign, edge) in enumerate(((1, 1, 2), (0, -1, 1), (1, -1, 3), (0, 1, 0))):
        at = prop.position_m[2] if axis else prop.position_m[0]
        if facing[axis] * sign > 1 - 1e-6 and abs(at - bounds_m[edge]) < 1e-6:
            return side
    return None


def _first_clear(
    number: int, prop: Prop, rng: np.random.Generator, site: Site, others: list[SceneObject]
) -> SceneObject:
    """The first design that no body enters, else the best one within `site.allowed_m`."""
    T = prop_pose(prop)
    near = site.points.near(np.array(prop.position_m), 2.6)
    local = (near - T[:3, 3]) @ T[:3, :3]
    some = PointSet(near[:: max(1, len(near) // _SCREENED)])
    best, min_bad = np.inf, None
    for candidate in _candidates(prop, rng, site.palette, local):
        placed = candidate.moved(T @ candidate.T_world_object)
        deepest = some.max_depth_m(placed)
        if deepest <= MAX_PENETRATION_M:
            deepest = site.points.max_depth_m(placed)
        boxes = Boxes.of(placed)
        corners = boxes.corners_xz()
        x0, x1, z0, z1 = site.bounds_m
        inside = corners[:, 0].min() >= x0 and corners[:, 0].max() <= x1 and corners[:, 1].min() >= z0
        inside = inside and corners[:, 1].max() <= z1
        apart = prop.kind == "step" or not any(overlap(boxes, Boxes.of(other)) for other in others)
        if deepest <= MAX_PENETRATION_M and inside and apart:
            return replace(placed, note=f"prop {number} {prop.kind}: {placed.note}")
        if inside and apart and deepest < best:
            best, min_bad = deepest, placed
    if min_bad is not None and site.points.max_depth_m(min_bad) <= site.allowed_m:
        return replace(min_bad, note=f"prop {number} {prop.kind}: {min_bad.note}")
    size = f"{prop.size_m[0]:.2f} x {prop.size_m[1]:.2f} m"
    why = (
        f"bodies are at least {100 * best:.1f} cm deep in every design"
        if best < np.inf
        else "every design overlaps a wall or another prop"
    )
    raise InputError(f"no {prop.kind} of {size} fits at {_place(prop)}: {why}; draw the motion again")


def _place(prop: Prop) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in prop.position_m) + ")"


def _onto(obj: SceneObject, x: float, z: float, index: int = 0) -> SceneObject:
    """The object with the center of one of its surfaces above (x, z) of the prop's frame."""
    cx, cz = obj.surfaces[index].center_m
    return obj.moved(pose(x - cx, z - cz, 0.0))


def _candidates(prop: Prop, rng: np.random.Generator, palette: Palette, local: np.ndarray) -> Iterator[SceneObject]:
    """Designs in the prop's frame, from the most usual to the simplest."""
    makers = {"seat": _seats, "bed": _beds, "table": _tables, "step": _steps, "wall": _walls}
    if prop.kind not in makers:
        raise InputError(f"unknown kind of prop {prop.kind!r}; known are {', '.join((*makers, 'item'))}")
    yield from makers[prop.kind](prop, rng, palette, local)


def _seats(prop: Prop, rng: np.random.Generator, palette: Palette, local: np.ndarray) -> Iterator[SceneObject]:
    (w, d), h = prop.size_m, prop.position_m[1]
    order = ["armchair", "sofa", "chair"] if h < 0.42 else ["chair", "armchair", "sofa", "chair"]
    labels = [order[int(k)] for k in rng.permutation(len(order))]
    if not prop.back:
        labels.insert(int(rng.integers(len(labels))), "stool")
    for label in (*labels, "chair", "chair"):
        drawn = draw_seat(label, rng)
        width = max(w, drawn.width_m if label == "sofa" else min(drawn.width_m, w + 0.12))
        if label == "stool":
            yield _onto(make_seat("stool", Seat(max(w, 0.3), max(d, 0.3), h), rng, palette), 0.0, 0.0)
            continue
        back = _fitted_back(prop, drawn.back, local, rng)
        if back is None:
            continue
        rest, rear = back
        front = d / 2
        seat = Seat(float(width), front - rear, h, rest, drawn.arms)
        aside = float(rng.uniform(-1, 1)) * max(0.0, (width - w) / 2 - 0.02) if label == "sofa" else 0.0
        yield _onto(make_seat(label, seat, rng, palette), aside, (front + rear) / 2)
    if prop.back:
        back = _fitted_back(prop, Back(0.2, 0.45), local, rng)
        if back is not None:
            yield _onto(
                make_seat("chair", Seat(w, d / 2 - back[1], h, back[0]), rng, palette), 0.0, (d / 2 + back[1]) / 2
            )
    yield _onto(make_seat("stool", Seat(w, d, h), rng, palette), 0.0, 0.0)
    yield _onto(make_seat("chair", Seat(w, d, h), rng, palette), 0.0, 0.0)
    for share in (1.0, 0.85, 0.7):
        yield _onto(seat_pad(Seat(w * share, d * share, h), rng, palette), 0.0, -0.5 * (1 - share) * d)


def _fitted_back(
    prop: Prop, back: Back | None, local: np.ndarray, rng: np.random.Generator
) -> tuple[Back, float] | None:
    """A backrest that touches the sitter's back (if `prop.back`) or stays clear of it, and the z at which it starts."""
    if back is None:
        return None
    h = prop.position_m[1]
    reach = prop.size_m[0] / 2 + 0.2
    above = local[(np.abs(local[:, 0]) < reach) & (local[:, 1] > h - 0.02) & (local[:, 1] < h + back.height_m + 0.05)]
    above = above[(above[:, 2] > -0.75) & (above[:, 2] < 0.3)]
    if len(above) == 0:
        return back, -prop.size_m[1] / 2
    best: tuple[float, Back, float] | None = None
    for tilt in np.linspace(0.0, 0.42, 15):
        rear = float((above[:, 2] + np.tan(tilt) * (above[:, 1] - h)).min())
        gap = float(above[:, 2].mean() - rear)
        wish = gap if prop.back else abs(tilt - back.tilt_rad)
        if best is None or wish < best[0]:
            best = (wish, replace(back, tilt_rad=float(tilt)), rear)
    assert best is not None
    rear = best[2] - (0.0 if prop.back else float(rng.uniform(0.015, 0.06)))
    rear = rear if prop.back else min(rear, -prop.size_m[1] / 2)
    return (best[1], rear) if rear > -prop.size_m[1] / 2 - 0.35 and rear < 0.0 else None


def _beds(prop: Prop, rng: np.random.Generator, palette: Palette, local: np.ndarray) -> Iterator[SceneObject]:
    """Beds with their +Z edge at the prop's, where people sit; they extend away from it. Heads lie at the head end."""
    (w, d), h = prop.size_m, prop.position_m[1]
    across = w > d
    first = np.pi if _heads_up(prop, local, 0 if across else 2) else 0.0
    for grow in (0.6, 0.3, 0.1, 0.0, 0.0):
        more = float(rng.uniform(0, grow)) if grow else 0.0
        size = (d + more, w) if across else (w + more, d)
        for turn in (first, np.pi - first):
            bed = make_bed(rng, palette, size, h, flat=True)
            cx, cz = bed.surfaces[0].center_m
            T = pose(0.0, -more / 2 if across else 0.0, turn + (np.pi / 2 if across else 0.0))
            yield bed.moved(T @ pose(-cx, -cz, 0.0))
    m = Maker(rng)
    m.surface("bed", h, (w, d))
    m.add(soft_box(w, min(0.2, 0.6 * h), d, 0.04, y=h - min(0.2, 0.6 * h), steps=4), palette.fabric, True)
    m.add(soft_box(w - 0.1, h - min(0.2, 0.6 * h), d - 0.1, 0.01), palette.wood)
    yield _onto(m.done("bed", "divan"), 0.0, 0.0)


def _heads_up(prop: Prop, local: np.ndarray, axis: int) -> bool:
    """Whether the heads of lying people are at the positive end: the half with more body points (trunk, head, arms)."""
    (w, d), h = prop.size_m, prop.position_m[1]
    over = (np.abs(local[:, 0]) < w / 2) & (np.abs(local[:, 2]) < d / 2)
    over &= (local[:, 1] > h - 0.03) & (local[:, 1] < h + 0.3)
    along = local[over, axis]
    if len(along) == 0:
        return False
    return bool(along.mean() > np.percentile(along, [1, 99]).mean())


def _tables(prop: Prop, rng: np.random.Generator, palette: Palette, local: np.ndarray) -> Iterator[SceneObject]:
    """Tables with their near edge at the prop's; they extend sideways and away from the person."""
    (w, d), h = prop.size_m, prop.position_m[1]
    if h < 0.62:
        labels = ("table", "cabinet", "box")
    elif h < 0.82:
        labels = ("table", "desk", "cabinet", "table")
    elif h < 1.15:
        labels = ("cabinet", "shelf")
    else:
        labels = ("shelf", "shelf", "cabinet")
    chosen = [labels[int(k)] for k in rng.permutation(len(labels))]
    if h >= 1.15:
        chosen.sort(key=lambda label: label != "shelf")
    for share in (1.0, 0.5, 0.0):
        for label in chosen:
            wide = w + share * float(rng.uniform(0.1, 0.9))
            deep = d + share * float(rng.uniform(0.05, 0.4))
            aside = float(rng.uniform(-1, 1)) * (wide - w) / 2
            if label == "shelf":
                deep = min(deep, max(d, 0.34))
                above = local[(np.abs(local[:, 0]) < w) & (local[:, 1] > h)]
                tall = h + 0.45 if len(above) == 0 or rng.random() < 0.5 else None
                obj = make_shelf(rng, palette, (wide + 0.05, deep + 0.02), tall, board_m=h)
                index = next(k for k, s in enumerate(obj.surfaces) if abs(s.height_m - h) < 1e-6)
            else:
                makers = {"table": make_table, "desk": make_desk, "cabinet": make_cabinet, "box": make_box}
                obj, index = makers[label](rng, palette, (wide, deep), h), 0
            yield _onto(obj, aside, d / 2 - deep / 2, index)
    m = Maker(rng)
    m.surface("top", h, (w, d))
    m.add(soft_box(w, 0.03, d, 0.006, y=h - 0.03), palette.wood)
    m.add(cylinder(0.03, h - 0.04, y=0.02, z=-d / 4), palette.metal, True)
    m.add(soft_box(0.5 * w, 0.02, 0.5 * d, 0.006, z=-d / 4), palette.metal)
    yield _onto(m.done("table", "side table"), 0.0, 0.0)


def _steps(prop: Prop, rng: np.random.Generator, palette: Palette, local: np.ndarray) -> Iterator[SceneObject]:
    (w, d), h = prop.size_m, prop.position_m[1]
    for grow in (0.3, 0.1, 0.0, 0.0):
        wide = w + (float(rng.uniform(0, grow)) if grow else 0.0)
        yield _onto(make_step(rng, palette, (wide, d), h, 1), 0.0, 0.0)
    m = Maker(rng)
    m.surface("tread", h, (w, d))
    m.add(plain_box(w, h, d), palette.wood)
    yield _onto(m.done("step", "plinth"), 0.0, 0.0)


def _walls(prop: Prop, rng: np.random.Generator, palette: Palette, local: np.ndarray) -> Iterator[SceneObject]:
    """Vertical surfaces with their front in the prop's plane: the back of a wardrobe, a pillar or a free-standing
    wall."""
    w = max(prop.size_m[0], 0.4)
    for share in (1.0, 0.4, 0.0):
        wide = w + share * float(rng.uniform(0.2, 0.8))
        aside = float(rng.uniform(-1, 1)) * (wide - w) / 2
        if rng.random() < 0.45:
            tall = max(float(rng.uniform(1.85, 2.1)), prop.position_m[1] + 0.3)
            obj = make_cabinet(rng, palette, (wide, 0.56), tall, kind="wardrobe", plain_back=True)
            T = pose(0, 0, np.pi)
        else:
            thick = pick(rng, (0.12, 0.2, 0.45))
            m = Maker(rng)
            m.add(
                plain_box(wide, max(2.2, prop.position_m[1] + 0.4), thick),
                pick(rng, (palette.wall, palette.accent_wall)),
            )
            obj, T = m.done("wall", "free-standing wall"), np.eye(4)
        turned = obj.moved(T)
        front = float(Boxes.of(turned).corners_xz()[:, 1].max())
        if T[0, 0] < 0:
            front = float(-min(part.vertices_m[:, 2].min() for part in obj.parts))
        yield obj.moved(pose(aside, -front, 0.0) @ T)


def _item(
    number: int, prop: Prop, rng: np.random.Generator, site: Site, others: list[SceneObject]
) -> list[SceneObject]:
    """The small object, and a stand below it if nothing supports it. It may touch people: a hand holds it."""
    label = pick(rng, ITEM_LABELS)
    size = (min(prop.size_m[0], 0.25), min(prop.size_m[1], 0.25))
    if label == "box":
        obj = make_box(rng, site.palette, size, max(0.06, 0.7 * min(size)))
    else:
        obj = make_clutter(label, rng, site.palette)
    obj = scaled_into(obj, size)
    x, y, z = prop.position_m
    out = [replace(obj.moved(pose(x, z, prop.yaw_rad, y)), note=f"{ITEM_NOTE}{number}: {obj.note}")]
    if y > 0.03 and not any(_carries(other, prop) for other in others):
        stand = replace(prop, kind="table", size_m=(max(0.25, size[0]), max(0.25, size[1])))
        out.insert(0, _first_clear(number, stand, rng, site, others))
    return out


def _carries(obj: SceneObject, prop: Prop) -> bool:
    local = np.linalg.inv(obj.T_world_object) @ [*prop.position_m, 1.0]
    return any(
        abs(s.height_m - local[1]) < 0.01
        and abs(local[0] - s.center_m[0]) < s.size_m[0] / 2
        and abs(local[2] - s.center_m[1]) < s.size_m[1] / 2
        for s in obj.surfaces
    )
