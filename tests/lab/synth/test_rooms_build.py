"""Rooms around a motion: free way, nothing through anything, props exactly in place."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.errors import InputError
from video2anim.lab.synth.rooms import STYLES, build_room, make_furniture, penetration_m, split_items
from video2anim.lab.synth.rooms.making import pose
from video2anim.lab.synth.rooms.placing import Boxes, overlap
from video2anim.lab.synth.rooms.structure import RUG_M
from video2anim.lab.synth.world import LABELS, Prop, Room


def walk(seed: int, frames: int = 240) -> np.ndarray:
    """Body-sized cloud along a bent path."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, frames)[:, None]
    start, bend, stop = rng.uniform(-1.8, 1.8, (3, 2))
    path = (1 - t) ** 2 * start + 2 * t * (1 - t) * bend + t**2 * stop
    shell = rng.normal(size=(frames, 300, 3))
    shell *= np.array([0.25, 0.85, 0.2]) / np.linalg.norm(shell, axis=2, keepdims=True)
    shell += np.stack([path[:, 0], np.full(frames, 0.86), path[:, 1]], 1)[:, None]
    return shell.reshape(-1, 3)


def still(x: float = 0.0, z: float = 0.0, low: float = 0.0) -> np.ndarray:
    """Somebody who stands there."""
    rng = np.random.default_rng(0)
    return np.array([x, 0.0, z]) + rng.uniform([-0.2, low, -0.2], [0.2, 1.7, 0.2], (4000, 3))


@pytest.fixture(scope="module")
def rooms() -> list[tuple[np.ndarray, Room]]:
    made = []
    for seed in range(10):
        swept = walk(seed)
        made.append((swept, build_room(np.random.default_rng(seed), swept_m=swept, style=STYLES[seed % len(STYLES)])))
    return made


def test_nobody_goes_through_anything(rooms):
    for swept, room in rooms:
        solid = [obj for obj in room.objects if obj.label not in ("floor", "rug")]
        assert penetration_m(solid, swept).max() <= 0.002


def test_objects_do_not_intersect_and_stay_in_the_room(rooms):
    for _, room in rooms:
        x0, x1, z0, z1 = room.bounds_m
        boxes = [Boxes.of(obj) for obj in room.furniture]
        for k, a in enumerate(boxes):
            corners = a.corners_xz()
            assert corners[:, 0].min() >= x0
            assert corners[:, 0].max() <= x1
            assert corners[:, 1].min() >= z0
            assert corners[:, 1].max() <= z1
            for j in range(k):
                assert not overlap(a, boxes[j]), (room.furniture[k].note, room.furniture[j].note)


def test_enough_furniture_numbers_labels_and_lights(rooms):
    for _, room in rooms:
        numbers = [obj.object_id for obj in room.objects]
        assert numbers == list(range(1, len(numbers) + 1))
        assert all(obj.label in LABELS for obj in room.objects)
        assert sum(bool(obj.surfaces) or obj.label in ("plant", "lamp") for obj in room.furniture) >= 4
        labels = [obj.label for obj in room.structure]
        assert [labels.count(label) for label in ("floor", "ceiling", "wall", "door")] == [1, 1, 4, 1]
        assert 2.4 <= room.height_m <= 3.3
        assert room.lights
        assert min(room.ambient_rgb) > 0


def test_rooms_leave_ground_for_a_camera(rooms):
    for swept, room in rooms:
        x0, x1, z0, z1 = room.bounds_m
        low, high = swept.min(0), swept.max(0)
        free = [low[0] - x0, x1 - high[0], low[2] - z0, z1 - high[2]]
        assert max(free) >= 2.0
        assert min(free) >= 0.1


def test_some_furniture_is_close_to_the_path(rooms):
    near = 0
    for swept, room in rooms:
        for obj in room.furniture:
            grown = [0.0, *np.arange(0.01, 0.13, 0.02)]
            boxes = Boxes.of(obj)
            local = (swept[::6] - obj.T_world_object[:3, 3]) @ obj.T_world_object[:3, :3]
            gaps = []
            for low, high in zip(boxes.low_m, boxes.high_m, strict=True):
                gaps.append(np.abs(local - np.clip(local, low, high)).max(1).min())
            assert min(gaps) >= 0.02 or "ceiling" in obj.note, obj.note
            near += min(gaps) < grown[-1]
    assert near >= 8


