"""Where an object lies that a camera above sees: its place, its size, what is under it, and which object it is."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from seen_boxes import FLOOR, LENS, Block, about_y, looking, shoot

from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.geometry.scene_mesh import box_mesh
from video2anim.objects.hands import HandPath
from video2anim.objects.rest import Rest, SceneAtRest
from video2anim.types import InstanceMasks, ObjectInstance, PlacedObject, View

EYE_M = (0.0, 1.6, 0.0)
T_WORLD_CAMERA = looking(EYE_M, (0.0, 0.6, -3.0))
TABLE = Block((0.0, 0.36, -3.0), (1.2, 0.72, 0.8))
Boxes = tuple[tuple[int, int, int, int], ...]


def placed(block: Block, number: int = 1, scale: float = 1.0) -> PlacedObject:
    """A block as an object of the scene."""
    T = np.eye(4)
    T[:3, :3] = block.R_world_block
    T[:3, 3] = np.subtract(block.center_m, (0.0, 0.5 * block.size_m[1], 0.0))
    width_m, height_m, depth_m = (float(value / scale) for value in block.size_m)
    return PlacedObject(number, "table", box_mesh(width_m, height_m, depth_m), scale, T, None, None, True, "")


def scene(blocks: Sequence[Block] = (), T_world_camera: np.ndarray = T_WORLD_CAMERA, scale: float = 1.0) -> SceneAtRest:
    objects = [placed(block, number, scale) for number, block in enumerate(blocks, 1)]
    nothing = np.zeros((LENS.height_px, LENS.width_px), bool)
    return SceneAtRest(objects, InstanceMasks("truth", (), nothing), View(T_world_camera, LENS))


def depth_of(block: Block, T_world_camera: np.ndarray = T_WORLD_CAMERA) -> float:
    """Distance of its middle along the camera's axis: that of a hand that holds it."""
    return float(transform_points(invert_rigid(T_world_camera), np.array([block.center_m]))[0, 2])


def hand_at(depth_m: float) -> HandPath:
    """A hand that is so far away in frame 1."""
    away_m = np.array([9.0, depth_m])
    return HandPath(1, "right hand", np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 2)), away_m, np.ones(2, bool))


def rest_of(
    block: Block, off_m: float = 0.0, others: Sequence[Block] = (), T_world_camera: np.ndarray = T_WORLD_CAMERA
) -> Rest:
    """Where a block is found by its visible pixels and a hand whose distance is wrong by so much."""
    mask = shoot([block, *others], T_world_camera).mask(0)
    found = scene(others, T_world_camera)
    return found.rest(mask, hand_at(depth_of(block, T_world_camera) + off_m), 1)


def apart_m(rest: Rest, block: Block) -> float:
    return float(np.linalg.norm(rest.center_m - block.center_m))


SIZES = [(0.3, 0.3, 0.3), (0.2, 0.4, 0.2), (0.25, 0.2, 0.25)]


@pytest.mark.parametrize("size_m", SIZES)
@pytest.mark.parametrize("eye_m", [(0.0, 1.3, 0.0), EYE_M, (0.0, 2.2, 0.0)])
def test_a_box_on_the_floor_is_found_to_a_few_centimeters(
    size_m: tuple[float, float, float], eye_m: tuple[float, float, float]
) -> None:
    block = Block((0.0, 0.5 * size_m[1], -3.0), size_m)
    T_world_camera = looking(eye_m, (0.0, 0.6, -3.0))
    rest = rest_of(block, T_world_camera=T_world_camera)
    assert apart_m(rest, block) < 0.06
    np.testing.assert_allclose(rest.size_m, size_m, atol=0.05)
    assert rest.T_world_object[1, 3] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(rest.T_world_object[:3, :3], np.eye(3), atol=1e-9, err_msg="its front to the camera")


@pytest.mark.parametrize("at_m", [(0.8, -3.5), (-0.6, -2.5), (0.0, -4.5)])
def test_beside_the_middle_of_the_picture_it_is_little_worse(at_m: tuple[float, float]) -> None:
    """Of a box beside it the camera sees a side, too, which looks as if it were wider."""
    block = Block((at_m[0], 0.15, at_m[1]), (0.3, 0.3, 0.3))
    rest = rest_of(block)
    assert apart_m(rest, block) < 0.1
    np.testing.assert_allclose(rest.size_m, block.size_m, atol=0.1)


@pytest.mark.parametrize("off_m", [-0.3, 0.3])
@pytest.mark.parametrize("size_m", SIZES)
def test_the_floor_is_surer_than_the_hand_s_distance(size_m: tuple[float, float, float], off_m: float) -> None:
    block = Block((0.2, 0.5 * size_m[1], -3.0), size_m)
    rest = rest_of(block, off_m)
    assert apart_m(rest, block) < 0.12
    np.testing.assert_allclose(rest.size_m, size_m, atol=0.08)
    assert rest.T_world_object[1, 3] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("eye_m", [(0.0, 2.2, 0.0), (0.0, 2.8, -0.5)])
