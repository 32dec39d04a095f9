"""What one camera and the people show of an object, in rooms of boxes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from furnished import convex, furnished
from seen_boxes import FLOOR, LENS, Block, table

from video2anim.types import CompletedObject

CABINET = Block((0.0, 0.6, -3.0), (0.8, 1.2, 0.5), 0.3)


def outline_px(room_mask: np.ndarray) -> float:
    """Middle column of a mask."""
    return float(np.median(np.nonzero(room_mask)[1]))


def test_depth_times_ray_is_a_point_of_the_thing() -> None:
    evidence = furnished([CABINET]).seen.evidence
    points_m = evidence.camera_m + evidence.rays * evidence.depth_m[:, None]
    known = np.isfinite(evidence.depth_m)
    assert known.sum() > 50
    assert CABINET.holds(points_m[known], 1e-6).all()
    assert not CABINET.holds(points_m[known], -1e-6).any()
    np.testing.assert_allclose(evidence.T_camera_world[:3, :3] @ evidence.camera_m, -evidence.T_camera_world[:3, 3])


def test_outside_grows_with_the_distance_from_the_outline() -> None:
    room = furnished([CABINET])
    own, outside = room.seen.own, room.seen.evidence.outside_px
    assert outside[own].max() <= 1
    row = int(np.median(np.nonzero(own)[0]))
    right = np.flatnonzero(own[row]).max()
    np.testing.assert_allclose(outside[row, right + 1 : right + 30], np.arange(1, 30), atol=1.5)


def test_the_foot_is_within_the_outline() -> None:
    """Depth does not tell the lowest few centimeters from the floor; the mask does."""
    room = furnished([CABINET])
    low = room.seen.own & (room.shot.world_m[..., 1] < 0.05)
    assert low.sum() > 100
    assert room.seen.evidence.outside_px[low].max() <= 1
    box = room.seen.box()
    assert box.low_m[1] == pytest.approx(0, abs=1e-9)
    assert box.high_m[1] == pytest.approx(1.2, abs=0.02)


def test_floor_between_legs_of_a_mask_without_gaps_is_outside() -> None:
    parts = table(1.2, 0.75, 0.7, (0.0, -3.0), 0.4)
    hull = convex(furnished(parts).seen.own)
    room = furnished(parts, own=hull)
    gap = hull & room.shot.mask(FLOOR)
    assert gap.sum() > 300
    assert np.median(room.seen.evidence.outside_px[gap]) > 2
    free_m = room.seen.evidence.free_m
    np.testing.assert_allclose(free_m[gap], room.shot.depth_m[gap])
    assert (free_m[~hull] == 0).all()


@pytest.mark.parametrize("nearer", [True, False])
def test_behind_a_nearer_thing_there_may_be_more_of_it(nearer: bool) -> None:
    """A post before it, or a farther one beside it, of the same place in the picture."""
    shift = -1.0 if nearer else 1.5
    post = Block((0.5, 0.6, -3.0 - shift), (0.3, 1.6, 0.2))
    room = furnished([CABINET], [post])
    of_post = room.shot.mask(1)
    assert of_post.sum() > 500
    outside = room.seen.evidence.outside_px[of_post]
    assert (outside.max() <= 1) if nearer else (outside.max() > 10)


def test_where_people_always_were_there_may_be_more_of_it() -> None:
    unseen = np.zeros((LENS.height_px, LENS.width_px), bool)
    unseen[:, :100] = True
    outside = furnished([CABINET], unseen=unseen).seen.evidence.outside_px
    assert (outside[:, :100] == 0).all()
    assert outside[:, 250:].min() > 20


def test_completed_parts_belong_to_the_outline() -> None:
    """An amodal mask that goes on to the left of what is seen."""
    room = furnished([CABINET])
    whole = room.seen.own.copy()
    rows, columns = np.nonzero(whole)
    whole[rows.min() : rows.max(), columns.min() - 40 : columns.min()] = True
    found = CompletedObject(1, "object", whole, np.zeros((1, 1, 3), np.uint8))
    seen = room.views.object(found, np.random.default_rng(0))
    assert seen is not None
    assert seen.evidence.outside_px[whole].max() <= 1
    np.testing.assert_array_equal(seen.own, room.seen.own)


CHEST = Block((0.0, 0.3, -3.0), (1.4, 0.6, 0.7))


@pytest.mark.parametrize(
    ("obj", "others", "raised"),
    [
        (Block((0.0, 0.75, -3.0), (0.4, 0.3, 0.3)), [CHEST], True),
        (CHEST, [], False),
        (CABINET, [], False),
        # Its lower half is hidden by the chest before it.
        (Block((0.0, 0.6, -3.7), (0.8, 1.2, 0.4)), [CHEST], False),
        # A shelf board on the wall, above nothing.
        (Block((0.3, 1.4, -5.8), (1.0, 0.3, 0.2)), [], True),
    ],
)  # fmt: skip
def test_raised_is_what_ends_above_something_that_is_seen(obj: Block, others: list[Block], raised: bool) -> None:
    seen = furnished([obj], others).seen
    assert seen.evidence.raised == raised
    lowest_m = obj.center_m[1] - 0.5 * obj.size_m[1]
    assert seen.box().low_m[1] == pytest.approx(lowest_m if raised else 0, abs=0.05)


@pytest.mark.parametrize(("gap_px", "raised"), [(0, False), (4, False), (40, True)])
def test_floor_below_a_thing_outweighs_its_depth(gap_px: int, raised: bool) -> None:
    """Its depth is too small, so that it seems to hover. The masks of floor and thing do not quite meet."""
    room = furnished([CABINET])
    near = cv2.dilate(room.seen.own.astype(np.uint8), np.ones((2 * gap_px + 1,) * 2, np.uint8)) > 0
    evidence = furnished([CABINET], depth_factor=0.7, floor=room.shot.mask(FLOOR) & ~near).seen.evidence
    assert evidence.raised == raised


def test_a_thing_cut_by_the_lower_border_is_not_raised() -> None:
    seen = furnished([CABINET], target_m=(0.0, 2.0, -3.0)).seen
    assert seen.own[-1].any()
    assert not seen.evidence.raised


def test_people_count_where_they_are_near() -> None:
    rested_m = np.array([[0.0, 1.25, -3.0], [2.5, 0.5, -3.0], [0.0, 0.5, -1.0]])
    body_m = np.array([[0.0, 1.4, -2.8], [0.0, 1.0, 0.0]])
    evidence = furnished([CABINET], rested_m=rested_m, places=(7, 8, 9), body_m=body_m).seen.evidence
    np.testing.assert_array_equal(evidence.rested.point_m, rested_m[:1])
    np.testing.assert_array_equal(evidence.rested.place, [7])
    np.testing.assert_array_equal(evidence.body_m, body_m[:1])


def test_sigma_of_the_distance_is_that_of_the_object() -> None:
    assert furnished([CABINET], distance_sigma=0.07).seen.evidence.distance_sigma == 0.07
    assert furnished([CABINET], distance_sigma=0.0).seen.evidence.distance_sigma > 0


def test_without_depth_there_is_nothing() -> None:
    room = furnished([CABINET])
    found = CompletedObject(1, "object", room.seen.own, np.zeros((1, 1, 3), np.uint8))
    views = furnished([CABINET], known=~room.seen.own | (np.arange(LENS.width_px) == int(outline_px(room.seen.own))))
    assert views.seen.points_m.shape[0] < room.seen.points_m.shape[0] / 20
    with pytest.raises(AssertionError):
        furnished([CABINET], known=~room.seen.own)
    assert room.views.object(found, np.random.default_rng(0)) is not None


def test_the_front_of_its_box_faces_the_camera() -> None:
    for yaw_rad in (0.0, 0.8, 1.6, 3.0):
        seen = furnished([Block((0.3, 0.6, -3.0), (0.8, 1.2, 0.5), yaw_rad)]).seen
        box = seen.box()
        towards = box.R_world_box.T @ seen.evidence.camera_m - box.center_m
        assert towards[2] > 0.5 * box.size_m[2]