def test_lights_render_gray_walls_gray(rooms):
    """Irradiance on a wall, shadows aside, is near pi, which shows a matt surface in its own color."""
    for _, room in rooms:
        x0, x1, z0, z1 = room.bounds_m
        spots = np.stack([np.linspace(x0 + 0.5, x1 - 0.5, 9), np.full(9, 1.2), np.full(9, z0)], 1)
        total = np.full(9, np.mean(room.ambient_rgb))
        for light in room.lights:
            place = np.asarray(light.position_m)
            inside = x0 < place[0] < x1 and z0 < place[2] < z1
            if light.direction is None and inside:
                way = place - spots
                total += np.mean(light.rgb) * np.maximum(way[:, 2], 0) / np.linalg.norm(way, axis=1) ** 3
        assert 0.35 * np.pi < total.mean() < 1.8 * np.pi


def test_rugs_are_thin(rooms):
    rugs = [obj for _, room in rooms for obj in room.structure if obj.label == "rug"]
    assert rugs
    assert max(obj.merged()[0][:, 1].max() for obj in rugs) <= RUG_M + 1e-9 <= 0.005


def test_same_seed_gives_the_same_bytes():
    def data(seed: int) -> list:
        room = build_room(np.random.default_rng(seed), swept_m=walk(1))
        return [
            (obj.label, obj.T_world_object.tobytes(), [(p.vertices_m.tobytes(), p.material) for p in obj.parts])
            for obj in room.objects
        ] + [room.lights, room.ambient_rgb]

    assert data(5) == data(5)
    assert data(5) != data(6)


