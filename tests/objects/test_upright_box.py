"""Upright boxes around the points that one camera sees."""

from __future__ import annotations

import numpy as np
import pytest
from seen_boxes import Block, about_y, looking, middle_world_m, shoot, size_along, yaw_error_rad

from video2anim.objects.upright_box import UprightBox, box_at, fit_upright_box, turned_to

CAMERA = looking((0.0, 1.6, 0.0), (0.0, 0.5, -3.0))
GRID_RAD = np.deg2rad(1.5)
"""Sixty turns are tried in a quarter circle."""


def seen(block: Block) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the block's pixels."""
    shot = shoot([block], CAMERA)
    return shot.world_m[shot.mask(0)], shot.normal[shot.mask(0)]


def some_box(measured: tuple[bool, bool, bool] = (True, True, True)) -> UprightBox:
    return UprightBox(about_y(0.4), np.array([-0.6, 0.0, -0.2]), np.array([0.6, 0.8, 0.3]), np.array(measured))


def world_corners(box: UprightBox) -> np.ndarray:
    """The eight corners in the world, in an order that does not depend on the axes."""
    picks = np.stack(np.meshgrid(*[(0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    corners = np.stack([box.low_m, box.high_m])[picks, np.arange(3)] @ box.R_world_box.T
    return corners[np.lexsort(np.round(corners, 6).T)]


@pytest.mark.parametrize("yaw_deg", [0, 7, 22, 37, 45, 61, 83, 118, -30])
def test_box_seen_from_above_is_found_with_its_yaw_size_and_middle(yaw_deg: float) -> None:
    """Yaw within a step of the grid; the trimmed rim costs up to 5 cm of the size and 3 cm of the middle."""
    block = Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), np.deg2rad(yaw_deg))
    box = fit_upright_box(*seen(block))
    assert yaw_error_rad(box, block.yaw_rad) < GRID_RAD
    np.testing.assert_allclose(size_along(box, block), block.size_m, atol=0.05)
    np.testing.assert_allclose(middle_world_m(box), block.center_m, atol=0.03)
    assert box.measured.all(), "front, side and top are seen"


def test_frame_is_a_rotation_about_up() -> None:
    box = fit_upright_box(*seen(Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.5)))
    np.testing.assert_allclose(box.R_world_box @ box.R_world_box.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(box.R_world_box) == pytest.approx(1.0)
    np.testing.assert_array_equal(box.R_world_box[:, 1], [0, 1, 0])


@pytest.mark.parametrize("steps", [1, 17, 44])
def test_turning_and_moving_the_room_turns_and_moves_the_box(steps: int) -> None:
    """By a whole number of tried angles, the result is the same up to a quarter turn."""
    points_m, normals = seen(Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.3))
    before = fit_upright_box(points_m, normals)
    turn, move_m = about_y(steps * GRID_RAD), np.array([2.0, 0.3, -1.0])
    after = fit_upright_box(points_m @ turn.T + move_m, normals @ turn.T)
    assert yaw_error_rad(after, 0.3 + steps * GRID_RAD) == pytest.approx(yaw_error_rad(before, 0.3), abs=1e-9)
    expected = world_corners(before) @ turn.T + move_m
    for corner in world_corners(after):
        assert np.linalg.norm(expected - corner, axis=-1).min() < 1e-6
    assert after.size_m.prod() == pytest.approx(before.size_m.prod())


def test_one_face_alone_gives_the_yaw_but_not_the_thickness() -> None:
    rng = np.random.default_rng(0)
    along, up = rng.uniform(-0.5, 0.5, 2000), rng.uniform(0, 1.8, 2000)
    points_m = np.stack([along, up, np.zeros(2000)], -1) @ about_y(0.35).T
    box = fit_upright_box(points_m, np.tile(about_y(0.35)[:, 2], (2000, 1)))
    assert yaw_error_rad(box, 0.35) < GRID_RAD
    across = int(np.argmin(box.size_m))
    assert across in (0, 2)
    assert not box.measured[across]
    assert box.measured.sum() == 2
    assert box.size_m[across] < 0.03


def test_a_top_alone_does_not_measure_the_height() -> None:
    rng = np.random.default_rng(0)
    points_m = np.stack([rng.uniform(-0.8, 0.8, 2000), np.full(2000, 0.7), rng.uniform(-0.3, 0.3, 2000)], -1)
    box = fit_upright_box(points_m @ about_y(0.35).T, np.tile([0.0, 1.0, 0.0], (2000, 1)))
    assert box.measured.tolist() == [True, False, True]
    assert yaw_error_rad(box, 0.35) < GRID_RAD, "without upright faces the smallest footprint says the yaw"


@pytest.mark.parametrize(("side_points", "is_measured"), [(120, False), (240, True)])
def test_an_axis_needs_a_share_of_the_points_to_be_measured(side_points: int, is_measured: bool) -> None:
    """6 % and 12 % of the points lie on the side; the limit is 8 %."""
    rng = np.random.default_rng(0)
    front = np.stack([rng.uniform(-0.5, 0.5, 2000), rng.uniform(0, 1, 2000), np.zeros(2000)], -1)[side_points:]
    side = np.stack([np.full(2000, 0.5), rng.uniform(0, 1, 2000), rng.uniform(-0.4, 0, 2000)], -1)[:side_points]
    normals = np.repeat([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], [len(front), len(side)], axis=0)
    box = box_at(0.0, np.concatenate([front, side]), normals)
    assert box.measured.tolist() == [True, True, is_measured]


def test_faces_decide_where_the_footprint_does_not() -> None:
    """A disc of points has no direction; its faces look along 20 degrees and at right angles to that."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 6000), np.sqrt(rng.uniform(0, 1, 6000))
    points_m = np.stack([radius * np.cos(angle), rng.uniform(0, 1, 6000), radius * np.sin(angle)], -1)
    headings = np.deg2rad(20) + rng.integers(0, 4, 6000) * np.pi / 2
    normals = np.stack([np.sin(headings), np.zeros(6000), np.cos(headings)], -1)
    assert yaw_error_rad(fit_upright_box(points_m, normals), np.deg2rad(20)) < 2 * GRID_RAD


def test_a_few_outermost_points_do_not_stretch_the_box() -> None:
    """0.4 % of the points lie 3 m behind; half a percent on each side is left out."""
    block = Block((0.2, 0.4, -3.0), (1.2, 0.8, 0.5), 0.4)
    points_m, normals = seen(block)
    far = np.linspace(0, len(points_m) - 1, len(points_m) // 250).astype(int)
    points_m[far] += [0.0, 0.0, -3.0]
    box = fit_upright_box(points_m, normals)
    np.testing.assert_allclose(size_along(box, block), block.size_m, atol=0.06)


def test_no_points_are_refused_and_one_point_is_a_finite_box() -> None:
    with pytest.raises(ValueError, match="at least one point"):
        fit_upright_box(np.zeros((0, 3)), np.zeros((0, 3)))
    box = fit_upright_box(np.array([[1.0, 0.5, -2.0]]), np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(middle_world_m(box), [1.0, 0.5, -2.0], atol=1e-12)
    np.testing.assert_allclose(box.size_m, 0, atol=1e-12)


@pytest.mark.parametrize("around_deg", range(0, 360, 40))
def test_z_is_turned_to_the_camera_and_the_box_stays_where_it_is(around_deg: float) -> None:
    box = some_box()
    eye_m = middle_world_m(box) + 4.0 * np.array([np.sin(np.deg2rad(around_deg)), 0.3, np.cos(np.deg2rad(around_deg))])
    turned = turned_to(box, eye_m)
    np.testing.assert_allclose(world_corners(turned), world_corners(box), atol=1e-9)
    np.testing.assert_allclose(turned.R_world_box @ turned.R_world_box.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned.R_world_box) == pytest.approx(1.0)
    np.testing.assert_array_equal(turned.R_world_box[:, 1], [0, 1, 0])
    beyond_m = eye_m @ turned.R_world_box - turned.center_m
    assert beyond_m[2] > 0
    assert beyond_m[2] - 0.5 * turned.size_m[2] >= abs(beyond_m[0]) - 0.5 * turned.size_m[0] - 1e-9


def test_a_wide_thing_faces_the_camera_with_its_front() -> None:
    """The camera is farther to the right than ahead of the middle, but beyond the side by 0.5 m, the front by 1.3 m."""
    box = UprightBox(np.eye(3), np.array([-1.5, 0, -0.2]), np.array([1.5, 1, 0.2]), np.ones(3, bool))
    turned = turned_to(box, np.array([2.0, 1.0, 1.5]))
    np.testing.assert_allclose(turned.R_world_box, np.eye(3), atol=1e-12)


def test_what_is_measured_turns_with_the_axes() -> None:
    box = some_box(measured=(False, True, True))
    sideways = turned_to(box, middle_world_m(box) + 5 * box.R_world_box[:, 0])
    assert sideways.measured.tolist() == [True, True, False]
    ahead = turned_to(box, middle_world_m(box) - 5 * box.R_world_box[:, 2])
    assert ahead.measured.tolist() == [False, True, True]


def test_other_bounds() -> None:
    box = some_box(measured=(False, True, True))
    grown = box.with_bounds(box.low_m - 0.1, box.high_m + 0.3)
    np.testing.assert_allclose(grown.size_m, box.size_m + 0.4)
    np.testing.assert_array_equal(grown.R_world_box, box.R_world_box)
    assert grown.measured.tolist() == [False, True, True]
