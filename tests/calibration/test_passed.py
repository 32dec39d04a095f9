"""Who is seen before a thing is nearer than the thing."""

from __future__ import annotations

import numpy as np
import pytest
from walk_scene import walk

from video2anim.geometry.behind_people import Passed, factor_behind, passed_before
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.types import BodyMotion

FRAMES, SIZE = 12, (90, 120)
"""Rows and columns of the masks."""


def lens_of(body: BodyMotion):
    return body.intrinsics.resized(SIZE[1], SIZE[0])


def all_seen() -> np.ndarray:
    return np.ones((FRAMES, *SIZE), bool)


def test_depth_is_that_of_the_body() -> None:
    body = walk(FRAMES)
    passed = passed_before(body, np.arange(FRAMES), all_seen(), lens_of(body))
    pelvis_m = transform_points(invert_rigid(body.T_world_camera[0]), body.joints_world_m[:, 0].astype(float))
    at = project(pelvis_m, lens_of(body)).round().astype(int)
    found_m = passed.depth_m[at[:, 1], at[:, 0]]
    told = found_m > 0
    assert told.sum() >= 6
    # Its near side, or that of an arm that was there in other frames.
    np.testing.assert_allclose(found_m[told], pelvis_m[told, 2], atol=0.35)


def test_one_frame_is_no_evidence() -> None:
    body = walk(FRAMES)
    once = all_seen()
    once[1:] = False
    assert not passed_before(body, np.arange(FRAMES), once, lens_of(body)).depth_m.any()


def test_a_moving_camera_tells_nothing() -> None:
    body = walk(FRAMES, camera_moves=True)
    passed = passed_before(body, np.arange(FRAMES), all_seen(), lens_of(body))
    assert not passed.depth_m.any()
    assert not passed.seen.any()


def test_covered_pixels_without_the_person_are_hidden_ones() -> None:
    body = walk(FRAMES)
    unseen = passed_before(body, np.arange(FRAMES), ~all_seen(), lens_of(body))
    seen = passed_before(body, np.arange(FRAMES), all_seen(), lens_of(body))
    assert not unseen.seen.any()
    np.testing.assert_array_equal(unseen.hidden, seen.seen)
    assert not seen.hidden.any()


def picture(thing_m: float, person_m: float, hidden: int = 0) -> tuple[np.ndarray, np.ndarray, Passed]:
    """A thing in the middle, and a person before its left half in ten frames."""
    depth_m, shows = np.full(SIZE, 9.0), np.zeros(SIZE, bool)
    shows[30:70, 40:80] = True
    depth_m[shows] = thing_m
    before = np.zeros(SIZE, bool)
    before[10:80, 30:60] = True
    counts = before.astype(np.int32)
    return depth_m, shows, Passed(np.where(before, person_m, 0.0), 10 * counts, hidden * counts)


def test_a_thing_nearer_than_who_is_before_it_moves_behind() -> None:
    factor = factor_behind(*picture(3.0, 3.6))
    assert 3.0 * factor == pytest.approx(3.6, rel=0.06)


@pytest.mark.parametrize(("thing_m", "person_m", "hidden", "why"), [
    (3.0, 2.5, 0, "it is behind already"),
    (3.0, 3.1, 0, "within the error of both"),
    (3.0, 6.0, 0, "so far off that one of the two is wrong"),
    (3.0, 3.6, 4, "the person passes behind it: a mask is too large"),
])  # fmt: skip
def test_otherwise_it_stays(thing_m: float, person_m: float, hidden: int, why: str) -> None:
    assert factor_behind(*picture(thing_m, person_m, hidden)) == 1.0, why


def test_a_touch_of_outlines_is_no_evidence() -> None:
    depth_m, shows, passed = picture(3.0, 3.6)
    edge = np.zeros(SIZE, bool)
    edge[:36] = True
    touching = Passed(np.where(edge, passed.depth_m, 0.0), passed.seen, passed.hidden)
    assert factor_behind(depth_m, shows, touching) > 1.0
    edge[31:] = False
    touching = Passed(np.where(edge, passed.depth_m, 0.0), passed.seen, passed.hidden)
    assert factor_behind(depth_m, shows, touching) == 1.0
