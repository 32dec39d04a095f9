"""The verdict on a fitted person: what is fine raises no doubt, and each fault raises its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import planted_walk

from video2anim.humans.landmarks import LANDMARK_ORDER
from video2anim.humans.problem import FittedBody, Observations
from video2anim.humans.quality import bone_spread, person_quality
from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT
from video2anim.types import BodyMotion, Intrinsics, PersonQuality, PersonTrack

FRAMES, FPS = 60, 30.0
LENS = Intrinsics.centered(1000.0, 1280, 720)
SIZE_PX = 500.0


def person(valid: np.ndarray | None = None) -> tuple[PersonTrack, Observations, FittedBody, BodyMotion]:
    """Somebody who walks, found within 5 pixels; the person is 500 pixels large."""
    motion = planted_walk(FRAMES)
    seen = np.ones(FRAMES, bool) if valid is None else valid
    motion = replace(motion, valid=seen)
    pixels, points = np.zeros((FRAMES, 33, 2)), np.zeros((FRAMES, 33, 3))
    pixels[:, 31], pixels[:, 32] = [0.6 * SIZE_PX, 0.0], [0.0, 0.8 * SIZE_PX]
    points[...] = 0.1 * np.arange(33)[:, None]
    pixels[~seen], points[~seen] = np.nan, np.nan
    visibility = np.where(seen[:, None], 0.9, np.nan) * np.ones(33)
    track = PersonTrack(
        1, seen, visibility[:, 0], np.zeros((FRAMES, 4)), pixels, points, visibility,
        np.zeros((FRAMES, 64, 64), np.uint8), np.zeros((FRAMES, 2, 3)),
    )  # fmt: skip
    observed = Observations(
        motion.frame_time_s, seen, pixels[:, LANDMARK_ORDER], points[:, LANDMARK_ORDER],
        np.nan_to_num(visibility[:, LANDMARK_ORDER]), LENS, np.tile([0.0, -1.0, 0.0], (FRAMES, 1)),
    )  # fmt: skip
    fit = FittedBody(
        motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.joints_world_m, motion.rest_joints_m, motion.shape,
        np.where(seen[:, None], 5.0, np.nan) * np.ones(len(LANDMARK_ORDER)),
    )  # fmt: skip
    return track, observed, fit, motion


def judge(*parts: object) -> PersonQuality:
    return person_quality(*parts, FPS, 0.09)  # type: ignore[arg-type]


def test_a_good_fit_is_trusted_and_its_numbers_are_right() -> None:
    track, observed, fit, motion = person()
    found = judge(track, observed, fit, motion)
    assert found.trusted
    assert found.reprojection_px == pytest.approx(5.0)
    assert found.reprojection_ratio == pytest.approx(5.0 / SIZE_PX)
    assert found.valid_share == 1.0
    assert found.bone_spread == 0.0
    assert found.fast_share == 0.0
    assert found.body_height_m == pytest.approx(float(np.ptp(motion.rest_joints_m[:, 1])))
    jerk_m_s3 = FPS**3 * np.linalg.norm(np.diff(motion.joints_world_m, n=3, axis=0), axis=-1).mean()
    assert found.jerk_m_s3 == pytest.approx(float(jerk_m_s3))
    assert found.skating_gmd == 0.0
    assert found.body_height_sigma_m == 0.09


@pytest.mark.parametrize(
    ("fault", "doubt"),
    [
        ("misses", "misses its landmarks by 5.0%"),
        ("rare", "seen in 40% of the frames"),
        ("brief", "seen in 10 frames only"),
        ("rubber", "limbs change their length"),
        ("fast", "faster than anybody can run in 100%"),
        ("giant", "from head to foot"),
    ],
)
def test_each_fault_is_told(fault: str, doubt: str) -> None:
    frame = np.arange(FRAMES)
    track, observed, fit, motion = person({"rare": frame < 24, "brief": frame < 10}.get(fault))
    if fault == "misses":
        fit = replace(fit, reprojection_px=5 * fit.reprojection_px)
    if fault == "rubber":
        stretch = np.where(frame % 2 == 0, 0.7, 1.3)[:, None, None]
        track = replace(track, landmarks_m=stretch * track.landmarks_m)
    if fault == "fast":
        away = motion.T_world_root[:, :3, 3] + np.arange(FRAMES)[:, None] * [20.0 / FPS, 0.0, 0.0]
        motion = motion.with_pose(translation_world_m=away, R_parent_joint=motion.R_parent_joint)
    if fault == "giant":
        fit = replace(fit, rest_joints_m=1.8 * fit.rest_joints_m)
    found = judge(track, observed, fit, motion)
    assert not found.trusted
    assert any(doubt in text for text in found.doubts), found.doubts
    assert len(found.doubts) == (2 if fault == "brief" else 1), "other faults are not made up"


def test_bones_are_judged_where_they_are_seen() -> None:
    track, *_ = person()
    points = track.landmarks_m.copy()
    wrist = BLAZEPOSE_OF_KEYPOINT["left_wrist"]
    points[:, wrist] += np.random.default_rng(0).normal(0, 1.0, (FRAMES, 3))
    visibility = track.visibility.copy()
    visibility[:, wrist] = 0.1
    assert bone_spread(replace(track, landmarks_m=points, visibility=visibility)) == 0.0
    assert np.isnan(bone_spread(replace(track, visibility=np.zeros_like(visibility))))
