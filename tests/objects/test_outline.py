"""An object cut out of its detector's box."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.objects.outline import outlined

SIZE = (180, 240)
SQUARE = (slice(60, 120), slice(90, 150))
BOX_PX = np.array([88.0, 58.0, 152.0, 122.0])


def picture(rgb: tuple[int, int, int] = (200, 60, 40)) -> np.ndarray:
    """A square of one color before a brown, slightly noisy ground."""
    noise = np.random.default_rng(0).normal(0, 4, (*SIZE, 3))
    image = np.array([120, 110, 100]) + noise
    image[SQUARE] = np.array(rgb) + noise[SQUARE]
    return np.clip(image, 0, 255).astype(np.uint8)


def flat_m() -> np.ndarray:
    return np.full(SIZE, 3.0)


def truth() -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[SQUARE] = True
    return mask


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def test_a_colored_square_is_cut_out() -> None:
    found = outlined(picture(), flat_m(), np.zeros(SIZE, bool), BOX_PX)
    assert found.shape == SIZE
    assert iou(found, truth()) > 0.93


def test_a_loose_box_is_cut_down_to_the_square() -> None:
    found = outlined(picture(), flat_m(), np.zeros(SIZE, bool), np.array([78.0, 50.0, 166.0, 135.0]))
    assert iou(found, truth()) > 0.9


@pytest.mark.parametrize("shrink", [1, 2, 3])
def test_depth_tells_a_thing_of_the_color_of_the_ground(shrink: int) -> None:
    """Depth may be smaller than the picture."""
    depth_m = np.where(truth(), 2.0, 3.5)[::shrink, ::shrink]
    found = outlined(picture((120, 110, 100)), depth_m, np.zeros(depth_m.shape, bool), BOX_PX)
    assert iou(found, truth()) > 0.85


def test_the_floor_in_the_box_is_left_out() -> None:
    """The lower half of the box shows a floor that is known, of a color of its own that the surroundings lack."""
    image, floor = picture(), np.zeros(SIZE, bool)
    floor[92:130, 80:160] = True
    image[floor] = np.clip(image[floor].astype(int) * 0 + [70, 130, 160], 0, 255)
    upper = truth() & ~floor
    found = outlined(image, flat_m(), floor, BOX_PX)
    assert iou(found, upper) > 0.85


def test_sizes_of_picture_and_box_go_together() -> None:
    """The same picture, four times as large."""
    large = picture().repeat(4, 0).repeat(4, 1)
    found = outlined(large, flat_m(), np.zeros(SIZE, bool), 4 * BOX_PX)
    assert found.shape == (4 * SIZE[0], 4 * SIZE[1])
    assert iou(found[2::4, 2::4], truth()) > 0.9


def test_nothing_is_outside_the_surroundings_of_the_box() -> None:
    """A second square of the color of the first, farther away, is another object."""
    image = picture()
    image[10:40, 200:235] = (200, 60, 40)
    found = outlined(image, flat_m(), np.zeros(SIZE, bool), BOX_PX)
    assert not found[:, 180:].any()


def test_it_is_the_same_every_time() -> None:
    one, other = (outlined(picture(), flat_m(), np.zeros(SIZE, bool), BOX_PX) for _ in range(2))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "box",
    [
        (50, 50, 50, 50), (50, 50, 51, 120), (80, 80, 60, 60), (-90, -80, -10, -20), (300, 200, 400, 260),
        (0, 0, 240, 180), (-500, -500, 900, 900), (239, 60, 300, 120),
    ],
    ids=["point", "line", "turned", "left of it", "right of it", "whole", "beyond", "at the border"],
)  # fmt: skip
def test_boxes_without_a_thing_or_surroundings_give_an_empty_mask(box: tuple[int, ...]) -> None:
    found = outlined(picture(), flat_m(), np.zeros(SIZE, bool), np.array(box, float))
    assert found.shape == SIZE
    assert not found.any()


def test_a_box_over_the_border_is_cut_there() -> None:
    image = picture()
    image[60:120, 200:] = (200, 60, 40)
    found = outlined(image, flat_m(), np.zeros(SIZE, bool), np.array([198.0, 58.0, 260.0, 122.0]))
    wanted = np.zeros(SIZE, bool)
    wanted[60:120, 200:] = True
    assert iou(found, wanted) > 0.9


def test_a_box_full_of_floor_is_empty() -> None:
    assert not outlined(picture(), flat_m(), np.ones(SIZE, bool), BOX_PX).any()


def test_depth_without_differences_does_no_harm() -> None:
    for depth_m in (np.full(SIZE, 0.0), np.full(SIZE, 1e3)):
        assert iou(outlined(picture(), depth_m, np.zeros(SIZE, bool), BOX_PX), truth()) > 0.9
