"""The lifter: what it sees, what its answer means, and that the shipped weights know people."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import planted_walk, true_keypoints

from stages.humans import HumansConfig, warn_of_guesses
from video2anim.body.anny_body import KEYPOINT_NAMES, RestSkeleton, anny_model
from video2anim.geometry.projection import invert_rigid, project
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle, rot6d_from_matrix
from video2anim.humans import long_clip
from video2anim.humans.initial import landmark_rotation, ray_rotation
from video2anim.humans.landmarks import KEYPOINT_INDEX, with_landmarks
from video2anim.humans.lifter_input import (
    CONTACT_INDEX,
    FEATURES,
    OUTPUTS,
    LiftedBody,
    _carried,
    lifted_body,
    lifter_input,
    ray_features,
)
from video2anim.humans.lifting import lift
from video2anim.humans.objective import PERSON, FitConfig
from video2anim.humans.optimize import _start, fit_body, reposed
from video2anim.humans.problem import Observations
from video2anim.humans.smoothing import smoothed_fit
from video2anim.networks import lifter, load_model
from video2anim.networks.lifter import Lifter
from video2anim.pipeline.stage import StageContext
from video2anim.types import Intrinsics
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

LENS = Intrinsics.centered(1000.0, 1280, 720)
HIPS = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]
TILT_RAD = 0.2
LEAN = matrix_from_axis_angle(np.radians([5.0, 0.0, 0.0]))
"""BlazePose's landmarks lean by 5 degrees against their axes, on rendered people (`benchmarks/landmark_axes.py`)."""


class Walk:
    """A walk before a camera that looks down, with detector-like noise."""

    def __init__(self, frames: int = 90, fps: float = 30.0) -> None:
        self.motion = planted_walk(frames)
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = np.diag([1.0, -1, -1]) @ matrix_from_axis_angle(np.array([-TILT_RAD, 0, 0]))
        T_world_camera[:3, 3] = [0.4, 1.7, 6.0]
        self.R_camera_world = invert_rigid(T_world_camera)[:3, :3]
        self.t = invert_rigid(T_world_camera)[:3, 3]
        self.joints_camera_m = self.motion.joints_world_m @ self.R_camera_world.T + self.t
        points = true_keypoints(self.motion) @ self.R_camera_world.T + self.t
        rng = np.random.default_rng(3)
        pixels = project(points, LENS)
        up_camera = np.tile(self.up_camera, (frames, 1))
        R = landmark_rotation(pixels[:, HIPS].mean(1), LENS, up_camera)
        seen_m = np.einsum("tba,tkb->tka", R @ LEAN.T, points - points[:, HIPS].mean(1, keepdims=True))
        self.observed = Observations(
            np.arange(frames) / fps, np.ones(frames, bool), pixels + rng.normal(0, 1.5, pixels.shape),
            seen_m + rng.normal(0, 0.02, seen_m.shape), np.ones(pixels.shape[:2]), LENS, up_camera,
        )  # fmt: skip

    @property
    def up_camera(self) -> np.ndarray:
        return self.R_camera_world @ [0.0, 1.0, 0.0]


@pytest.fixture(scope="module")
def walk() -> Walk:
    return Walk()


@pytest.fixture(scope="module")
def network() -> Lifter:
    return load_model("lifter")


def limbs_apart_m(R_parent_joint: np.ndarray, truth: Walk) -> float:
    """Mean distance of joints about the pelvis, both on the true skeleton."""
    zero = np.zeros((len(R_parent_joint), 3))
    joints, _ = forward_kinematics(R_parent_joint, zero, truth.motion.rest_joints_m)
    true_m = truth.joints_camera_m - truth.joints_camera_m[:, :1]
    return float(np.linalg.norm(joints - true_m, axis=-1).mean())


