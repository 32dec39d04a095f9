"""People on one floor: sizes that agree, floors that do not, and bodies that grow without leaving the picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import planted_walk, true_keypoints

from stages.humans import _on_one_floor, _sole_heights
from video2anim.body.anny_body import shaped_body
from video2anim.fitting.common_floor import grown, shared_scales
from video2anim.fitting.ground import level_frame
from video2anim.fitting.problem import FittedBody, Observations
from video2anim.geometry.projection import invert_rigid, project
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.pipeline.stage import StageContext
from video2anim.types import CameraEstimate, Intrinsics, PersonTrack

LENS = Intrinsics.centered(1100.0, 1280, 720)
EYE_M = 1.7
SURE_RAD = 0.003


def scales_of(
    below_m: list[float], distance_m: float = 4.0, up_sigma_rad: float = SURE_RAD, sigma: float | list[float] = 0.055
) -> tuple[np.ndarray, np.ndarray]:
    count = len(below_m)
    return shared_scales(
        np.array(below_m), np.full(count, distance_m), up_sigma_rad=up_sigma_rad,
        stature_sigma_ratio=np.broadcast_to(sigma, count),
    )  # fmt: skip


def test_one_floor_stays() -> None:
    scales, shares = scales_of([1.6, 1.6, 1.6])
    np.testing.assert_allclose(scales, 1.0)
    assert shares.all()


def test_two_sizes_meet_in_the_middle() -> None:
    scales, shares = scales_of([1.7, 1.5])
    assert shares.all()
    floors_m = scales * [1.7, 1.5]
    # Soles are 3 cm uncertain: the floors come as near to each other as that allows.
    assert np.ptp(floors_m) < 0.05
    assert floors_m.mean() == pytest.approx(np.sqrt(1.7 * 1.5), abs=0.01)


def test_the_more_people_the_better_the_floor() -> None:
    """Statures drawn from the prior: the error of the camera's height falls with the root of their number."""
    rng = np.random.default_rng(0)
    errors = {}
    for people in (1, 4):
        below_m = 1.6 * np.exp(0.055 * rng.standard_normal((400, people)))
        found = [scales_of(list(row))[0][0] * row[0] for row in below_m]
        errors[people] = np.std(np.log(np.array(found) / 1.6))
    assert errors[4] == pytest.approx(0.5 * errors[1], rel=0.2)


def test_an_uncertain_tilt_moves_far_floors_apart_and_sizes_little() -> None:
    sure, _ = scales_of([1.7, 1.5], distance_m=6.0)
    unsure, shares = scales_of([1.7, 1.5], distance_m=6.0, up_sigma_rad=0.06)
    assert shares.all()
    assert np.abs(np.log(unsure)).max() < 0.3 * np.abs(np.log(sure)).max()


def test_a_child_or_another_floor_is_left_alone() -> None:
    scales, shares = scales_of([1.6, 1.6, 2.4])
    np.testing.assert_allclose(scales, 1.0)
    np.testing.assert_array_equal(shares, [True, True, False])


def test_a_camera_on_the_floor_tells_nothing() -> None:
    for below_m in ([0.02, 1.0], [-0.3, 1.0], [0.05, 0.06]):
        np.testing.assert_allclose(scales_of(below_m)[0], 1.0, atol=0.05)


def test_known_heights_are_kept() -> None:
    scales, _ = scales_of([1.62, 1.58], sigma=0.006)
    np.testing.assert_allclose(scales, 1.0, atol=0.003)


def test_a_known_height_brings_the_others_to_its_floor() -> None:
    scales, shares = scales_of([1.7, 1.5], sigma=[0.006, 0.055])
    assert shares.all()
    assert scales[0] == pytest.approx(1.0, abs=0.005)
    assert scales[1] * 1.5 == pytest.approx(1.7, abs=0.06), "soles are 3 cm uncertain"


