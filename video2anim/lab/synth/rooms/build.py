"""`build_room`: a furnished room around a given motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError
from video2anim.lab.synth.rooms.clearance import PointSet, SweepIndex
from video2anim.lab.synth.rooms.dressing import dress, hang_pictures, lay_rugs
from video2anim.lab.synth.rooms.groups import ARRANGE, STYLES, Furnisher, extras
from video2anim.lab.synth.rooms.lighting import make_lights
from video2anim.lab.synth.rooms.materials import draw_palette
from video2anim.lab.synth.rooms.placing import Bounds, Plan, wall_frame
from video2anim.lab.synth.rooms.props import ITEM_NOTE, MAX_PENETRATION_M, Site, build_props, prop_pose, serving_wall
from video2anim.lab.synth.rooms.structure import Opening, draw_openings, make_shell
from video2anim.lab.synth.world import Prop, Room, SceneObject

WALL_GAP_M = 0.12
"""Minimum distance of bodies from walls, except from a wall that they lean on."""
CAMERA_M = 2.0
"""Depth of the floor area kept free for a camera on one side of the bodies' path."""
_BEHIND_M = {"seat": 0.5, "bed": 0.2, "table": 0.1, "step": 0.05, "wall": 0.7}
"""Depth of the floor area that an object needs behind the surface of its prop, by kind of prop."""
_NEAR_LABELS = ("chair", "chair", "stool", "table", "box", "armchair", "plant")


@dataclass(frozen=True, slots=True)
class _Ground:
    """Floor rectangle that the room must contain, and walls with a given position."""

    low: np.ndarray
    high: np.ndarray
    walls: dict[int, float]
    """Side (0 = -Z, 1 = +X, 2 = +Z, 3 = -X) to the x or z of the wall that a `wall` prop needs."""


def build_room(
    rng: np.random.Generator,
    *,
    swept_m: Float[np.ndarray, "points 3"],
    props: tuple[Prop, ...] = (),
    room_size_m: tuple[float, float] | None = None,
    clutter: float = 0.5,
    near_miss_m: float = 0.05,
    meshes: tuple[SceneObject, ...] = (),
    style: str | None = None,
    prop_depth_m: float = MAX_PENETRATION_M,
) -> Room:
    """A furnished room in which the given motion is possible.

    Args:
        rng: Random numbers.
        swept_m: Body points (world) of all people over the whole clip, at most a few centimeters apart.
        props: Objects that the motion needs, which are built exactly there. The note of an object that is picked up
            starts with `ITEM_NOTE` (see `split_items`).
        room_size_m: Width (x) and depth (z); drawn at random, as large as needed, if None.
        clutter: Amount of small objects, 0 (tidy) to 1.
        near_miss_m: Furniture placed near the path on purpose keeps 0.6 to 2 times this distance.
        meshes: External objects to place in the room.
        style: One of `STYLES`; drawn at random if None.
        prop_depth_m: Allowed depth of body points in an object built for a prop, if no design is free of them. The
            limit for all other objects is `MAX_PENETRATION_M`.

    Raises:
        InputError: the clip does not fit in `room_size_m`, a prop cannot be built, or an argument is invalid.
    """
    swept = np.asarray(swept_m, float).reshape(-1, 3)
    if len(swept) == 0 or not np.isfinite(swept).all():
        raise InputError("build_room: want finite body points of the clip, got none or not-a-number")
    if style is not None and style not in STYLES:
        raise InputError(f"unknown room style {style!r}; known are {', '.join(STYLES)}")
    style = STYLES[int(rng.integers(len(STYLES)))] if style is None else style
    palette = draw_palette(rng, style)
    bounds, camera_side = _bounds(rng, _ground(rng, swept, props), room_size_m, style)
    height = max(float(rng.uniform(2.4, 3.2)), float(swept[:, 1].max()) + 0.15)
    plan = Plan(bounds, height, SweepIndex(swept), max(0.01, 0.6 * near_miss_m))
    leaned = _leaned_stretches(props, bounds)
    openings = draw_openings(rng, bounds, height, style, leaned)
    points = PointSet(swept)
    for obj in build_props(props, rng, Site(palette, points, bounds, prop_depth_m)):
        plan.add(obj)
    given = len(plan.placed)
    _keep_free(plan, openings, camera_side)
    lamps_placed = _furnish(Furnisher(plan, rng, palette, clutter), style, meshes, near_miss_m, given)
    lights, ambient, _ = make_lights(rng, palette, plan, openings, lamps_placed)
    stretches = tuple((o.side, o.x0, o.x1) for o in openings)
    pictures = hang_pictures(rng, palette, plan, stretches + leaned, int(rng.integers(1, 5)))
    structure = [*make_shell(rng, palette, bounds, height, openings, leaned), *lay_rugs(rng, palette, plan), *pictures]
    furniture = _without_obstacles([t for t in plan.placed if t.label != "picture"], points, given)
    return _numbered(bounds, height, structure, furniture, lights, ambient)


