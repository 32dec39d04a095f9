"""Solids from what one camera sees to be free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from seen_boxes import LENS, SKY, Block, Shot, centres_m, looking, shoot, table

from video2anim.geometry.carving import ObjectView, Voxels, carve
from video2anim.geometry.upright_box import UprightBox

SHAPE = (LENS.height_px, LENS.width_px)
NOWHERE = np.zeros(SHAPE, bool)
EVERYWHERE = np.ones(SHAPE, bool)
LEVEL = looking((0.0, 0.5, 3.0), (0.0, 0.5, 0.0))
"""3 m before the middle of the unit box, at its height."""
UNIT = UprightBox(np.eye(3), np.array([-0.5, 0.0, -0.5]), np.array([0.5, 1.0, 0.5]), np.ones(3, bool))


def flat_view(depth_m: float, *, known: np.ndarray = EVERYWHERE, own: np.ndarray = NOWHERE) -> ObjectView:
    """A plane across the view of the level camera."""
    return ObjectView(np.full(SHAPE, depth_m), known, own, NOWHERE, LEVEL, LENS)


def unmeasured(box: UprightBox, *axes: int) -> UprightBox:
    measured = np.ones(3, bool)
    measured[list(axes)] = False
    return replace(box, measured=measured)


def true_box(block: Block) -> UprightBox:
    middle_m = np.array(block.middle_m) @ block.R_world_block
    half = 0.5 * np.array(block.size_m)
    return UprightBox(block.R_world_block, middle_m - half, middle_m + half, np.ones(3, bool))


def filled_share(voxels: Voxels, where: np.ndarray) -> float:
    assert where.any()
    return float(voxels.filled[where].mean())


@pytest.mark.parametrize("most_along", [10, 33])
def test_cubes_cover_the_box_from_its_lower_end_up(most_along: int) -> None:
    """Along the longest side there are as many as asked; in x and z they lie about the middle of the box."""
    low, high = np.array([-0.7, 0.2, 1.0]), np.array([0.5, 0.95, 1.25])
    voxels = carve(UprightBox(np.eye(3), low, high, np.ones(3, bool)), flat_view(9, known=NOWHERE), np.zeros((0, 3)),
                   most_along=most_along)  # fmt: skip
    assert voxels.spacing_m == pytest.approx(1.2 / most_along)
    count = np.array(voxels.filled.shape)
    assert count[0] == most_along
    end = voxels.origin_m + voxels.spacing_m * count
    assert (voxels.origin_m <= low + 1e-9).all()
    assert (end >= high - 1e-9).all()
    assert (end - voxels.origin_m < high - low + voxels.spacing_m).all()
    assert voxels.origin_m[1] == pytest.approx(0.2)
    np.testing.assert_allclose((voxels.origin_m + end)[[0, 2]], (low + high)[[0, 2]], atol=1e-9)
    assert voxels.surface.shape == voxels.filled.shape


def test_cubes_are_never_smaller_than_a_centimetre() -> None:
    small = UprightBox(np.eye(3), np.zeros(3), np.array([0.1, 0.05, 0.02]), np.ones(3, bool))
    voxels = carve(small, flat_view(9, known=NOWHERE), np.zeros((0, 3)))
    assert voxels.spacing_m == pytest.approx(0.01)
    assert voxels.filled.shape == (10, 5, 2)


@pytest.mark.parametrize(
    "case", ["depth unknown", "behind the camera", "outside the picture", "hidden by a near thing"]
)
def test_what_is_not_seen_to_be_free_is_solid(case: str) -> None:
    view = flat_view(9.0)
    if case == "depth unknown":
        view = flat_view(9.0, known=NOWHERE)
    elif case == "behind the camera":
        view = replace(view, T_world_camera=looking((0.0, 0.5, 3.0), (0.0, 0.5, 9.0)))
    elif case == "outside the picture":
        view = replace(view, T_world_camera=looking((0.0, 0.5, 3.0), (9.0, 0.5, 1.0)))
    else:
        view = flat_view(1.0)
    assert carve(UNIT, view, np.zeros((0, 3)), most_along=13).filled.all()


def test_before_a_far_wall_only_cubes_with_seen_points_stay() -> None:
    points_m = np.array([[0.02, 0.33, 0.41], [0.03, 0.34, 0.42], [0.12, 0.33, 0.41], [4.0, 0.3, 0.3]])
    voxels = carve(unmeasured(UNIT, 0, 2), flat_view(9.0), points_m, most_along=10)
    np.testing.assert_array_equal(np.argwhere(voxels.surface), [[5, 3, 9], [6, 3, 9]])
    np.testing.assert_array_equal(voxels.filled, voxels.surface)


def test_points_on_the_bounds_of_the_box_have_cubes() -> None:
    """The front of a thing that is longest in depth lies exactly on the box's bound."""
    grid = np.linspace(-0.45, 0.45, 10)
    front = np.stack(np.meshgrid(grid, grid + 0.5, [0.5], indexing="ij"), -1).reshape(-1, 3)
    voxels = carve(UNIT, flat_view(9.0), front, most_along=10)
    assert voxels.surface[:, :, -1].all()


