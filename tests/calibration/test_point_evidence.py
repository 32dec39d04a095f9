"""Points that a traveling camera has passed, in a room of boxes: which surface each shows, and what the fit finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from seen_boxes import FLOOR as SHOWN_FLOOR
from seen_boxes import LENS, SKY, Block, looking, shoot
from synthetic import planted_walk, with_root_shift

from video2anim.calibration.evidence import FLOOR, Evidence
from video2anim.calibration.fit import calibrate
from video2anim.calibration.gather import picture_evidence, with_objects, with_points
from video2anim.geometry.projection import pixel_rays
from video2anim.types import (
    BackgroundImage,
    BackgroundPoints,
    BodyTracks,
    CameraEstimate,
    DepthClip,
    InstanceMasks,
    ObjectInstance,
    PersonQuality,
)

FRAMES = 40
UNIT_M = 4.0
"""Length of the unit of the camera's path."""
SURE = PersonQuality(2.5, 0.01, 50.0, 0.1, 0.04, 1.0, 1.55, 0.0, body_height_sigma_m=0.01)


def evidence_of(too_short: float, wrong: float, *, in_first_frame: bool = True) -> Evidence:
    """A crate that the border cuts, whose depth is `wrong` times what it should be, and a camera that travels a meter,
    whose path stage humans makes `too_short`."""
    T_start = looking((0.0, 1.6, 0.0), (0.0, 0.5, 3.0))
    shot = shoot([Block((1.6, 0.5, 3.0), (1.0, 1.0, 1.0))], T_start)
    crate, floor = shot.mask(0), shot.mask(SHOWN_FLOOR)
    assert crate[:, [0, -1]].any()
    T_world_camera = np.tile(T_start, (FRAMES, 1, 1))
    T_world_camera[:, 0, 3] += too_short * np.linspace(0.0, 1.0, FRAMES)
    T_first_camera = np.linalg.inv(T_start) @ T_world_camera
    T_first_camera[:, :3, 3] /= too_short * UNIT_M
    place_m = pixel_rays(LENS.resized(*crate.shape[::-1])) * shot.depth_m[..., None]
    points = place_m[4::12, 4::12][(shot.shown != SKY)[4::12, 4::12]] / UNIT_M
    count = len(points)
    camera = CameraEstimate(
        LENS, "user", 0.0, np.array([0.0, -1.0, 0.0]), 0.0, False, T_first_camera,
        BackgroundPoints(points, np.full(count, 0.02), np.full(count, in_first_frame)),
    )  # fmt: skip
    walk = with_root_shift(planted_walk(FRAMES), np.tile([-0.5, 0.0, 2.5], (FRAMES, 1)))
    walk = replace(walk, intrinsics=LENS, T_world_camera=np.tile(T_start, (FRAMES, 1, 1))).in_world(T_world_camera)
    none = np.zeros((0, *crate.shape), bool)
    seen_m = np.where(crate, wrong * shot.depth_m, shot.depth_m)
    depth = DepthClip("depth", "geometric", np.zeros(0, int), none * 1.0, none * 1.0, none, seen_m, shot.shown != SKY)
    background = BackgroundImage(np.zeros((*crate.shape, 3), np.uint8), crate * 0.0, np.zeros(0, int), none, none)
    masks = InstanceMasks("truth", (ObjectInstance(1, "object", 1.0, np.zeros(4), crate),), floor)
    bodies = BodyTracks((walk,), (SURE,), 0.3)
    found = picture_evidence(depth, background, bodies, floor, 30.0, np.random.default_rng(0))
    return with_points(with_objects(found, depth, walk, masks), depth, camera, walk, masks)


def test_each_point_shows_a_surface_and_has_the_length_of_the_path() -> None:
    points = evidence_of(0.7, 1.25).points
    assert points is not None
    assert {int(surface) for surface in points.surface} == {0, FLOOR}
    on_crate = points.surface == 0
    np.testing.assert_allclose(points.depth_m, 0.7 * points.seen.value / np.where(on_crate, 1.25, 1.0), rtol=1e-5)


@pytest.mark.parametrize("too_short", [0.7, 1.3])
def test_the_fit_finds_path_and_crate(too_short: float) -> None:
    found = calibrate(evidence_of(too_short, 1.25))
    assert found.path_ratio == pytest.approx(1 / too_short, rel=0.05)
    assert float(np.exp(found.object_depth_log[0])) == pytest.approx(1 / 1.25, rel=0.05)


def test_what_the_first_frame_does_not_show_says_nothing() -> None:
    evidence = evidence_of(0.7, 1.25, in_first_frame=False)
    assert evidence.points is None
    found = calibrate(evidence)
    assert found.path_ratio == pytest.approx(1.0)
    assert found.path_log_sigma == pytest.approx(0.3, rel=0.01)
