"""Solids of furniture that one camera sees."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from seen_boxes import (
    FLOOR,
    LENS,
    SKY,
    Block,
    Shot,
    about_y,
    centres_m,
    looking,
    middle_world_m,
    shoot,
    size_along,
    table,
    yaw_error_rad,
)

from video2anim.geometry.object_solid import ObjectSolid, SolidLimits, object_solid
from video2anim.geometry.projection import backproject, transform_points
from video2anim.geometry.thing_pixels import surface_normals

NOWHERE = np.zeros((LENS.height_px, LENS.width_px), bool)
CAMERA = looking((0.0, 1.6, 0.0), (0.0, 0.5, -3.0))
LOW_CAMERA = looking((0.0, 1.5, 0.0), (0.0, 0.9, -3.0))
"""Below the top of a cabinet."""
CABINET = Block((0.0, 0.9, -3.2), (1.0, 1.8, 0.4))
FRONT_Z_M = -3.0


def solid_of(shot: Shot, own: np.ndarray, hidden: np.ndarray = NOWHERE, **options: float) -> ObjectSolid:
    """The solid of pixels; `hidden` ones are unknown and belong to its outline."""
    found = object_solid(own, hidden, shot.view(own, hidden), SolidLimits(), **options)
    assert found is not None
    assert np.isfinite([found.box.low_m, found.box.high_m]).all()
    assert (found.box.size_m > 0).all()
    return found


def wall_at(z_m: float) -> Block:
    return Block((0.0, 1.5, z_m - 0.05), (12.0, 3.0, 0.1))


def grown(mask: np.ndarray, by_px: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)).astype(bool)


@pytest.mark.parametrize("yaw_deg", [0, 12, 30, 45, 58, 80])
def test_chest_is_a_box_with_its_yaw_size_and_place(yaw_deg: float) -> None:
    """Yaw within 2 degrees; the outline's pixels do not count, which costs up to 10 cm of the far edge."""
    chest = Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), np.deg2rad(yaw_deg))
    shot = shoot([chest], CAMERA)
    found = solid_of(shot, shot.mask(0))
    assert found.method == "box"
    assert yaw_error_rad(found.box, chest.yaw_rad) < np.deg2rad(2)
    np.testing.assert_allclose(size_along(found.box, chest), chest.size_m, atol=0.1)
    np.testing.assert_allclose(middle_world_m(found.box), chest.middle_m, atol=0.06)
    assert found.box.low_m[1] == 0
    towards = found.box.R_world_box.T @ CAMERA[:3, 3] - found.box.high_m
    assert towards[2] > 0, "+z is on the side of the camera"


def test_depth_errors_are_borne() -> None:
    """One percent of noise, and a depth error that says so."""
    chest = Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.6)
    shot = shoot([chest], CAMERA)
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal(shot.depth_m.shape)
    found = solid_of(replace(shot, depth_m=shot.depth_m * noise), shot.mask(0), blur_m=0.03)
    assert found.method.startswith("box")
    assert yaw_error_rad(found.box, chest.yaw_rad) < np.deg2rad(5)
    np.testing.assert_allclose(size_along(found.box, chest), chest.size_m, atol=0.15)


def test_turning_the_room_turns_the_solid() -> None:
    """Nothing depends on the world's directions; 120 degrees are a whole number of tried angles."""
    chest = Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.3)
    angle = np.deg2rad(120)
    T_turn = np.eye(4)
    T_turn[:3, :3] = about_y(angle)
    here, there = shoot([chest], CAMERA), shoot([chest.turned(angle)], T_turn @ CAMERA)
    first, second = solid_of(here, here.mask(0)), solid_of(there, there.mask(0))
    np.testing.assert_allclose(second.box.R_world_box, T_turn[:3, :3] @ first.box.R_world_box, atol=1e-9)
    np.testing.assert_allclose(second.box.low_m, first.box.low_m, atol=1e-6)
    np.testing.assert_allclose(second.box.high_m, first.box.high_m, atol=1e-6)