def test_own_surface_bounds_what_is_free() -> None:
    """A front in the middle of the box, 3 m away: before it free, within a cube of it and behind it solid."""
    voxels = carve(unmeasured(UNIT, 0, 2), flat_view(3.0, own=EVERYWHERE), np.zeros((0, 3)), most_along=20)
    z = centres_m(voxels, UNIT)[..., 2]
    assert filled_share(voxels, z < 0.04) == 1
    assert filled_share(voxels, z > 0.06) == 0


def test_nothing_nearer_to_the_own_surface_than_the_error_of_depth_is_free() -> None:
    voxels = carve(unmeasured(UNIT, 0, 2), flat_view(3.0, own=EVERYWHERE), np.zeros((0, 3)), most_along=20, blur_m=0.2)
    z = centres_m(voxels, UNIT)[..., 2]
    assert filled_share(voxels, z < 0.2) == 1
    assert filled_share(voxels, z > 0.3) == 0


def test_before_seen_floor_all_is_free_however_near() -> None:
    """A camera that looks straight at the floor through the box; without the word `floor` the lowest cubes stay."""
    down = looking((0.0, 3.0, 0.01), (0.0, 0.0, 0.0))
    shot = shoot([], down)
    box = unmeasured(UNIT, 0, 2)
    view = shot.view(NOWHERE)
    assert not carve(box, view, np.zeros((0, 3)), most_along=20, blur_m=0.2).filled.any()
    untold = carve(box, replace(view, floor=NOWHERE), np.zeros((0, 3)), most_along=20, blur_m=0.2)
    assert untold.filled[:, 0].all()
    assert not untold.filled[:, 10:].any()


def left_known() -> np.ndarray:
    return np.arange(LENS.width_px) * np.ones(SHAPE) < LENS.cx_px


@pytest.mark.parametrize("x_is_measured", [True, False])
def test_what_is_free_on_the_left_is_free_on_the_right_of_a_measured_axis(x_is_measured: bool) -> None:
    """A post in the middle of the box; the right half of the picture is unknown."""
    post = np.array([[x, y, 0.0] for x in (-0.02, 0.02) for y in np.arange(0.025, 1, 0.05)])
    box = unmeasured(UNIT, 2) if x_is_measured else unmeasured(UNIT, 0, 2)
    voxels = carve(box, flat_view(9.0, known=left_known()), post, most_along=20)
    x = centres_m(voxels, box)[..., 0]
    assert voxels.mirrored == (("x",) if x_is_measured else ())
    assert filled_share(voxels, x < -0.06) == 0
    assert filled_share(voxels, x > 0.06) == (0 if x_is_measured else 1)
    assert voxels.filled[voxels.surface].all()


def test_a_thing_whose_mirror_image_is_seen_to_be_free_is_not_symmetric() -> None:
    """The back of a chair at one end of its box: at the other end nothing stands."""
    chair = [Block((0.0, 0.22, -2.5), (0.5, 0.44, 0.5)), Block((0.0, 0.7, -2.72), (0.5, 0.52, 0.06))]
    shot = shoot(chair, looking((0.9, 1.5, 0.0), (0.0, 0.4, -2.5)))
    own = shot.mask(0, 1)
    box = true_box(Block((0.0, 0.48, -2.5), (0.5, 0.96, 0.5)))
    voxels = carve(box, shot.view(own), shot.world_m[own])
    assert voxels.mirrored == ("x",)
    y, z = np.moveaxis(centres_m(voxels, box)[..., 1:], -1, 0)
    assert filled_share(voxels, (y > 0.5) & (y < 0.9) & (z > -2.6)) == 0
    assert filled_share(voxels, (y > 0.5) & (y < 0.9) & (z < -2.7)) == 1


def table_shot(yaw_rad: float) -> tuple[list[Block], Shot]:
    blocks = table(1.2, 0.74, 0.7, (0.1, -2.6), yaw_rad)
    return blocks, shoot(blocks, looking((0.0, 1.5, 0.0), (0.0, 0.4, -2.6)))


