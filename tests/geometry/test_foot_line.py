"""Distance from where things meet the floor, in rooms of boxes seen by a pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from seen_boxes import FLOOR, LENS, SKY, Block, looking, shoot, table

from video2anim.geometry.foot_line import floor_factor

EYE_M = (0.0, 1.6, 0.0)


def factor(
    blocks: Sequence[Block],
    wrong: float = 1.0,
    *,
    own: Sequence[int] | None = None,
    looks_at: tuple[float, float, float] = (0.0, 0.5, 3.0),
    roll_rad: float = 0.0,
    floor_seen: bool = True,
) -> float:
    """The factor for blocks (all, or some of them) whose depth is `wrong` times what it should be."""
    T_world_camera = looking(EYE_M, looks_at)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    T_world_camera[:3, :3] = T_world_camera[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    shot = shoot(blocks, T_world_camera)
    mask = shot.mask(*(range(len(blocks)) if own is None else own))
    assert mask.any()
    depth_m = np.where(mask, wrong * shot.depth_m, shot.depth_m)
    floor = shot.mask(FLOOR) if floor_seen else np.zeros_like(mask)
    return floor_factor(mask, depth_m, shot.shown != SKY, floor, T_world_camera, LENS)


def crate(distance_m: float, x_m: float = 0.0, yaw_rad: float = 0.0) -> Block:
    return Block((x_m, 0.3, distance_m), (0.6, 0.6, 0.6), yaw_rad)


@pytest.mark.parametrize("distance_m", [2.0, 3.0])
@pytest.mark.parametrize(("yaw_rad", "roll_rad"), [(0.0, 0.0), (0.5, 0.0), (0.5, 0.2)])
def test_near_things_are_brought_back(distance_m: float, yaw_rad: float, roll_rad: float) -> None:
    """Too far by 25 %: within 5 % after. Too near by 20 %: within 11 %, of which 8 % are the dead zone upward."""
    blocks, at = [crate(distance_m, yaw_rad=yaw_rad)], (0.0, 0.5, distance_m)
    assert 0.99 < 1.25 * factor(blocks, 1.25, looks_at=at, roll_rad=roll_rad) < 1.05
    assert 0.89 < 0.8 * factor(blocks, 0.8, looks_at=at, roll_rad=roll_rad) < 1.0


@pytest.mark.parametrize("distance_m", [2.0, 4.0, 9.0])
@pytest.mark.parametrize(("yaw_rad", "roll_rad"), [(0.0, 0.0), (0.5, 0.0), (0.5, 0.2)])
def test_true_depth_stays(distance_m: float, yaw_rad: float, roll_rad: float) -> None:
    blocks, at = [crate(distance_m, yaw_rad=yaw_rad)], (0.0, 0.5, distance_m)
    assert factor(blocks, looks_at=at, roll_rad=roll_rad) == pytest.approx(1.0, abs=0.005)


def test_a_little_too_near_is_left_alone_but_a_little_too_far_is_not() -> None:
    """A lower edge that is off the floor looks like depth that is too near, never like depth that is too far."""
    assert factor([crate(3.0)], 0.95) == 1.0
    assert factor([crate(3.0)], 1.05) == pytest.approx(1 / 1.05, abs=0.01)


@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_the_farther_the_less_the_feet_count(wrong: float) -> None:
    """Gravity's error moves the floor under far things by metres: there depth knows better."""
    found = [abs(np.log(factor([crate(d)], wrong, looks_at=(0.0, 0.5, d)))) for d in (2.0, 4.0, 8.0, 14.0)]
    assert found == sorted(found, reverse=True)
    assert found[0] > 2.5 * found[-1]
    assert found[-1] < 0.04