def test_features_do_not_know_where_the_camera_looks() -> None:
    """The same person seen by a camera turned about its center: only the rotation that undoes it differs."""
    rng = np.random.default_rng(0)
    points = rng.normal(0, 0.4, (12, 25, 3)) + np.array([0.3, 0.1, 4.0])
    landmarks, visibility, valid = rng.normal(0, 0.4, (12, 25, 3)), rng.random((12, 25)), np.ones(12, bool)
    turn = matrix_from_axis_angle(np.array([0.2, 0.0, 0.0]))
    found = []
    for R in (np.eye(3), turn):
        ray = points @ R.T
        center = ray[:, HIPS].mean(1)
        unit = Intrinsics(1.0, 1.0, 0.0, 0.0, 1, 1)
        R_ray = ray_rotation(center[:, :2] / center[:, 2:], unit)
        found.append(ray_features(ray, R_ray, landmarks, visibility, valid))
    # A turn about x leaves a roll about the ray of the second order in the angles.
    np.testing.assert_allclose(found[0].size, found[1].size, rtol=1e-4)
    np.testing.assert_allclose(found[0].features, found[1].features, atol=0.08)


def test_features_are_free_of_scale() -> None:
    """A person twice as big at twice the distance looks the same."""
    rng = np.random.default_rng(1)
    points, unit = rng.normal(0, 0.4, (6, 25, 3)) + np.array([0.2, -0.1, 3.0]), Intrinsics(1.0, 1.0, 0.0, 0.0, 1, 1)
    landmarks, seen = np.zeros((6, 25, 3)), np.ones((6, 25))
    center = points[:, HIPS].mean(1)
    R = ray_rotation(center[:, :2] / center[:, 2:], unit)
    one = ray_features(points, R, landmarks, seen, np.ones(6, bool))
    two = ray_features(2 * points, R, landmarks, seen, np.ones(6, bool))
    np.testing.assert_allclose(one.features, two.features, atol=1e-5)


def test_features_of_many_clips_at_once() -> None:
    """Each as by itself, gaps included."""
    rng = np.random.default_rng(2)
    ray = rng.normal(0, 0.4, (3, 9, 25, 3)) + np.array([0.2, -0.1, 3.0])
    landmarks, seen = rng.normal(0, 0.4, (3, 9, 25, 3)), rng.random((3, 9, 25))
    valid = rng.random((3, 9)) < 0.6
    valid[2] = False
    unit = Intrinsics(1.0, 1.0, 0.0, 0.0, 1, 1)
    center = ray[:, :, HIPS].mean(2)
    R = ray_rotation((center[..., :2] / center[..., 2:]).reshape(-1, 2), unit).reshape(3, 9, 3, 3)
    together = ray_features(ray, R, landmarks, seen, valid)
    for clip in range(3):
        alone = ray_features(ray[clip], R[clip], landmarks[clip], seen[clip], valid[clip])
        np.testing.assert_allclose(together.features[clip], alone.features, atol=1e-6)
        np.testing.assert_allclose(together.size[clip], alone.size)


def test_answer_is_read_back(walk: Walk) -> None:
    """An answer written from the truth gives the true body in the camera."""
    given = lifter_input(walk.observed)
    R = walk.motion.R_parent_joint.copy()
    R[:, 0] = np.swapaxes(given.R_camera_ray, -1, -2) @ walk.R_camera_world @ R[:, 0]
    pelvis_ray = np.einsum("tba,tb->ta", given.R_camera_ray, walk.joints_camera_m[:, 0])
    up_ray = np.einsum("tba,b->ta", given.R_camera_ray, walk.up_camera)
    logits = np.where(walk.motion.contact[:, CONTACT_INDEX] > 0.5, 20.0, -20.0)
    output = np.concatenate(
        [rot6d_from_matrix(R).reshape(len(R), -1), np.log(pelvis_ray[:, 2:] * given.size[:, None]),
         pelvis_ray[:, :2], logits, np.full((len(R), 22), np.log(0.07)), 3.0 * up_ray], 1,
    )  # fmt: skip
    assert output.shape[1] == OUTPUTS
    body = lifted_body(output, given)
    joints, _ = forward_kinematics(body.R_parent_joint, walk.joints_camera_m[:, 0], walk.motion.rest_joints_m)
    np.testing.assert_allclose(joints, walk.joints_camera_m, atol=1e-6)
    np.testing.assert_allclose(body.up_camera, np.tile(walk.up_camera, (len(R), 1)), atol=1e-6)
    np.testing.assert_allclose(body.contact, walk.motion.contact[:, CONTACT_INDEX], atol=1e-6)
    np.testing.assert_allclose(body.error_m, 0.07)


