"""Objects from a network and from depth, joined: nothing twice, nothing built, nothing of a room's size."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.objects.depth_regions import Region, RegionLimits
from video2anim.objects.merge import Detection, joined_objects

ROWS, COLUMNS = 60, 100
LIMITS = RegionLimits(min_ratio=0.004, min_m=0.15, max_m=4.0, max_objects=12)
"""0.4 % of 6000 pixels are 24; sizes from 0.15 to 4 m."""


def block(top: int, left: int, height: int, width: int) -> np.ndarray:
    mask = np.zeros((ROWS, COLUMNS), bool)
    mask[top : top + height, left : left + width] = True
    return mask


def wall_of(pixel_m: float) -> np.ndarray:
    """Points of an upright plane 3 m away, its foot in the lowest row."""
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    return np.stack([x * pixel_m, (ROWS - 1 - y) * pixel_m, np.full_like(x, -3.0)], -1)


def region(mask: np.ndarray, score: float = 0.8) -> Region:
    return Region(mask, score, 0.5, 0.5)


def join(
    recognized: list[Detection],
    regions: list[Region],
    *,
    built: np.ndarray | None = None,
    pixel_m: float = 0.02,
    valid: np.ndarray | None = None,
    limits: RegionLimits = LIMITS,
) -> list[Detection]:
    nowhere = np.zeros((ROWS, COLUMNS), bool)
    built = nowhere if built is None else built
    return joined_objects(recognized, regions, built, wall_of(pixel_m), ~nowhere if valid is None else valid, limits)


def found(joined: list[Detection], label: str) -> Detection:
    (one,) = [item for item in joined if item.label == label]
    return one


def test_both_sources_and_neither_twice() -> None:
    """The network sees the chair that depth sees too; the box is seen by depth alone."""
    chair, box = block(30, 10, 20, 15), block(35, 60, 15, 20)
    joined = join([Detection("chair", 0.9, chair)], [region(block(29, 9, 22, 17)), region(box, 0.6)])
    assert len(joined) == 2
    assert np.array_equal(found(joined, "chair").mask, chair)
    assert found(joined, "chair").score == 0.9
    assert np.array_equal(found(joined, "object").mask, box)
    assert 0 < found(joined, "object").score < 0.6, "less sure than depth that a network confirms"


def test_a_region_half_explained_keeps_its_own_part() -> None:
    """40 % of the region is the chair's: what is left is an object of its own. 60 %: it is the chair."""
    chair = block(30, 10, 20, 20)
    partly = join([Detection("chair", 0.9, chair)], [region(block(30, 22, 20, 20))])
    assert np.array_equal(found(partly, "chair").mask, chair)
    assert np.array_equal(found(partly, "object").mask, block(30, 30, 20, 12))
    mostly = join([Detection("chair", 0.9, chair)], [region(block(30, 18, 20, 20))])
    assert [item.label for item in mostly] == ["chair"]


def test_pixels_belong_to_one_thing_the_better_first() -> None:
    """Recognized objects come best first: the second loses the overlap."""
    table, chair = block(30, 10, 20, 30), block(30, 30, 20, 30)
    joined = join([Detection("table", 0.9, table), Detection("chair", 0.6, chair)], [region(block(30, 50, 20, 30))])
    assert np.array_equal(found(joined, "table").mask, table)
    assert np.array_equal(found(joined, "chair").mask, block(30, 40, 20, 20))
    assert np.array_equal(found(joined, "object").mask, block(30, 60, 20, 20))
    assert np.sum([item.mask for item in joined], axis=0).max() == 1


def test_regions_on_walls_and_floor_are_no_objects() -> None:
    """A region is on built parts to 75 % (dropped) or to 50 % (kept whole)."""
    obj = block(30, 10, 20, 20)
    assert join([], [region(obj)], built=block(30, 10, 15, 20)) == []
    (kept,) = join([], [region(obj)], built=block(30, 10, 10, 20))
    assert np.array_equal(kept.mask, obj)


@pytest.mark.parametrize(
    ("pixel_m", "kept"),
    [(0.004, False), (0.02, True), (0.2, True), (0.4, False)],
    ids=["12 cm", "60 cm", "6 m", "12 m"],
)
def test_recognised_things_have_an_objects_size(pixel_m: float, kept: bool) -> None:
    """A block of 30 x 30 pixels on the floor: a network's `shelf` of 12 m is a wall, one of 10 cm a toy."""
    obj = block(30, 10, 30, 30)
    joined = join([Detection("shelf", 0.9, obj)], [], pixel_m=pixel_m)
    assert [item.label for item in joined] == (["shelf"] if kept else [])


def test_a_refused_thing_leaves_its_pixels_to_others() -> None:
    """A `shelf` over the whole wall is refused; the region within it is found."""
    box = block(40, 30, 20, 20)
    joined = join([Detection("shelf", 0.9, block(0, 0, 60, 100))], [region(box)], pixel_m=0.1)
    assert [item.label for item in joined] == ["object"]
    assert np.array_equal(joined[0].mask, box)


def test_unknown_depth_is_no_reason_to_doubt_the_network() -> None:
    """The same object of 12 m, but no pixel of it has depth."""
    obj = block(30, 10, 30, 30)
    joined = join([Detection("mirror", 0.9, obj)], [], pixel_m=0.4, valid=~obj)
    assert [item.label for item in joined] == ["mirror"]


def test_size_is_measured_on_known_pixels() -> None:
    """Pixels without depth hold rubbish; the others say 60 cm."""
    obj = block(30, 10, 30, 30)
    valid, points = ~block(30, 10, 30, 15), wall_of(0.02)
    points[~valid] = 1e6
    nowhere = np.zeros((ROWS, COLUMNS), bool)
    joined = joined_objects([Detection("shelf", 0.9, obj)], [], nowhere, points, valid, LIMITS)
    assert [item.label for item in joined] == ["shelf"]


def test_small_things_are_left_out() -> None:
    """23 pixels are less than 0.4 % of the picture, 24 are not. Both sources."""
    for count, wanted in ((23, 0), (24, 1)):
        mask = block(50, 10, 1, count)
        assert len(join([Detection("cup", 0.9, mask)], [])) == wanted
        assert len(join([], [region(mask)])) == wanted


def test_crumbs_of_a_mask_are_dropped_and_parts_kept() -> None:
    """A table behind a person's leg is two parts of 200 and 100 pixels; 10 pixels elsewhere are none of it."""
    parts, crumb = block(30, 10, 20, 10) | block(30, 25, 10, 10), block(5, 90, 2, 5)
    for joined in (join([Detection("table", 0.9, parts | crumb)], []), join([], [region(parts | crumb)])):
        (only,) = joined
        assert np.array_equal(only.mask, parts)


def test_a_part_farther_away_than_it_is_long_is_another_object() -> None:
    """A board of 400 pixels; a lamp of 20 x 6 pixels 21 rows above it, and the same one 20 rows above it."""
    board = block(30, 10, 20, 20)
    (alone,) = join([Detection("board", 0.9, board | block(4, 10, 6, 20))], [])
    assert np.array_equal(alone.mask, board)
    (both,) = join([Detection("board", 0.9, board | block(5, 10, 6, 20))], [])
    assert np.array_equal(both.mask, board | block(5, 10, 6, 20))


def test_nothing_from_nothing() -> None:
    assert join([], []) == []
    assert join([Detection("chair", 0.9, np.zeros((ROWS, COLUMNS), bool))], []) == []