def table_parts(yaw_rad: float) -> tuple[list[Block], Shot]:
    blocks = table(1.2, 0.74, 0.7, (0.1, -2.6), yaw_rad)
    return blocks, shoot(blocks, looking((0.0, 1.5, 0.0), (0.0, 0.4, -2.6)))


def leg_share(found: ObjectSolid, leg: Block) -> float:
    """Share of the heights, without the ends, at which something solid is within 8 cm of the middle of the leg."""
    at_m = centres_m(found.voxels, found.box)
    x, _, z = leg.middle_m
    near = np.hypot(at_m[..., 0] - x, at_m[..., 2] - z) < 0.08
    heights_m = at_m[0, :, 0, 1]
    solid = np.asarray(np.any(found.voxels.filled & near, axis=(0, 2)))
    return float(solid[(heights_m > 0.05) & (heights_m < 0.6)].mean())


def free_share_around(found: ObjectSolid, leg: Block) -> float:
    """Free share of a ring of 14 to 20 cm about the leg, within the box."""
    at_m = centres_m(found.voxels, found.box)
    x, _, z = leg.middle_m
    away_m = np.hypot(at_m[..., 0] - x, at_m[..., 2] - z)
    return float(1 - found.voxels.filled[(away_m > 0.14) & (away_m < 0.2) & (at_m[..., 1] < 0.55)].mean())


def filled_at(found: ObjectSolid, points_world_m: np.ndarray) -> np.ndarray:
    voxels = found.voxels
    index = np.floor((found.box.to_box(points_world_m) - voxels.origin_m) / voxels.spacing_m).astype(int)
    inside = ((index >= 0) & (index < voxels.filled.shape)).all(1)
    filled = np.zeros(len(index), bool)
    filled[inside] = voxels.filled[tuple(index[inside].T)]
    return filled


@pytest.mark.parametrize("yaw_deg", [0, 20, 50])
def test_table_has_a_top_four_legs_and_free_space_under_it(yaw_deg: float) -> None:
    blocks, shot = table_parts(np.deg2rad(yaw_deg))
    found = solid_of(shot, shot.mask(0, 1, 2, 3, 4))
    assert found.method == "carved, symmetric"
    assert found.voxels.mirrored == ("x", "z")
    assert yaw_error_rad(found.box, np.deg2rad(yaw_deg)) < np.deg2rad(2)
    at_m = centres_m(found.voxels, found.box)
    wood = np.asarray(np.stack([block.holds(at_m, 0.08) for block in blocks]).any(0))
    assert np.mean(found.voxels.filled, where=~wood) < 0.08, "under the top"
    for leg in blocks[1:]:
        assert leg_share(found, leg) == 1
        assert free_share_around(found, leg) > 0.95
    assert found.voxels.filled[blocks[0].holds(at_m)].mean() > 0.9


def test_a_hidden_leg_comes_by_symmetry() -> None:
    """Something unknown stands before a rear leg; in the picture the table's outline there is completed."""
    blocks, shot = table_parts(0.0)
    whole = shot.mask(0, 1, 2, 3, 4)
    rows, columns = np.nonzero(shot.mask(1))
    patch = np.zeros_like(whole)
    patch[rows.min() : rows.max() + 6, columns.min() - 20 : columns.max() + 20] = True
    patch &= ~shot.mask(0, 2)
    own, view = whole & ~patch, shot.view(whole & ~patch, patch)
    found = object_solid(own, whole & patch, view, SolidLimits())
    assert found is not None
    assert found.voxels.mirrored == ("x", "z")
    assert leg_share(found, blocks[1]) == 1
    assert free_share_around(found, blocks[1]) > 0.95, "as around the others"