@pytest.mark.parametrize("roll_deg", [-35.0, 20.0, 180.0])
def test_roll_of_the_camera_changes_nothing(walk: Walk, network: Lifter, roll_deg: float) -> None:
    """Gravity is known, so a rolled camera's bodies are those of the level one, rolled."""
    R = matrix_from_axis_angle(np.radians([0.0, 0.0, roll_deg]))
    seen, k = walk.observed, walk.observed.intrinsics
    assert k.fx_px == k.fy_px
    center_px = np.array([k.cx_px, k.cy_px])
    rolled = replace(
        seen, keypoints_px=center_px + (seen.keypoints_px - center_px) @ R[:2, :2].T,
        keypoints_m=seen.keypoints_m @ R.T, up_camera=seen.up_camera @ R.T,
    )  # fmt: skip
    np.testing.assert_allclose(lifter_input(rolled).features, lifter_input(seen).features, atol=1e-4)
    body, level = lift(rolled, network), lift(seen, network)
    np.testing.assert_allclose(body.R_parent_joint[:, 0], R @ level.R_parent_joint[:, 0], atol=1e-3)
    np.testing.assert_allclose(body.up_camera, level.up_camera @ R.T, atol=1e-3)


def test_shipped_weights_know_a_walk(walk: Walk, network: Lifter) -> None:
    body = lift(walk.observed, network)
    assert limbs_apart_m(body.R_parent_joint, walk) < 0.05
    up = body.up_camera.mean(0) / np.linalg.norm(body.up_camera.mean(0))
    assert np.degrees(np.arccos(up @ walk.up_camera)) < 5.0
    feet = slice(0, 4)
    claimed, true = body.contact[:, feet] > 0.5, walk.motion.contact[:, CONTACT_INDEX][:, feet] > 0.5
    assert 2 * (claimed & true).sum() / (claimed.sum() + true.sum()) > 0.75
    assert body.contact[:, 4:].max() < 0.5, "hands, seat and back touch nothing in a walk"


def test_hidden_legs_are_doubted_and_the_rest_is_known(walk: Walk, network: Lifter) -> None:
    """Legs below the picture, where the landmark model puts straight ones: the network expects 1.75 times the errors of
    legs in view; weights that had seen nobody like that expected the same."""
    o = walk.observed
    pixels, points, seen = o.keypoints_px.copy(), o.keypoints_m.copy(), o.weight.copy()
    for number, name in enumerate(KEYPOINT_NAMES):
        side, _, part = name.partition("_")
        down = {"knee": 0.25, "ankle": 0.48, "heel": 0.5, "big_toe": 0.5}.get(part)
        if down is not None:
            hip = KEYPOINT_INDEX[f"{side}_hip"]
            pixels[:, number] = pixels[:, hip] + np.array([[0.0, 1.0]]) * (down * o.size_px[:, None])
            points[:, number] = points[:, hip] + [0.0, 1.75 * down, 0.0]
            seen[:, number] = 0.0
    whole, cut = lift(o, network), lift(replace(o, keypoints_px=pixels, keypoints_m=points, weight=seen), network)
    joints, _ = forward_kinematics(cut.R_parent_joint, np.zeros((len(pixels), 3)), walk.motion.rest_joints_m)
    off_m = np.linalg.norm(joints - walk.joints_camera_m + walk.joints_camera_m[:, :1], axis=-1)
    legs = [JOINT_INDEX[f"{side}_{joint}"] for side in ("left", "right") for joint in ("knee", "ankle", "foot")]
    assert np.delete(off_m, legs, axis=1).mean() < 0.06
    assert cut.error_m[:, legs].mean() > 1.5 * whole.error_m[:, legs].mean()


def test_limbs_that_are_guessed_are_named(walk: Walk, network: Lifter) -> None:
    """Reported for everybody; a warning where the expected error is large for most of the time."""
    lifted = lift(walk.observed, network)
    frames, ankles = len(lifted.error_m), [JOINT_INDEX["left_ankle"], JOINT_INDEX["right_ankle"]]
    for share, warned in ((0.4, False), (0.6, True)):
        error_m = np.full_like(lifted.error_m, 0.06)
        error_m[: round(share * frames), ankles] = 0.25
        ctx = StageContext(Path())
        warn_of_guesses(walk.motion, replace(lifted, error_m=error_m), ctx)
        assert [quality.key for quality in ctx.qualities] == ["legs_uncertainty", "arms_uncertainty"]
        assert len(ctx.warnings) == warned
        assert all("legs are hidden" in text and "0.25 m" in text for text in ctx.warnings)


