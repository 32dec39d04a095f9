"""Rugs, pictures and the objects that lie on furniture and on the floor."""

from __future__ import annotations

import numpy as np

from video2anim.lab.synth.rooms.decor import make_clutter
from video2anim.lab.synth.rooms.groups import Furnisher
from video2anim.lab.synth.rooms.making import Maker, pose
from video2anim.lab.synth.rooms.materials import Palette
from video2anim.lab.synth.rooms.placing import Boxes, Plan, wall_frame, wall_length
from video2anim.lab.synth.rooms.primitives import moved
from video2anim.lab.synth.rooms.structure import make_picture, make_rug
from video2anim.lab.synth.world import SceneObject

_ON_TOP = {
    "table": ("book", "cup", "vase", "cup", "toy"),
    "desk": ("book", "cup", "book"),
    "cabinet": ("vase", "book", "toy"),
    "shelf": ("vase", "book", "toy"),
    "box": ("book", "toy"),
}


def dress(f: Furnisher) -> None:
    """Place objects on table tops, cushions on seats, some objects on the floor; more for a larger `clutter`."""
    for base in list(f.plan.placed):
        if base.label in _ON_TOP and "prop" not in base.note and _height(base) < 1.7:
            _on_surface(f, base, _ON_TOP[base.label])
        if base.label in ("sofa", "armchair", "bed") and "prop" not in base.note:
            _cushions(f, base)
    for _ in range(f.rng.poisson(2.5 * f.clutter)):
        label = str(f.rng.choice(["toy", "bag", "book", "toy"]))
        f.plan.anywhere(make_clutter(label, f.rng, f.palette), f.rng, tries=8)


def _height(obj: SceneObject) -> float:
    return float(Boxes.of(obj).high_m[:, 1].max())


def _on_surface(f: Furnisher, base: SceneObject, labels: tuple[str, ...]) -> None:
    s = base.surfaces[-1 if base.label == "shelf" else 0]
    for _ in range(f.rng.poisson(3.0 * f.clutter * min(1.5, s.size_m[0]))):
        obj = make_clutter(labels[int(f.rng.integers(len(labels)))], f.rng, f.palette)
        boxes = Boxes.of(obj)
        half = np.abs(np.concatenate([boxes.low_m, boxes.high_m])[:, [0, 2]]).max(0)
        room = np.array(s.size_m) / 2 - np.hypot(*half)
        if room.min() <= 0.0:
            continue
        x, z = f.rng.uniform(-room, room)
        T = base.T_world_object @ pose(s.center_m[0] + x, s.center_m[1] + z, f.u(-3.1, 3.1), s.height_m)
        f.plan.try_at(obj, T, apart_m=0.01, ignore_free=True)


def _cushions(f: Furnisher, base: SceneObject) -> None:
    """Cushions that lean on the back of a seat, or lie on a bed."""
    s = base.surfaces[0]
    for _ in range(f.rng.poisson(2.0 * f.clutter * min(1.5, s.size_m[0]))):
        cushion = make_clutter("cushion", f.rng, f.palette)
        if base.label != "bed":
            cushion = _stood(cushion, f.u(1.15, 1.35))
        whole = Boxes.of(cushion).whole()
        half_x, half_z = whole.high_m[0, 0], whole.high_m[0, 2]
        room = s.size_m[0] / 2 - half_x - 0.02
        if room < 0 or base.label == "bed":
            continue
        x, z = f.u(-room, room), -s.size_m[1] / 2 + half_z + 0.01
        T = base.T_world_object @ pose(s.center_m[0] + x, s.center_m[1] + z, f.u(-0.1, 0.1), s.height_m)
        f.plan.try_at(cushion, T, apart_m=0.0, ignore_free=True)


def _stood(obj: SceneObject, lean_rad: float) -> SceneObject:
    """The cushion standing on its edge, leaning back."""
    m = Maker(np.random.default_rng(0))
    for part in obj.parts:
        m.add(moved((part.vertices_m, part.faces), pitch=lean_rad), part.material, part.smooth)
    return m.done(obj.label, obj.note)


def hang_pictures(
    rng: np.random.Generator, palette: Palette, plan: Plan, avoid: tuple[tuple[int, float, float], ...], count: int
) -> list[SceneObject]:
    """Up to `count` pictures at eye height on free parts of the walls."""
    out: list[SceneObject] = []
    for _ in range(4 * count):
        if len(out) >= count:
            break
        w, h = float(rng.uniform(0.25, 1.0)), float(rng.uniform(0.3, 0.8))
        side = int(rng.integers(4))
        room = wall_length(plan.bounds_m, side) / 2 - w / 2 - 0.15
        if room < 0:
            continue
        x = float(rng.uniform(-room, room))
        if any(s == side and a < x + w / 2 + 0.1 and b > x - w / 2 - 0.1 for s, a, b in avoid):
            continue
        center = float(rng.uniform(1.45, 1.65))
        picture = make_picture(rng, palette, (w, h))
        T = wall_frame(plan.bounds_m, side) @ pose(x, 0.0005, 0.0, center - h / 2)
        if plan.fits(Boxes.of(picture).at(T), apart_m=0.04, clear_m=0.04, ignore_free=True):
            placed = picture.moved(T)
            plan.add(placed)
            out.append(placed)
    return out


def lay_rugs(rng: np.random.Generator, palette: Palette, plan: Plan) -> list[SceneObject]:
    """A rug in front of the sofa, under the dining table or beside the bed; else sometimes in the room's center."""
    x0, x1, z0, z1 = plan.bounds_m
    anchors = [obj for obj in plan.placed if obj.label in ("sofa", "bed", "table") and "prop" not in obj.note]
    size = (float(rng.uniform(1.6, 2.6)), float(rng.uniform(1.2, 1.9)))
    if anchors and rng.random() < 0.75:
        anchor = anchors[0]
        ahead = {"sofa": 1.1, "bed": 0.3, "table": 0.0}[anchor.label]
        T = anchor.T_world_object @ pose(0.0, ahead, 0.0)
    elif rng.random() < 0.35:
        T = pose((x0 + x1) / 2, (z0 + z1) / 2, float(rng.choice([0.0, np.pi / 2])))
    else:
        return []
    yaw = float(np.arctan2(T[0, 2], T[2, 2]))
    rug = make_rug(rng, palette, size, float(T[0, 3]), float(T[2, 3]), yaw)
    corners = Boxes.of(rug).corners_xz()
    shift = np.maximum(0, [x0 + 0.03, z0 + 0.03] - corners.min(0)) - np.maximum(
        0, corners.max(0) - [x1 - 0.03, z1 - 0.03]
    )
    if np.any(np.ptp(corners, axis=0) > [x1 - x0 - 0.06, z1 - z0 - 0.06]):
        return []
    T = rug.T_world_object.copy()
    T[[0, 2], 3] += shift
    return [rug.moved(T)]