def test_room_of_a_given_size():
    room = build_room(np.random.default_rng(0), swept_m=still(), room_size_m=(4.0, 3.5))
    x0, x1, z0, z1 = room.bounds_m
    assert (x1 - x0, z1 - z0) == pytest.approx((4.0, 3.5))
    with pytest.raises(InputError, match=r"the clip needs a room of .* but the size given is 2 x 2 m") as caught:
        build_room(np.random.default_rng(0), swept_m=walk(0), room_size_m=(2.0, 2.0))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("swept", [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_no_body_points_are_an_error(swept):
    with pytest.raises(InputError, match="finite body points"):
        build_room(np.random.default_rng(0), swept_m=swept)


def test_unknown_style():
    with pytest.raises(InputError, match="unknown room style 'cave'"):
        build_room(np.random.default_rng(0), swept_m=still(), style="cave")


def _prop(kind: str, height: float, size: tuple[float, float], yaw: float = 0.6, back: bool = False) -> Prop:
    return Prop(kind, (0.3, height, -0.2), yaw, size, (10, 60), back)


@pytest.mark.parametrize(
    ("prop", "labels"),
    [
        (_prop("seat", 0.447, (0.4, 0.4)), {"chair", "armchair", "sofa", "stool"}),
        (_prop("bed", 0.5, (2.1, 0.9)), {"bed"}),
        (_prop("bed", 0.5, (0.9, 2.1)), {"bed"}),
        (_prop("table", 0.4, (0.5, 0.3)), {"table", "cabinet", "box"}),
        (_prop("table", 0.74, (0.5, 0.3)), {"table", "desk", "cabinet"}),
        (_prop("table", 1.45, (0.4, 0.26)), {"shelf", "cabinet"}),
        (_prop("step", 0.24, (0.7, 0.5)), {"step"}),
    ],
)
def test_props_are_built_to_measure(prop, labels):
    """A ray straight down onto the spot, and onto the corners of the rectangle, meets the surface at its height."""
    person = np.concatenate([still(2.5, 2.5), np.array([[0.3, 1.9, -0.2]])])
    for seed in range(2):
        room = build_room(np.random.default_rng(seed), swept_m=person, props=(prop,), clutter=1.0)
        (obj,) = [t for t in room.furniture if t.note.startswith("prop 0")]
        assert obj.label in labels
        T = pose(prop.position_m[0], prop.position_m[2], prop.yaw_rad)
        w, d = 0.3 * prop.size_m[0], 0.3 * prop.size_m[1]  # edges are rounded, and a stool may be round
        for x, z in ((0, 0), (w, d), (-w, d), (w, -d), (-w, -d)):
            at = (T @ [x, prop.position_m[1], z, 1])[:3]
            depth = penetration_m([obj], at + np.array([[0, -0.002, 0], [0, 0.002, 0]]))
            assert depth[0] == pytest.approx(0.002, abs=1e-4), obj.note
            assert depth[1] == 0.0, obj.note


def test_wall_prop_along_an_axis_may_become_a_wall_of_the_room():
    """Somebody whose back is 2 mm before the plane z = -0.3."""
    person = still(0.0, 0.0)
    person[:, 2] += -0.298 - person[:, 2].min()
    prop = Prop("wall", (0.0, 1.3, -0.3), 0.0, (0.9, 0.1), (10, 60))
    served = set()
    for seed in range(8):
        room = build_room(np.random.default_rng(seed), swept_m=person, props=(prop,))
        assert penetration_m([t for t in room.objects if t.label not in ("floor", "rug")], person).max() <= 0.002
        behind = np.array([[0.0, 1.3, -0.31], [0.3, 1.0, -0.31], [-0.3, 1.6, -0.31]])
        free = np.array([[0.0, 1.3, -0.299]])
        assert penetration_m(room.objects, behind).min() > 0.009
        assert penetration_m(room.objects, free).max() == 0.0
        served.add("room" if room.bounds_m[2] == -0.3 else "thing")
    assert served == {"room", "thing"}


def test_item_lies_on_a_stand_and_can_be_taken_out():
    item = Prop("item", (1.0, 0.42, 0.5), 0.3, (0.12, 0.12), (20, 90))
    room = build_room(np.random.default_rng(1), swept_m=still(), props=(item,))
    static, items = split_items(room)
    assert list(items) == [0]
    vertices, _ = items[0].merged()
    assert vertices[:, 1].min() == pytest.approx(0.42, abs=1e-9)
    assert np.ptp(vertices, axis=0)[[0, 2]].max() < 0.25
    assert len(static.furniture) == len(room.furniture) - 1
    below = np.array([[1.0, 0.419, 0.5]])
    assert penetration_m(static.furniture, below)[0] > 0.0005


def test_item_on_a_table_prop_gets_no_stand_of_its_own():
    table = Prop("table", (1.0, 0.42, 0.5), 0.3, (0.5, 0.4), (20, 90))
    item = Prop("item", (1.0, 0.42, 0.55), 0.3, (0.12, 0.12), (20, 90))
    room = build_room(np.random.default_rng(1), swept_m=still(), props=(table, item))
    assert sum(t.note.startswith("prop ") for t in room.furniture) == 1


def test_impossible_prop_is_reported_in_one_line():
    prop = Prop("seat", (0.0, 0.45, 0.0), 0.0, (0.4, 0.4), (0, 10))
    with pytest.raises(InputError, match=r"no seat of 0.40 x 0.40 m fits at .* cm deep") as caught:
        build_room(np.random.default_rng(0), swept_m=still(), props=(prop,))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="unknown kind of prop 'rope'"):
        build_room(np.random.default_rng(0), swept_m=still(2, 2), props=(Prop("rope", (0, 1, 0), 0, (1, 1), (0, 1)),))


def test_external_meshes_stand_in_the_room():
    obj = make_furniture("armchair", np.random.default_rng(3))
    room = build_room(np.random.default_rng(0), swept_m=still(), meshes=(obj,), room_size_m=(7.0, 7.0))
    assert any(t.parts is obj.parts for t in room.furniture)


@pytest.mark.parametrize("end", [-1, 1])
def test_headboard_stands_at_the_head(end):
    """Lying body along x: most of its points in the upper half; the board rises beyond that end."""
    rng = np.random.default_rng(0)
    trunk = rng.uniform([0.0, 0.5, -0.3], [0.8, 0.75, 0.3], (3000, 3)) * [end, 1, 1]
    legs = rng.uniform([-0.9, 0.5, -0.15], [0.0, 0.65, 0.15], (1000, 3)) * [end, 1, 1]
    bed = Prop("bed", (0.0, 0.498, 0.0), 0.0, (2.1, 0.9), (0, 50))
    room = build_room(np.random.default_rng(2), swept_m=np.concatenate([trunk, legs]), props=(bed,))
    (obj,) = [t for t in room.furniture if t.note.startswith("prop 0")]
    vertices, _ = obj.merged()
    high = vertices[vertices[:, 1] > 0.6]
    assert (np.sign(high[:, 0]) == end).all()
    assert np.abs(high[:, 0]).min() > 1.04