def split_items(room: Room) -> tuple[Room, dict[int, SceneObject]]:
    """The room without the objects that are picked up, and those objects by the index of their prop."""
    items = {int(t.note[len(ITEM_NOTE) :].split(":")[0]): t for t in room.furniture if t.note.startswith(ITEM_NOTE)}
    return replace(room, furniture=tuple(t for t in room.furniture if not t.note.startswith(ITEM_NOTE))), items


def _ground(rng: np.random.Generator, swept: np.ndarray, props: tuple[Prop, ...]) -> _Ground:
    low, high = swept[:, [0, 2]].min(0) - WALL_GAP_M, swept[:, [0, 2]].max(0) + WALL_GAP_M
    walls: dict[int, float] = {}
    for prop in props:
        if prop.kind == "item":
            continue
        frame = prop_pose(prop)
        if prop.kind == "wall":
            side = _wall_side(prop, swept)
            if side is not None and side not in walls and rng.random() < 0.65:
                walls[side] = prop.position_m[2 if side % 2 == 0 else 0]
                continue
        w, d = prop.size_m
        behind = _BEHIND_M.get(prop.kind, 0.1)
        corners = [frame @ [sx * (w / 2 + 0.1), 0, z, 1] for sx in (-1, 1) for z in (d / 2 + 0.1, -d / 2 - behind)]
        ground = np.array(corners)[:, [0, 2]]
        low, high = np.minimum(low, ground.min(0)), np.maximum(high, ground.max(0))
    for side, at in walls.items():
        axis = 1 if side % 2 == 0 else 0
        (low if side in (0, 3) else high)[axis] = at
    return _Ground(low, high, walls)


def _wall_side(prop: Prop, swept: np.ndarray) -> int | None:
    """Side of the room whose wall can serve a `wall` prop (parallel to an axis, all body points inside), if any."""
    facing = np.array([np.sin(prop.yaw_rad), 0.0, np.cos(prop.yaw_rad)])
    for side, normal in enumerate(((0, 1), (-1, 0), (0, -1), (1, 0))):
        if facing[[0, 2]] @ normal > 1 - 1e-9:
            depth = (swept - prop.position_m) @ facing
            return side if depth.min() > -MAX_PENETRATION_M else None
    return None


def _bounds(
    rng: np.random.Generator, ground: _Ground, room_size_m: tuple[float, float] | None, style: str
) -> tuple[Bounds, int]:
    """The room's rectangle, and the side on which floor is kept free for a camera."""
    extent = ground.high - ground.low
    open_sides = [side for side in range(4) if side not in ground.walls]
    if not open_sides:
        raise InputError("a motion that leans on all four walls leaves no place for a camera; draw the motion again")
    order = [open_sides[int(k)] for k in rng.permutation(len(open_sides))]
    if room_size_m is not None:
        size = np.asarray(room_size_m, float)
        for side in order:
            need = extent + CAMERA_M * np.array([side % 2 == 1, side % 2 == 0])
            if np.all(need <= size + 1e-9):
                return _spread(rng, ground, size - extent, side), side
        more, given = extent + CAMERA_M, f"{size[0]:g} x {size[1]:g} m"
        needed = f"{more[0]:.1f} x {extent[1]:.1f} m or {extent[0]:.1f} x {more[1]:.1f} m"
        raise InputError(
            f"the clip needs a room of {needed} (its path, the objects it uses and {CAMERA_M:g} m for the camera), "
            f"but the size given is {given}; give a larger size or none"
        )
    side = order[0]
    smallest, largest = {
        "living": (4.0, 6.8),
        "bedroom": (3.5, 5.2),
        "dining": (3.6, 6.0),
        "office": (3.6, 7.5),
        "studio": (5.0, 9.0),
    }[style]
    wish = rng.uniform(smallest, largest, 2)
    rooms = rng.uniform(0.3, 1.4, 2)  # for furniture along the walls
    camera = (CAMERA_M + float(rng.uniform(0.1, 0.9))) * np.array([side % 2 == 1, side % 2 == 0])
    size = np.maximum(wish, extent + rooms + camera)
    return _spread(rng, ground, size - extent, side), side


