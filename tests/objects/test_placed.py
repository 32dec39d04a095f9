"""Raised objects come to rest on what is below them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from video2anim.objects.placed import put_down
from video2anim.types import Mesh, PlacedObject

TABLE_TOP_M = 0.75
Size = tuple[float, float, float]


def standing(object_id: int, *parts: tuple[Size, Size], at_m: Size = (0.0, 0.0, 0.0)) -> PlacedObject:
    """An object of boxes: size, and center of the lower side, from its place."""
    boxes = []
    for size_m, low_m in parts:
        box = trimesh.creation.box(size_m)
        box.apply_translation((low_m[0], low_m[1] + 0.5 * size_m[1], low_m[2]))
        boxes.append(box)
    shape = trimesh.util.concatenate(boxes)
    mesh = Mesh(np.asarray(shape.vertices), np.asarray(shape.faces), np.zeros((len(shape.vertices), 3), np.uint8))
    T_world_object = np.eye(4)
    T_world_object[:3, 3] = at_m
    return PlacedObject(object_id, "object", mesh, 1.0, T_world_object, None, None, True, "fitted as box")


def table(object_id: int = 1) -> PlacedObject:
    """2.4 m long, 1 m deep, hollow below its top."""
    legs = [((0.1, 0.65, 0.1), (a * 1.15, 0.0, b * 0.45)) for a in (-1, 1) for b in (-1, 1)]
    return standing(object_id, ((2.4, 0.1, 1.0), (0.0, 0.65, 0.0)), *legs)


def vase(low_m: float, x_m: float = 0.4, object_id: int = 2) -> PlacedObject:
    return standing(object_id, ((0.15, 0.3, 0.15), (0.0, 0.0, 0.0)), at_m=(x_m, low_m, 0.1))


def raised_by_m(before: PlacedObject, after: PlacedObject) -> float:
    """How far it was moved up; it is moved no other way."""
    moved_m = after.T_world_object - before.T_world_object
    assert np.count_nonzero(moved_m) <= 1
    return float(moved_m[1, 3])


@pytest.mark.parametrize("low_m", [0.55, 0.7, 0.75, 0.8, 0.95])
def test_a_raised_vase_is_put_on_the_table_under_it(low_m: float) -> None:
    """Sunk into the top or hovering over it by up to 0.2 m; a table that is farther away is not meant."""
    away = standing(3, ((1.0, 0.8, 1.0), (0.0, 0.0, 0.0)), at_m=(5.0, 0.0, 0.0))
    before = [away, vase(low_m), table()]
    after = put_down(before)
    assert raised_by_m(before[1], after[1]) == pytest.approx(TABLE_TOP_M - low_m, abs=1e-6)
    assert after[1].reason == "fitted as box; rests on object 1"
    assert after[0] is away
    assert after[2] is before[2]


def test_the_highest_surface_under_a_vase_carries_it() -> None:
    tray = standing(3, ((0.6, 0.06, 0.4), (0.4, TABLE_TOP_M + 0.001, 0.1)))
    flower = vase(0.85)
    _, found, _ = put_down([table(), flower, tray])
    assert raised_by_m(flower, found) == pytest.approx(-0.039, abs=1e-6)
    assert found.reason.endswith("rests on object 3")


@pytest.mark.parametrize(("low_m", "x_m"), [(0.8, 3.0), (1.3, -0.4), (0.8, 1.29), (TABLE_TOP_M - 0.28, 0.4)])
def test_a_raised_thing_with_nothing_under_it_stays(low_m: float, x_m: float) -> None:
    """Beside the table, far above it, beside its edge, and too deep in its top."""
    lamp = vase(low_m, x_m)
    assert put_down([table(), lamp])[1] is lamp


def test_a_corner_over_a_corner_is_not_enough() -> None:
    box = standing(2, ((0.6, 0.2, 0.6), (0.0, 0.0, 0.0)), at_m=(-1.32, 0.8, -0.62))
    assert put_down([table(), box])[1] is box


def test_only_raised_things_are_put_down() -> None:
    """What stands on the floor is not lifted onto a table that it was pushed into."""
    crate = standing(2, ((0.4, 0.6, 0.4), (0.0, 0.0, 0.0)), at_m=(0.4, 0.0, 0.1))
    assert put_down([table(), crate])[1] is crate


def test_a_stack_is_put_down_from_below() -> None:
    crate = standing(3, ((0.4, 0.3, 0.4), (0.0, 0.0, 0.0)), at_m=(0.4, 0.65, 0.1))
    before = [table(), crate, vase(0.95)]
    _, below, above = put_down(before)
    assert [raised_by_m(one, two) for one, two in zip(before[1:], (below, above), strict=True)] == pytest.approx(
        [0.1, 0.1]
    )
    assert above.reason.endswith("rests on object 3")