@pytest.mark.parametrize("missing", ["some", "all"])
def test_frames_without_a_measurement_give_numbers(walk: Walk, network: Lifter, missing: str) -> None:
    o, valid = walk.observed, walk.observed.valid.copy()
    valid[20:30] = False
    valid &= missing == "some"
    gone = np.where(valid[:, None, None], 1.0, np.nan)
    holed = replace(o, valid=valid, keypoints_px=o.keypoints_px * gone, keypoints_m=o.keypoints_m * gone)
    body = lift(holed, network)
    for part in (body.R_parent_joint, body.contact, body.up_camera):
        assert np.isfinite(part).all()
    if missing == "some":
        assert limbs_apart_m(body.R_parent_joint, walk) < 0.08


@pytest.mark.parametrize(("own_up", "angle_rad"), [([0.0, -1.0, 0.3], 0.8 * np.arctan(0.3)), ([0.3, -1.0, 0.0], 0.0)])
def test_bodies_are_turned_by_gravity_in_pitch_only(own_up: list[float], angle_rad: float) -> None:
    """A body straight before a level camera, whose own up direction leans away from the camera or to the side."""
    frames = 7
    output = np.zeros((frames, OUTPUTS), np.float32)
    output[:, :132] = np.tile([1.0, 0.0, 0.0, 0.0, 1.0, 0.0], 22)
    output[:, -3:] = own_up
    pixels = np.full((frames, len(KEYPOINT_NAMES), 2), [LENS.cx_px, LENS.cy_px])
    observed = Observations(
        np.arange(frames) / 30, np.arange(frames) > 1, pixels, np.zeros((frames, len(KEYPOINT_NAMES), 3)),
        np.ones((frames, len(KEYPOINT_NAMES))), LENS, np.tile([0.0, -1.0, 0.0], (frames, 1)),
    )  # fmt: skip
    turned = axis_angle_from_matrix(lift(observed, lambda _: output).R_parent_joint[:, 0])
    np.testing.assert_allclose(turned, np.tile([angle_rad, 0.0, 0.0], (frames, 1)), atol=1e-6)


@pytest.mark.parametrize("frames", [1, 2])
def test_very_short_clips(walk: Walk, network: Lifter, frames: int) -> None:
    o, rows = walk.observed, slice(0, frames)
    short = Observations(
        o.frame_time_s[rows], o.valid[rows], o.keypoints_px[rows], o.keypoints_m[rows], o.weight[rows], LENS,
        o.up_camera[rows],
    )  # fmt: skip
    assert lift(short, network).R_parent_joint.shape == (frames, 22, 3, 3)