def table_box(blocks: list[Block]) -> UprightBox:
    top = blocks[0]
    x, _, z = top.middle_m
    return true_box(Block((x, 0.37, z), (top.size_m[0], 0.74, top.size_m[2]), top.yaw_rad))


@pytest.mark.parametrize("yaw_deg", [0, 25, 50])
def test_table_keeps_top_and_legs_and_the_space_under_it_is_free(yaw_deg: float) -> None:
    blocks, shot = table_shot(np.deg2rad(yaw_deg))
    box, own = table_box(blocks), shot.mask(0, 1, 2, 3, 4)
    voxels = carve(box, shot.view(own), shot.world_m[own])
    at_m = centres_m(voxels, box)
    wood = np.any([block.holds(at_m) for block in blocks], axis=0)
    near_wood = np.any([block.holds(at_m, 2.5 * voxels.spacing_m) for block in blocks], axis=0)
    assert filled_share(voxels, wood) > 0.97
    assert filled_share(voxels, ~near_wood) < 0.08, "what the top's edge and the legs hide on both sides stays"
    assert voxels.mirrored == ("x", "z")


def test_what_hides_a_leg_leaves_it_and_symmetry_frees_the_space_around_it() -> None:
    """One rear leg and all around it is unknown: without symmetry a block of solid stands there."""
    blocks, shot = table_shot(0.0)
    box, own = table_box(blocks), shot.mask(0, 1, 2, 3, 4)
    rows, columns = np.nonzero(shot.mask(1))
    hidden = np.zeros(SHAPE, bool)
    hidden[rows.min() : rows.max() + 8, columns.min() - 25 : columns.max() + 25] = True
    hidden &= ~shot.mask(0, 2)
    own &= ~hidden
    assert not (own & shot.mask(1)).any()
    view, points_m = shot.view(own, hidden), shot.world_m[own]
    symmetric, alone = carve(box, view, points_m), carve(unmeasured(box, 0, 2), view, points_m)
    at_m = centres_m(symmetric, box)
    leg = blocks[1]
    around = leg.holds(at_m, 0.15) & ~leg.holds(at_m, 0.06) & (at_m[..., 1] < 0.55)
    assert filled_share(symmetric, leg.holds(at_m)) > 0.97
    assert filled_share(alone, around) > 0.4
    assert filled_share(symmetric, around) < 0.02


def test_pieces_apart_from_the_seen_surface_are_left_out() -> None:
    """A post that is seen, and beyond free space a column behind unknown pixels."""
    column = np.arange(LENS.width_px) * np.ones(SHAPE)
    known = ~((column > LENS.cx_px + 25) & (column < LENS.cx_px + 45))
    post = np.array([[-0.3, y, 0.0] for y in np.arange(0.025, 1, 0.05)])
    voxels = carve(unmeasured(UNIT, 0, 2), flat_view(9.0, known=known), post, most_along=20)
    np.testing.assert_array_equal(voxels.filled, voxels.surface)
    without_surface = carve(unmeasured(UNIT, 0, 2), flat_view(9.0, known=known), np.zeros((0, 3)), most_along=20)
    assert without_surface.filled.any(), "with no seen surface to choose by, every piece stays"


def test_two_seen_parts_both_stay() -> None:
    """The lower part holds a quarter of the points of the upper one; a single stray point holds too few."""
    upper = np.array([[x, 0.83, z] for x in np.arange(-0.4, 0.4, 0.05) for z in np.arange(-0.4, 0.4, 0.05)])
    lower = np.array([[x, 0.23, z] for x in np.arange(-0.2, 0.2, 0.05) for z in np.arange(-0.2, 0.2, 0.05)])
    stray = np.array([[0.33, 0.5, 0.33]])
    voxels = carve(unmeasured(UNIT, 0, 2), flat_view(9.0), np.concatenate([upper, lower, stray]), most_along=20)
    assert np.flatnonzero(voxels.filled.any((0, 2))).tolist() == [4, 16]


def test_sky_is_unknown() -> None:
    """Nothing is behind the box in the picture: its upper part, seen against the sky, stays."""
    shot = shoot([], looking((0.0, 0.5, 3.0), (0.0, 0.5, 0.0)))
    voxels = carve(unmeasured(UNIT, 0, 2), shot.view(NOWHERE), np.zeros((0, 3)), most_along=20)
    assert (shot.shown == SKY).any()
    assert voxels.filled[:, 10:].all()
    assert not voxels.filled[:, 1:9].any()