def test_nothing_lies_under_the_floor(eye_m: tuple[float, float, float]) -> None:
    """A camera high above, for which a distance that is too large is a place that is too low."""
    block = Block((0.0, 0.1, -3.0), (0.4, 0.2, 0.4))
    rest = rest_of(block, 0.3, T_world_camera=looking(eye_m, (0.0, 0.6, -3.0)))
    assert rest.T_world_object[1, 3] == pytest.approx(0.0, abs=1e-9)
    assert apart_m(rest, block) < 0.12


@pytest.mark.parametrize("yaw_rad", [0.7, -2.0, 3.1])
def test_it_turns_with_the_room(yaw_rad: float) -> None:
    """The whole room turned about the vertical gives the same place in it."""
    block = Block((0.2, 0.15, -3.0), (0.3, 0.3, 0.3))
    turn = np.eye(4)
    turn[:3, :3] = about_y(yaw_rad)
    straight = rest_of(block)
    turned = rest_of(block.turned(yaw_rad), T_world_camera=turn @ T_WORLD_CAMERA)
    np.testing.assert_allclose(turned.T_world_object, turn @ straight.T_world_object, atol=0.02)
    np.testing.assert_allclose(turned.size_m, straight.size_m, atol=0.02)


@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize("off_m", [-0.2, 0.0, 0.2])
def test_on_a_table_the_table_s_height_is_taken(off_m: float, scale: float) -> None:
    cup = Block((0.1, 0.80, -2.9), (0.16, 0.16, 0.16))
    shot = shoot([cup, TABLE], T_WORLD_CAMERA)
    rest = scene([TABLE], scale=scale).rest(shot.mask(0), hand_at(depth_of(cup) + off_m), 1)
    assert rest.T_world_object[1, 3] == pytest.approx(0.72, abs=1e-4)
    assert apart_m(rest, cup) < 0.2, "the line of sight is flat: it says little of the distance"
    if off_m == 0:
        assert apart_m(rest, cup) < 0.06


def test_without_the_table_it_stays_at_the_hand_s_distance() -> None:
    cup = Block((0.1, 0.80, -2.9), (0.16, 0.16, 0.16))
    mask = shoot([cup, TABLE], T_WORLD_CAMERA).mask(0)
    near, far = (scene().rest(mask, hand_at(depth_of(cup) + off_m), 1) for off_m in (0.0, 0.2))
    beside = scene([Block((2.0, 0.36, -3.0), TABLE.size_m)]).rest(mask, hand_at(depth_of(cup)), 1)
    np.testing.assert_array_equal(beside.T_world_object, near.T_world_object)
    assert apart_m(near, cup) < 0.1
    way_m = far.T_world_object[:3, 3] - near.T_world_object[:3, 3]
    assert 0.15 < np.linalg.norm(way_m) < 0.3


def test_of_two_surfaces_the_nearer_is_what_it_lies_on() -> None:
    shelf = Block((0.0, 0.46, -3.0), (1.2, 0.04, 0.8))
    cup = Block((0.0, 0.56, -2.9), (0.16, 0.16, 0.16))
    shot = shoot([cup, shelf], T_WORLD_CAMERA)
    over = Block((0.0, 1.3, -3.0), (1.2, 0.04, 0.8))
    rest = scene([over, shelf]).rest(shot.mask(0), hand_at(depth_of(cup)), 1)
    assert rest.T_world_object[1, 3] == pytest.approx(0.48, abs=1e-4)


def test_lowered_stands_upright_on_what_is_under_it() -> None:
    T = np.eye(4)
    roll = cv2.Rodrigues(np.array([0.0, 0.0, 0.5]))[0]
    T[:3, :3], T[:3, 3] = about_y(0.6) @ roll, (0.2, 0.83, -3.1)
    loose = Rest(T, (0.2, 0.3, 0.2))
    found = scene([TABLE]).lowered(loose)
    np.testing.assert_allclose(found.T_world_object[:3, 3], (0.2, 0.72, -3.1), atol=1e-4)
    np.testing.assert_allclose(found.T_world_object[:3, :3], about_y(0.6), atol=1e-9)
    assert found.size_m == loose.size_m
    held = scene().lowered(loose)
    np.testing.assert_allclose(held.T_world_object[:3, 3], T[:3, 3], err_msg="nothing is near under it")
    T[1, 3] = 0.1
    assert scene().lowered(loose).T_world_object[1, 3] == 0.0
    T[1, 3] = -0.1
    assert scene().lowered(loose).T_world_object[1, 3] == 0.0, "the floor is also above"