def test_cabinet_seen_from_the_front_has_an_assumed_thickness() -> None:
    """0.35 times the root of width times height, behind the front that is seen."""
    shot = shoot([CABINET], LOW_CAMERA)
    found = solid_of(shot, shot.mask(0))
    assert found.method == "box, assumed thickness"
    assert found.box.measured.tolist() == [True, True, False]
    assert found.voxels.mirrored == ("x",), "an axis that is not measured is not mirrored"
    assert found.box.size_m[2] == pytest.approx(0.35 * np.sqrt(1.0 * 1.8), abs=0.03)
    assert found.box.high_m[2] == pytest.approx(FRONT_Z_M, abs=0.01)
    np.testing.assert_allclose(found.box.size_m[:2], [1.0, 1.8], atol=0.05)


@pytest.mark.parametrize(("behind_m", "expected"), [(0.4, "to the wall"), (2.0, "assumed thickness")])
def test_cabinet_reaches_to_a_wall_that_is_near(behind_m: float, expected: str) -> None:
    shot = shoot([CABINET, wall_at(FRONT_Z_M - behind_m)], LOW_CAMERA)
    found = solid_of(shot, shot.mask(0))
    assert found.method == f"box, {expected}"
    thickness_m = 0.4 if expected == "to the wall" else 0.35 * np.sqrt(1.8)
    assert found.box.size_m[2] == pytest.approx(thickness_m, abs=0.03)
    assert found.box.high_m[2] == pytest.approx(FRONT_Z_M, abs=0.01)


@pytest.mark.parametrize(("wall_ratio", "expected"), [(1.5, "assumed thickness"), (1.7, "to the wall")])
def test_wall_ratio_says_how_near_the_wall_must_be(wall_ratio: float, expected: str) -> None:
    """0.74 m to the wall is 1.6 times the assumed thickness."""
    shot = shoot([CABINET, wall_at(FRONT_Z_M - 0.74)], LOW_CAMERA)
    own = shot.mask(0)
    found = object_solid(own, NOWHERE, shot.view(own), SolidLimits(wall_ratio=wall_ratio))
    assert found is not None
    assert found.method == f"box, {expected}"


def test_a_flat_thing_on_a_wall_does_not_go_through_the_wall() -> None:
    """A picture 5 cm thick."""
    shot = shoot([Block((0.0, 1.5, -3.975), (0.8, 0.6, 0.05)), wall_at(-4.0)], LOW_CAMERA)
    found = solid_of(shot, shot.mask(0))
    assert found.box.low_m[2] == pytest.approx(-4.0, abs=0.03)


@pytest.mark.parametrize(
    ("limits", "thickness_m"),
    [
        (SolidLimits(thickness_ratio=0.1), 0.2),
        (SolidLimits(thickness_ratio=0.1, thinnest_m=0.05), 0.1 * np.sqrt(1.8)),
        (SolidLimits(thickness_ratio=2.0), 0.8),
        (SolidLimits(thickness_ratio=2.0, thickest_m=0.3), 0.3),
    ],
)
def test_assumed_thickness_keeps_its_limits(limits: SolidLimits, thickness_m: float) -> None:
    shot = shoot([CABINET], LOW_CAMERA)
    found = object_solid(shot.mask(0), NOWHERE, shot.view(shot.mask(0)), limits)
    assert found is not None
    assert found.box.size_m[2] == pytest.approx(thickness_m, abs=0.01)


def test_a_thickness_that_is_seen_is_not_assumed() -> None:
    """The same cabinet turned by 35 degrees shows its side; the wall behind it does not matter."""
    turned = replace(CABINET, yaw_rad=np.deg2rad(35))
    shot = shoot([turned, wall_at(-3.8)], LOW_CAMERA)
    found = solid_of(shot, shot.mask(0))
    assert found.method == "box"
    assert found.box.measured.all()
    np.testing.assert_allclose(size_along(found.box, turned), turned.size_m, atol=0.06)