def _spread(rng: np.random.Generator, ground: _Ground, spare: np.ndarray, camera_side: int) -> Bounds:
    """Distribute the spare floor among the sides; the camera's side gets at least `CAMERA_M`."""
    low, high = ground.low.copy(), ground.high.copy()
    for axis, (below, above) in enumerate(((3, 1), (0, 2))):
        if below in ground.walls and above in ground.walls:
            continue
        left = float(spare[axis])
        camera = CAMERA_M if camera_side in (below, above) else 0.0
        share = float(rng.uniform(0.25, 0.75))
        if below in ground.walls or above in ground.walls:
            share = 1.0 if above in ground.walls else 0.0
        first = share * (left - camera)
        first = first + camera if camera_side == below else first
        low[axis] -= first
        high[axis] += left - first
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _leaned_stretches(props: tuple[Prop, ...], bounds: Bounds) -> tuple[tuple[int, float, float], ...]:
    """Parts of walls (side, start, end) that people lean on, where nothing hangs."""
    out = []
    for prop in props:
        side = serving_wall(prop, bounds) if prop.kind == "wall" else None
        if side is not None:
            along = float((np.linalg.inv(wall_frame(bounds, side)) @ [*prop.position_m, 1.0])[0])
            half = max(0.7, prop.size_m[0] / 2 + 0.3)
            out.append((side, along - half, along + half))
    return tuple(out)


def _keep_free(plan: Plan, openings: tuple[Opening, ...], camera_side: int) -> None:
    """Keep free: floor in front of the door, space in front of windows, and a strip from the people to the camera."""
    for o in openings:
        frame = wall_frame(plan.bounds_m, o.side)
        if o.kind == "door":
            plan.keep_free((o.x0 - 0.05, 0.0, 0.0), (o.x1 + 0.05, 2.1, 0.95), frame)
        else:
            reach = 0.3 if o.curtains else 0.1
            plan.keep_free((o.x0 - reach, 0.0 if o.curtains else o.y0, 0.0), (o.x1 + reach, o.y1, 0.14), frame)
            plan.keep_free((o.x0, o.y0 + 0.05, 0.0), (o.x1, o.y1, 0.4), frame)
    x0, x1, z0, z1 = plan.bounds_m
    (sx0, _, sz0), (sx1, _, sz1) = plan.sweep.low, plan.sweep.high
    cx, cz = (sx0 + sx1) / 2, (sz0 + sz1) / 2
    half = 0.8
    low, high = {
        0: ((cx - half, z0), (cx + half, sz0)),
        1: ((sx1, cz - half), (x1, cz + half)),
        2: ((cx - half, sz1), (cx + half, z1)),
        3: ((x0, cz - half), (sx0, cz + half)),
    }[camera_side]
    plan.keep_free((low[0], 0.0, low[1]), (high[0], 2.3, high[1]))


def _furnish(
    f: Furnisher, style: str, meshes: tuple[SceneObject, ...], near_miss_m: float, given: int
) -> list[SceneObject]:
    """Place the style's groups, near misses, external meshes, extras and small objects. Returns the lamps."""
    x0, x1, z0, z1 = f.plan.bounds_m
    area = (x1 - x0) * (z1 - z0)
    ARRANGE[style](f)
    for _ in range(int(f.rng.integers(1, 4))):
        label = _NEAR_LABELS[int(f.rng.integers(len(_NEAR_LABELS)))]
        loose = 0.3 if label in ("chair", "stool", "box", "plant") else 0.02
        f.plan.near_people(f.make(label), f.rng, near_miss_m * f.u(0.6, 2.0), loose_rad=loose)
    for mesh in meshes:
        _ = f.plan.against_wall(mesh, f.rng) or f.plan.anywhere(mesh, f.rng, tries=40)
    if style != "studio" and area > 26:
        more = {"living": "dining", "dining": "living", "bedroom": "living", "office": "dining"}[style]
        ARRANGE[more](f)
    extras(f, given + 5 + int(area / 8))
    dress(f)
    return [obj for obj in f.plan.placed if obj.label == "lamp"]


def _without_obstacles(objects: list[SceneObject], points: PointSet, given: int) -> list[SceneObject]:
    """The objects without those that bodies enter. Objects that are picked up stay: a hand holds them."""
    kept = []
    for number, obj in enumerate(objects):
        exempt = obj.note.startswith(ITEM_NOTE) or number < given
        if exempt or points.max_depth_m(obj) <= MAX_PENETRATION_M:
            kept.append(obj)
    return kept


def _numbered(bounds: Bounds, height: float, structure: list, furniture: list, lights: tuple, ambient: tuple) -> Room:
    """The room with its objects numbered from 1."""
    everything = [replace(obj, object_id=k + 1) for k, obj in enumerate([*structure, *furniture])]
    count = len(structure)
    return Room(bounds, height, tuple(everything[:count]), tuple(everything[count:]), lights, ambient)


__all__ = ["ITEM_NOTE", "STYLES", "build_room", "split_items"]