def walker(frames: int = 45) -> tuple[Observations, FittedBody, np.ndarray]:
    """A fit that is the truth, of a walk seen by a camera that looks down, and the camera's up vector."""
    motion = planted_walk(frames)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.diag([1.0, -1, -1]) @ matrix_from_axis_angle(np.array([-0.2, 0, 0]))
    T_world_camera[:3, 3] = [0.6, EYE_M, 5.5]
    T_camera_world = invert_rigid(T_world_camera)
    points = true_keypoints(motion) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    joints = motion.joints_world_m @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    pixels = project(points, LENS)
    observed = Observations(
        motion.frame_time_s, np.ones(frames, bool), pixels, points - points[:, :1], np.ones(pixels.shape[:2]), LENS
    )
    R_parent_joint = motion.R_parent_joint.copy()
    R_parent_joint[:, 0] = T_camera_world[:3, :3] @ R_parent_joint[:, 0]
    rest_m = motion.rest_joints_m
    fit = FittedBody(
        R_parent_joint, joints[:, 0] - rest_m[0], joints, rest_m, motion.shape, 1100.0,
        np.zeros(pixels.shape[:2]), 0.0,
    )  # fmt: skip
    return observed, fit, T_world_camera[1, :3].copy()


def soles_m(fit: FittedBody, up_camera: np.ndarray) -> float:
    R_world_camera = np.tile(level_frame(up_camera), (len(fit.joints_camera_m), 1, 1))
    return float(np.percentile(_sole_heights(fit, R_world_camera).min(1), 10))


@pytest.mark.parametrize("factor", [0.93, 1.06])
def test_a_grown_body_looks_the_same(factor: float) -> None:
    observed, fit, up_camera = walker()
    larger = grown(observed, fit, factor)
    height_m = [float(np.ptp(shaped_body(one.shape).rest_vertices_m[:, 1])) for one in (fit, larger)]
    assert height_m[1] / height_m[0] == pytest.approx(factor, abs=0.002)
    np.testing.assert_allclose(larger.joints_camera_m[:, 0], factor * fit.joints_camera_m[:, 0], rtol=0.002)
    assert soles_m(larger, up_camera) == pytest.approx(factor * soles_m(fit, up_camera), rel=0.01)
    # Limbs do not grow quite alike: a hundredth of the person's size in the picture at most.
    size_px = np.ptp(observed.keypoints_px[..., 1], axis=1).mean()
    assert np.nanmedian(larger.reprojection_px) < 0.01 * size_px
    np.testing.assert_array_equal(larger.R_parent_joint, fit.R_parent_joint)


def test_growth_ends_where_the_body_model_does() -> None:
    observed, fit, _ = walker(10)
    giant = grown(observed, fit, 3.0)
    assert giant.shape.parameters["height"] == pytest.approx(1.0, abs=1e-6)
    distance = giant.joints_camera_m[:, 0] / fit.joints_camera_m[:, 0]
    np.testing.assert_allclose(distance, distance[0, 0], rtol=1e-6)
    assert 1.05 < distance[0, 0] < 2.0


def test_the_stage_puts_two_walkers_on_one_floor() -> None:
    observed, fit, up_camera = walker()
    frames = len(observed.valid)
    small = grown(observed, fit, 0.9)
    first = PersonTrack(
        1, np.ones(frames, bool), np.ones(frames), np.zeros((frames, 4)), np.zeros((frames, 33, 2)),
        np.zeros((frames, 33, 3)), np.zeros((frames, 33)), np.zeros((frames, 64, 64), np.uint8),
        np.zeros((frames, 2, 3)),
    )  # fmt: skip
    tracks = first, replace(first, person_id=2)
    still = np.tile(np.eye(3), (frames, 1, 1))
    camera = CameraEstimate(LENS, "user", 0.01, up_camera, "picture", SURE_RAD, True, still)
    ctx = StageContext(Path())
    found = _on_one_floor(tracks, [observed] * 2, [fit, small], camera, [None, None], ctx)
    before_m, after_m = ([soles_m(one, up_camera) for one in pair] for pair in ([fit, small], found))
    assert abs(np.ptp(before_m)) == pytest.approx(0.1 * EYE_M, rel=0.1)
    assert abs(np.ptp(after_m)) < 0.35 * abs(np.ptp(before_m))
    assert not ctx.warnings
    known = _on_one_floor(tracks, [observed] * 2, [fit, small], camera, [1.7, None], ctx)
    assert abs(soles_m(known[0], up_camera) - soles_m(fit, up_camera)) < 0.01
    assert abs(soles_m(known[1], up_camera) - soles_m(fit, up_camera)) < 0.05
    tiny = grown(observed, grown(observed, fit, 0.85), 0.85)
    found = _on_one_floor(tracks, [observed] * 2, [fit, tiny], camera, [None, None], ctx)
    assert found[0] is fit
    assert found[1] is tiny
    assert "person 2" in ctx.warnings[0]