def test_a_thing_on_a_table_rests_on_the_table() -> None:
    blocks = [*table(1.2, 0.7, 0.7, (0.0, -2.6), 0.3), Block((0.0, 0.85, -2.6), (0.4, 0.3, 0.3), 0.3)]
    shot = shoot(blocks, CAMERA)
    found = solid_of(shot, shot.mask(5))
    assert found.box.low_m[1] == pytest.approx(0.7, abs=0.03)
    assert found.box.high_m[1] == pytest.approx(1.0, abs=0.02)
    under = solid_of(shot, shot.mask(0, 1, 2, 3, 4))
    assert under.box.low_m[1] == 0, "the table stands on the floor, though most of its lower edge is high above it"


@pytest.mark.parametrize("completed", [False, True])
def test_a_thing_whose_lower_end_is_hidden_stands_on_the_floor(completed: bool) -> None:
    """A board one metre before it hides its lower part."""
    chest = Block((0.0, 0.5, -3.0), (1.0, 1.0, 0.5), 0.3)
    shot = shoot([chest, Block((0.0, 0.4, -1.9), (2.4, 0.8, 0.1))], CAMERA)
    own = shot.mask(0)
    assert shot.world_m[own][:, 1].min() > 0.2
    hidden = shoot([chest], CAMERA).mask(0) & ~own if completed else NOWHERE
    found = solid_of(shot, own, hidden)
    assert found.box.low_m[1] == 0
    assert found.box.high_m[1] == pytest.approx(1.0, abs=0.03)


def test_a_bench_close_before_a_chest_does_not_carry_it() -> None:
    """12 cm of free space are between them, and the chest is seen down to below the top of the bench."""
    chest = Block((0.0, 0.5, -3.0), (1.0, 1.0, 0.5))
    bench = Block((0.0, 0.3, -2.58), (2.4, 0.6, 0.1))
    shot = shoot([chest, bench], CAMERA)
    own = shot.mask(0)
    assert shot.world_m[own][:, 1].min() < 0.58
    assert solid_of(shot, own).box.low_m[1] == 0


def test_the_completed_outline_widens_the_box_and_does_not_deepen_it() -> None:
    """A pillar one metre before a cabinet hides its right quarter."""
    shot = shoot([CABINET, Block((0.44, 1.0, -2.0), (0.5, 2.0, 0.1))], LOW_CAMERA)
    own = shot.mask(0)
    hidden = shoot([CABINET], LOW_CAMERA).mask(0) & ~own
    assert hidden.sum() > 0.25 * own.sum()
    alone, whole = solid_of(shot, own), solid_of(shot, own, hidden)
    assert alone.box.size_m[0] < 0.8
    assert whole.box.size_m[0] == pytest.approx(1.0, abs=0.04)
    assert middle_world_m(whole.box)[0] == pytest.approx(0.0, abs=0.03)
    assert whole.box.high_m[2] == pytest.approx(alone.box.high_m[2], abs=1e-9)
    assert filled_at(whole, np.array([[0.4, 0.9, -3.1]])).all(), "behind the pillar it is solid"


@pytest.mark.parametrize("by_px", [1, 2, 3])
def test_a_mask_that_is_too_wide_does_not_stretch_the_box(by_px: int) -> None:
    """The rim lies on a wall 2.5 m behind the chest."""
    chest = Block((0.0, 0.5, -2.6), (1.0, 1.0, 0.5), 0.3)
    shot = shoot([chest, wall_at(-5.0)], CAMERA)
    own = grown(shot.mask(0), by_px) & ~shot.mask(FLOOR)
    assert (own & shot.mask(1)).sum() > 100
    found = solid_of(shot, own)
    np.testing.assert_allclose(size_along(found.box, chest), chest.size_m, atol=0.1)


