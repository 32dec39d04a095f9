"""People and camera after the fit: sizes and floor change, the picture does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import planted_walk
from walk_scene import walk

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import posed_vertices
from video2anim.calibration.bodies import calibrated
from video2anim.calibration.fit import Calibration
from video2anim.geometry.projection import project
from video2anim.types import BodyMotion, BodyTracks

CAMERA_HEIGHT_M = 1.3
FRAMES = 12


def found(*ratios: float, path_ratio: float = 1.0) -> Calibration:
    """Sizes of people, a height of the camera, and the length of its path."""
    people = np.array(ratios)
    return Calibration(
        CAMERA_HEIGHT_M, 0.05, people, 0.03 + 0 * people, path_ratio, 0.04, 0 * people, 1.0, 0.0, 0.1, 0.1, 0.0,
        np.zeros(0), np.zeros(0), {}, 0.1, 0.1,
    )  # fmt: skip


def body_height_m(body: BodyMotion) -> float:
    return float(np.ptp(shaped_body(body.shape).rest_vertices_m[:, 1]))


def moved_in_picture(before: BodyMotion, after: BodyMotion) -> float:
    """Median distance of joints in the picture from where they were, as a share of the body's height in it."""
    own, new = (project(body.joints_camera_m, body.intrinsics)[body.valid] for body in (before, after))
    height_px = np.ptp(own[..., 1], axis=1)[:, None]
    return float(np.median(np.linalg.norm(new - own, axis=-1) / height_px))


def test_joints_keep_their_pixels() -> None:
    body = walk(FRAMES)
    after = calibrated(BodyTracks((body,)), found(1.0)).people[0]
    assert after.intrinsics == body.intrinsics
    assert moved_in_picture(body, after) < 1e-9


@pytest.mark.parametrize("ratio", [0.95, 1.04])
def test_statures_are_reached_and_distances_with_them(ratio: float) -> None:
    body = walk(FRAMES)
    after = calibrated(BodyTracks((body,)), found(ratio)).people[0]
    assert body_height_m(after) / body_height_m(body) == pytest.approx(ratio, abs=0.002)
    away_m = [np.linalg.norm(one.joints_camera_m[:, 0], axis=-1) for one in (body, after)]
    np.testing.assert_allclose(away_m[1] / away_m[0], ratio, rtol=0.004)
    # Limbs do not grow quite alike.
    assert moved_in_picture(body, after) < 0.01


def test_growth_ends_where_the_body_model_does() -> None:
    """And the body is as far away as its size says, not as was asked."""
    body = walk(FRAMES)
    after = calibrated(BodyTracks((body,)), found(3.0)).people[0]
    reached = body_height_m(after) / body_height_m(body)
    assert 1.05 < reached < 2.0
    away_m = [np.linalg.norm(one.joints_camera_m[:, 0], axis=-1) for one in (body, after)]
    np.testing.assert_allclose(away_m[1] / away_m[0], reached, rtol=0.01)


@pytest.mark.parametrize("camera_moves", [False, True])
def test_the_origin_is_on_the_floor_below_the_first_valid_root(camera_moves: bool) -> None:
    body = walk(FRAMES, camera_moves=camera_moves)
    valid = body.valid.copy()
    valid[:3] = False
    body = replace(body, valid=valid)
    other = walk(FRAMES, 2, camera_moves=camera_moves, side_m=0.8)
    after = calibrated(BodyTracks((body, other)), found(1.0, 1.03))
    main, second = after.people
    np.testing.assert_allclose(main.joints_world_m[3, 0, [0, 2]], 0.0, atol=1e-9)
    np.testing.assert_allclose(main.T_world_camera[:, :3, :3], body.T_world_camera[:, :3, :3], atol=1e-9)
    assert main.T_world_camera[0, 1, 3] == pytest.approx(CAMERA_HEIGHT_M)
    np.testing.assert_array_equal(main.T_world_camera, second.T_world_camera)
    paths = [np.linalg.inv(one.T_world_camera[0]) @ one.T_world_camera for one in (body, main)]
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-9)
    assert moved_in_picture(other, second) < 0.015
    assert after.quality == ()


@pytest.mark.parametrize("path_ratio", [1.0, 1.4])
def test_the_path_of_the_camera_has_the_scale_of_the_main_person_and_its_own_length(path_ratio: float) -> None:
    body = walk(FRAMES, camera_moves=True)
    after = calibrated(BodyTracks((body,)), found(1.05, path_ratio=path_ratio))
    own, new = (np.diff(one.T_world_camera[:, :3, 3], axis=0) for one in (body, after.main))
    np.testing.assert_allclose(np.linalg.norm(new, axis=1), 1.05 * path_ratio * np.linalg.norm(own, axis=1), rtol=1e-6)
    assert after.path_log_sigma == 0.04
    assert moved_in_picture(body, after.main) < 0.015


def test_soles_of_a_true_camera_are_on_the_floor() -> None:
    """A walk with planted feet under its own camera, found a little wrong in nothing."""
    body = planted_walk(30)
    right = replace(found(1.0), camera_height_m=float(body.T_world_camera[0, 1, 3]))
    after = calibrated(BodyTracks((body,)), right).people[0]
    lowest_m = posed_vertices(after, shaped_body(after.shape), None, np.arange(30))[..., 1].min(1)
    np.testing.assert_allclose(lowest_m, 0.0, atol=0.01)


def test_a_person_who_is_never_seen_stays_finite() -> None:
    body = walk(FRAMES)
    unseen = replace(body, valid=np.zeros(FRAMES, bool))
    after = calibrated(BodyTracks((body, unseen)), found(1.0, 1.0)).people[1]
    assert np.isfinite(after.joints_world_m).all()