@pytest.mark.parametrize("wrong", [0.8, 1.0, 1.25])
def test_things_without_floor_below_stay(wrong: float) -> None:
    """On a table, behind a low wall, and where no floor was found at all."""
    chest = Block((0.0, 0.3, 3.0), (1.2, 0.6, 0.8))
    on_it = Block((0.0, 0.8, 3.0), (0.4, 0.4, 0.4))
    assert factor([chest, on_it], wrong, own=[1]) == 1.0
    low_wall = Block((0.0, 0.25, 2.2), (3.0, 0.5, 0.1))
    assert factor([low_wall, Block((0.0, 0.6, 3.2), (0.6, 1.2, 0.6))], wrong, own=[1]) == 1.0
    assert factor([crate(3.0)], wrong, floor_seen=False) == 1.0


def test_a_thing_whose_feet_are_mostly_hidden_stays() -> None:
    """A tenth of a cupboard's columns ends on the floor, then half of them."""
    cupboard = Block((0.0, 0.5, 3.0), (1.2, 1.0, 0.5))
    for left_m, brought_back in ((-0.45, False), (0.0, True)):
        right_m = 1.2
        hides = Block((0.5 * (left_m + right_m), 0.2, 2.3), (right_m - left_m, 0.4, 0.1))
        found = factor([cupboard, hides], 1.25, own=[0])
        assert (found == 1.0) != brought_back
        assert 1.25 * found < 1.06 or not brought_back


@pytest.mark.parametrize("x_m", [-1.6, 1.6])
def test_a_thing_cut_by_the_border_is_never_moved_away(x_m: float) -> None:
    """Its feet may lie outside the picture; feet that are seen too near still bring it nearer."""
    at = (0.0, 0.5, 3.0)
    assert shoot([crate(3.0, x_m)], looking(EYE_M, at)).mask(0)[:, [0, -1]].any()
    assert factor([crate(3.0, x_m)], 0.8, looks_at=at) == 1.0
    assert 1.25 * factor([crate(3.0, x_m)], 1.25, looks_at=at) < 1.06
    assert factor([crate(3.0, 0.5 * x_m)], 0.8, looks_at=at) > 1.1, "the same thing wholly in the picture"


def test_a_thing_cut_by_the_lower_border_stays() -> None:
    at = (0.0, 1.0, 3.0)
    mask = shoot([crate(2.0)], looking(EYE_M, at)).mask(0)
    assert mask[-1].sum() == mask.any(0).sum(), "every column is cut"
    for wrong in (0.8, 1.25):
        assert factor([crate(2.0)], wrong, looks_at=at) == 1.0


def test_a_thing_cut_by_the_upper_border_stands_on_its_feet() -> None:
    wardrobe = [Block((0.0, 1.5, 3.0), (0.8, 3.0, 0.6))]
    assert shoot(wardrobe, looking(EYE_M, (0.0, 0.5, 3.0))).mask(0)[0].any()
    assert factor(wardrobe, 0.8) > 1.1
    assert 1.25 * factor(wardrobe, 1.25) < 1.06


@pytest.mark.parametrize("yaw_rad", [0.0, 0.3])
def test_legs_decide_for_a_table(yaw_rad: float) -> None:
    """Between the legs it ends at its top's lower edge, under which floor is seen that is far behind."""
    blocks = table(1.4, 0.75, 0.8, (0.0, 3.0), yaw_rad)
    assert factor(blocks) == pytest.approx(1.0, abs=0.005)
    assert 0.99 < 1.25 * factor(blocks, 1.25) < 1.1
    assert 0.87 < 0.8 * factor(blocks, 0.8) < 1.0
    assert factor(blocks, own=[0]) > 1.2, "without its legs it seems to be far behind"


def test_nothing_known_is_nothing_moved() -> None:
    T_world_camera = looking(EYE_M, (0.0, 0.5, 3.0))
    shot = shoot([crate(3.0)], T_world_camera)
    own, none = shot.mask(0), np.zeros_like(shot.mask(0))
    for mask, known in ((own, none), (none, ~none)):
        assert floor_factor(mask, 1.25 * shot.depth_m, known, shot.mask(FLOOR), T_world_camera, LENS) == 1.0