def test_stray_pixels_on_a_far_wall_do_not_stretch_the_box() -> None:
    """Twelve spots of 5 by 5 pixels: more than the box trims."""
    chest = Block((0.0, 0.5, -2.6), (1.0, 1.0, 0.5), 0.3)
    shot = shoot([chest, wall_at(-5.0)], CAMERA)
    rng = np.random.default_rng(0)
    seeds = np.zeros_like(NOWHERE)
    seeds[tuple(rng.permutation(np.argwhere(shot.mask(1)))[:12].T)] = True
    own = shot.mask(0) | (grown(seeds, 2) & shot.mask(1))
    assert (own & shot.mask(1)).sum() > 0.015 * own.sum()
    found = solid_of(shot, own)
    np.testing.assert_allclose(size_along(found.box, chest), chest.size_m, atol=0.1)


def some_known(count: int) -> tuple[np.ndarray, Shot, np.ndarray]:
    """A chest of which so many pixels have depth."""
    shot = shoot([Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.3)], CAMERA)
    own = shot.mask(0)
    known = np.zeros_like(own)
    known[tuple(np.argwhere(own)[:: own.sum() // count][:count].T)] = True
    assert known.sum() == count
    return own, shot, known


def test_too_few_points_give_nothing() -> None:
    own, shot, known = some_known(29)
    assert object_solid(own, NOWHERE, replace(shot.view(own), known=known), SolidLimits()) is None
    own, shot, known = some_known(400)
    assert object_solid(own, NOWHERE, replace(shot.view(own), known=known), SolidLimits()) is not None
    assert object_solid(NOWHERE, NOWHERE, shot.view(NOWHERE), SolidLimits()) is None


@pytest.mark.parametrize("unknown_m", [np.nan, 0.0, -1.0, 1000.0])
def test_depth_of_unknown_pixels_does_not_matter(unknown_m: float) -> None:
    """The sky, and a hole in the middle of the thing."""
    shot = shoot([replace(CABINET, yaw_rad=0.5)], LOW_CAMERA)
    own = shot.mask(0)
    hole = np.zeros_like(own)
    hole[100:112, 150:170] = True
    assert (hole & own).sum() > 200
    assert shot.mask(SKY).any()
    view = shot.view(own, hole)
    expected = object_solid(own, NOWHERE, view, SolidLimits())
    odd = replace(view, depth_m=np.where(view.known, view.depth_m, unknown_m))
    found = object_solid(own, NOWHERE, odd, SolidLimits())
    assert found is not None
    assert expected is not None
    assert found.method == expected.method
    np.testing.assert_allclose(found.box.low_m, expected.box.low_m, atol=0.02)
    np.testing.assert_allclose(found.box.high_m, expected.box.high_m, atol=0.02)


def test_detail_is_as_asked() -> None:
    shot = shoot([Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.3)], CAMERA)
    own = shot.mask(0)
    for most_along in (12, 25):
        found = object_solid(own, NOWHERE, shot.view(own), SolidLimits(most_along=most_along))
        assert found is not None
        assert max(found.voxels.filled.shape) == most_along


def test_normals_are_unit_and_look_at_the_camera() -> None:
    """Exact inside every face of what is seen."""
    shot = shoot([Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.3), wall_at(-6.0)], CAMERA)
    camera_m = backproject(shot.depth_m, LENS).reshape(-1, 3)
    world_m = transform_points(CAMERA, camera_m).reshape(*shot.depth_m.shape, 3)
    normal = surface_normals(world_m)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-9)
    rim = np.abs(np.diff(shot.normal, axis=0, prepend=0)).sum(-1) + np.abs(np.diff(shot.normal, axis=1, prepend=0)).sum(
        -1
    )
    rim += np.abs(np.diff(shot.shown, axis=0, prepend=9)) + np.abs(np.diff(shot.shown, axis=1, prepend=9))
    inside = ~grown(rim > 0, 2) & ~shot.mask(SKY)
    assert inside.mean() > 0.7
    np.testing.assert_allclose(normal[inside], shot.normal[inside], atol=1e-6)
