"""Where a person was seen, and how far away they were there."""

from __future__ import annotations

import numpy as np
from walk_scene import walk

from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.lab.eval.person_coverage import person_coverage
from video2anim.types import BodyMotion

FRAMES, SIZE = 12, (90, 120)
"""Rows and columns of the masks."""


def lens_of(body: BodyMotion):
    return body.intrinsics.resized(SIZE[1], SIZE[0])


def all_seen() -> np.ndarray:
    return np.ones((FRAMES, *SIZE), bool)


def test_depth_is_that_of_the_body() -> None:
    body = walk(FRAMES)
    passed_m = person_coverage(body, np.arange(FRAMES), all_seen(), lens_of(body))
    pelvis_m = transform_points(invert_rigid(body.T_world_camera[0]), body.joints_world_m[:, 0].astype(float))
    at = project(pelvis_m, lens_of(body)).round().astype(int)
    found_m = passed_m[at[:, 1], at[:, 0]]
    told = found_m > 0
    assert told.sum() >= 6
    # Its near side, or that of an arm that was there in other frames.
    np.testing.assert_allclose(found_m[told], pelvis_m[told, 2], atol=0.35)


def test_one_frame_is_no_evidence() -> None:
    body = walk(FRAMES)
    once = all_seen()
    once[1:] = False
    assert not person_coverage(body, np.arange(FRAMES), once, lens_of(body)).any()


def test_a_moving_camera_tells_nothing() -> None:
    body = walk(FRAMES, camera_moves=True)
    passed_m = person_coverage(body, np.arange(FRAMES), all_seen(), lens_of(body))
    assert not passed_m.any()