def test_the_rest_of_an_object_is_its_box() -> None:
    item = placed(Block((0.4, 0.75, -2.0), (0.6, 0.5, 0.3), 0.4), scale=2.0)
    rest = Rest.of(item)
    np.testing.assert_allclose(rest.size_m, (0.6, 0.5, 0.3), atol=1e-6)
    np.testing.assert_allclose(rest.center_m, (0.4, 0.75, -2.0), atol=1e-6)
    np.testing.assert_array_equal(rest.T_world_object, item.T_world_object)


@pytest.mark.parametrize(
    ("size_m", "alike"),
    [
        ((0.2, 0.3, 0.2), True),
        ((0.38, 0.16, 0.2), True),
        ((0.42, 0.3, 0.2), False),
        ((0.2, 0.14, 0.2), False),
        ((0.2, 0.3, 0.42), False),
    ],
)
def test_boxes_of_about_one_size_are_alike(size_m: tuple[float, float, float], alike: bool) -> None:
    one, other = Rest(np.eye(4), (0.2, 0.3, 0.2)), Rest(np.diag([-1.0, 1.0, -1.0, 1.0]), size_m)
    assert one.alike(other) == other.alike(one) == alike


def with_masks(boxes: Boxes, shrink: int = 1, gone: int = -1) -> SceneAtRest:
    """A scene of objects 1, 2... with rectangular masks: x0, y0, x1, y1.

    Args:
        shrink: The clip is so many times larger than the lens's pictures.
        gone: Has a mask, but is no object.
    """
    instances = []
    for number, (x0, y0, x1, y1) in enumerate(boxes, 1):
        mask = np.zeros((LENS.height_px * shrink, LENS.width_px * shrink), bool)
        mask[y0 * shrink : y1 * shrink, x0 * shrink : x1 * shrink] = True
        instances.append(ObjectInstance(number, "object", 1.0, np.zeros(4), mask))
    objects = [placed(TABLE, number) for number in range(1, len(boxes) + 1) if number != gone]
    floor = np.zeros((LENS.height_px * shrink, LENS.width_px * shrink), bool)
    return SceneAtRest(objects, InstanceMasks("truth", tuple(instances), floor), View(T_WORLD_CAMERA, LENS))


def outline(x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    mask = np.zeros((LENS.height_px, LENS.width_px), bool)
    mask[y0:y1, x0:x1] = True
    return mask


def number_of(item: PlacedObject | None) -> int | None:
    return None if item is None else item.object_id


@pytest.mark.parametrize("shrink", [1, 2, 4])
def test_a_known_object_is_the_one_whose_mask_it_is(shrink: int) -> None:
    found = with_masks(((20, 20, 60, 60), (100, 20, 140, 60)), shrink)
    assert number_of(found.known(outline(20, 20, 60, 60))) == 1
    assert number_of(found.known(outline(104, 24, 142, 58))) == 2
    assert number_of(found.known(outline(100, 20, 120, 60))) == 2, "half of it is seen"
    assert number_of(found.known(outline(44, 20, 84, 60))) == 1, "they share two fifths"
    assert found.known(outline(200, 20, 240, 60)) is None
    assert found.known(outline(50, 20, 90, 60)) is None, "they share a quarter"
    assert found.known(outline(0, 0, 0, 0)) is None


def test_things_on_an_object_three_times_as_large_are_not_that_object() -> None:
    cup = outline(40, 40, 60, 60)
    assert number_of(with_masks(((35, 35, 65, 65),)).known(cup)) == 1, "2.25 times"
    assert with_masks(((35, 35, 75, 75),)).known(cup) is None, "4 times"
    assert with_masks(((40, 30, 60, 90),)).known(cup) is None, "3 times"
    assert number_of(with_masks(((0, 0, 200, 200), (38, 38, 62, 62))).known(cup)) == 2


def test_of_several_objects_the_one_that_shares_most_is_known() -> None:
    found = with_masks(((20, 20, 60, 60), (36, 20, 76, 60)))
    assert number_of(found.known(outline(34, 20, 74, 60))) == 2
    assert number_of(found.known(outline(22, 20, 62, 60))) == 1


def test_what_has_a_mask_and_is_not_in_the_scene_is_not_known() -> None:
    assert with_masks(((20, 20, 60, 60),), gone=1).known(outline(20, 20, 60, 60)) is None


def test_the_floor_of_the_picture_is_where_rays_say() -> None:
    """The helper's own check: rows under a box's mask show the floor."""
    shot = shoot([Block((0.0, 0.15, -3.0), (0.3, 0.3, 0.3))], T_WORLD_CAMERA)
    row = np.nonzero(shot.mask(0))[0].max()
    assert shot.shown[row + 1, LENS.width_px // 2] == FLOOR