def test_long_clips_go_through_in_pieces(network: Lifter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces with margins give what one call gives."""
    features = np.random.default_rng(0).normal(0, 0.5, (4000, FEATURES)).astype(np.float32)
    features[:, -1] = 1.0
    in_pieces = network(features)
    monkeypatch.setattr(lifter, "_CHUNK", 10_000)
    np.testing.assert_allclose(in_pieces, network(features), atol=1e-3)


def test_the_fit_is_better_than_the_network_alone(walk: Walk, network: Lifter) -> None:
    lifted = lift(walk.observed, network)
    fit = fit_body(walk.observed, lifted, iterations=100)
    start_m = _start(walk.observed, lifted, _skeleton()).translation_m.numpy().astype(float)
    alone = reposed(walk.observed, fit, lifted.R_parent_joint, start_m)
    assert limbs_apart_m(fit.R_parent_joint, walk) < limbs_apart_m(lifted.R_parent_joint, walk) + 0.005
    assert np.nanmedian(fit.reprojection_px) < np.nanmedian(alone.reprojection_px)


def test_a_joint_that_the_network_doubts_follows_the_landmarks(walk: Walk, network: Lifter) -> None:
    """An arm lifted wrongly: with the usual error expected it stays wrong, with a large one it is set right."""
    lifted = lift(walk.observed, network)
    R = lifted.R_parent_joint.copy()
    shoulder, arm = JOINT_INDEX["left_shoulder"], [JOINT_INDEX["left_elbow"], JOINT_INDEX["left_wrist"]]
    R[:, shoulder] = R[:, shoulder] @ matrix_from_axis_angle(np.array([0.0, 0.8, 0.0]))
    missed = []
    for expected_m in (0.03, 0.3):
        error_m = np.full((len(R), 22), 0.03)
        error_m[:, [shoulder, *arm]] = expected_m
        wrong = replace(lifted, R_parent_joint=R, error_m=error_m)
        fit = fit_body(walk.observed, wrong, iterations=100)
        off_m = fit.joints_camera_m - fit.joints_camera_m[:, :1] - walk.joints_camera_m + walk.joints_camera_m[:, :1]
        missed.append(float(np.linalg.norm(off_m[:, arm], axis=-1).mean()))
    assert missed[1] < 0.6 * missed[0]


def test_other_poses_of_a_fitted_body(walk: Walk, network: Lifter) -> None:
    """The same poses give the same body; jitter is taken out by the filter, and motion stays."""
    lifted = lift(walk.observed, network)
    fit = fit_body(walk.observed, lifted, iterations=40)
    same = reposed(walk.observed, fit, fit.R_parent_joint, fit.translation_camera_m)
    np.testing.assert_allclose(same.joints_camera_m, fit.joints_camera_m, atol=1e-4)
    np.testing.assert_allclose(same.reprojection_px, fit.reprojection_px, atol=0.1)

    shaken = fit.R_parent_joint @ matrix_from_axis_angle(np.random.default_rng(1).normal(0, 0.05, (90, 22, 3)))
    jittery = reposed(walk.observed, fit, shaken, fit.translation_camera_m)
    kept = smoothed_fit(walk.observed, jittery, 0.0)
    smooth = smoothed_fit(walk.observed, jittery, HumansConfig().cutoff_hz)
    np.testing.assert_array_equal(kept.R_parent_joint, shaken)
    jerk = [float(np.linalg.norm(np.diff(one.joints_camera_m, 3, axis=0), axis=-1).mean()) for one in (jittery, smooth)]
    assert jerk[1] < 0.2 * jerk[0]
    off_m = [np.linalg.norm(one.joints_camera_m - fit.joints_camera_m, axis=-1).mean() for one in (jittery, smooth)]
    assert off_m[1] < 0.75 * off_m[0]
    assert np.nanmean(smooth.reprojection_px) < np.nanmean(jittery.reprojection_px)


def test_known_height_scales_the_lifted_body(walk: Walk, network: Lifter) -> None:
    """A child of 1.2 m stands nearer than an adult who looks the same."""
    lifted = lift(walk.observed, network)
    sizes = {}
    for body_height_m in (1.2, 1.55, 1.85):
        config = replace(FitConfig(), body_height_m=body_height_m, body_height_sigma_m=0.01)
        sizes[body_height_m] = fit_body(walk.observed, lifted, iterations=HumansConfig().iterations, config=config)
    for body_height_m, fit in sizes.items():
        ratio = fit.translation_camera_m[:, 2].mean() / sizes[1.85].translation_camera_m[:, 2].mean()
        assert ratio == pytest.approx(body_height_m / 1.85, rel=0.03)


def test_pieces_cover_the_clip_and_share_frames() -> None:
    for frames in (10, 384, 385, 700, 1000, 9000):
        valid = np.ones(frames, bool)
        pieces = long_clip._pieces(valid)
        assert pieces[0][0] == 0
        assert pieces[-1][-1] == frames - 1
        for before, after in itertools.pairwise(pieces):
            assert before[-1] - after[0] + 1 == 24
        assert max(len(piece) for piece in pieces) < 2.1 * 360
    valid = np.zeros(2000, bool)
    valid[1990:] = True
    assert all(valid[piece].any() for piece in long_clip._pieces(valid))


def test_a_long_clip_is_fitted_as_a_short_one(network: Lifter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_clip, "PIECE_FRAMES", 40)
    monkeypatch.setattr(long_clip, "SHARED_FRAMES", 10)
    long = Walk(110)
    lifted = lift(long.observed, network)
    steps: list[tuple[int, int]] = []
    fit = long_clip.fit_long(
        long.observed, lifted, FitConfig(), iterations=80, on_step=lambda step, total: steps.append((step, total))
    )
    assert steps[-1][0] == steps[-1][1]
    assert [step for step, _ in steps] == sorted(step for step, _ in steps)
    whole = fit_body(long.observed, lifted, iterations=80)
    assert limbs_apart_m(fit.R_parent_joint, long) < limbs_apart_m(whole.R_parent_joint, long) + 0.01
    joints, _ = forward_kinematics(fit.R_parent_joint, fit.translation_camera_m, fit.rest_joints_m)
    np.testing.assert_allclose(joints, fit.joints_camera_m, atol=1e-6)
    jump_m = np.linalg.norm(np.diff(fit.joints_camera_m[:, 0], axis=0), axis=-1)
    assert jump_m.max() < 3 * np.median(jump_m), "no jump where pieces meet"
    assert np.isfinite(fit.reprojection_px).all()


def test_rows_of_a_lifted_body(walk: Walk, network: Lifter) -> None:
    lifted = lift(walk.observed, network)
    some = lifted.rows(np.array([3, 7]))
    assert isinstance(some, LiftedBody)
    np.testing.assert_array_equal(some.contact, lifted.contact[[3, 7]])


def test_gaps_take_the_nearest_measurement() -> None:
    values, valid = np.arange(8.0), np.array([False, True, False, False, False, True, False, False])
    wanted = [1, 1, 1, 1, 5, 5, 5, 5]
    np.testing.assert_array_equal(_carried(values, valid), wanted)
    np.testing.assert_array_equal(_carried(values, np.zeros(8, bool)), np.zeros(8))
    np.testing.assert_array_equal(_carried(values, np.ones(8, bool)), values)
    both = _carried(np.stack([values, values]), np.stack([valid, ~valid]))
    np.testing.assert_array_equal(both, [wanted, [0, 0, 2, 3, 4, 4, 6, 7]])
    np.testing.assert_array_equal(_carried(values[:, None] * [1, 2], valid), np.array(wanted)[:, None] * [1, 2])


def test_the_start_ignores_sizes_of_single_frames(walk: Walk, network: Lifter) -> None:
    """In three frames landmarks are four times as close together; on `sports2d_demo`, where little is seen, the fit did
    not come back."""
    lifted, rest = lift(walk.observed, network), _skeleton()
    pixels = walk.observed.keypoints_px.copy()
    pixels[40:43] = 0.25 * pixels[40:43] + 0.75 * pixels[40:43].mean(1, keepdims=True)
    near, usual = (_start(one, lifted, rest) for one in (replace(walk.observed, keypoints_px=pixels), walk.observed))
    np.testing.assert_allclose(near.translation_m[:, 2].numpy(), usual.translation_m[:, 2].numpy(), atol=0.3)


def test_the_start_is_near_where_landmarks_make_no_sense(walk: Walk, network: Lifter) -> None:
    """Landmarks upside down, as on a blurred man in flight: they met only from behind the camera, where a fit of
    `sports2d_demo` began."""
    lifted, rest = lift(walk.observed, network), _skeleton()
    pixels = walk.observed.keypoints_px.copy()
    pixels[40:43] = 2 * pixels[40:43].mean(1, keepdims=True) - pixels[40:43]
    odd, usual = (_start(one, lifted, rest) for one in (replace(walk.observed, keypoints_px=pixels), walk.observed))
    np.testing.assert_allclose(odd.translation_m.numpy(), usual.translation_m.numpy(), atol=0.5)


def test_the_start_is_where_the_person_is(walk: Walk, network: Lifter) -> None:
    """At the distance of the network, a quarter too near for a man in a jacket, the fit bent his knees."""
    start = _start(walk.observed, lift(walk.observed, network), _skeleton()).translation_m.numpy()
    ratio = start[walk.observed.valid, 2] / walk.joints_camera_m[walk.observed.valid, 0, 2]
    assert np.abs(ratio - 1).max() < 0.1


def _skeleton() -> RestSkeleton:
    return with_landmarks(anny_model().rest_skeleton({name: torch.tensor(value) for name, value in PERSON.items()}))
