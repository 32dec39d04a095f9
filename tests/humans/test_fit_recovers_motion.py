"""The body fit against known truth: a known body, moving in a known way, seen by a known camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import planted_walk, true_keypoints

from stages.camera import CameraConfig, estimate_camera
from video2anim.body.anny_body import PHENOTYPES
from video2anim.camera import background_tracks, image_camera
from video2anim.camera.background_tracks import BackgroundMotion, BackgroundTracks
from video2anim.camera.up import up_by_lifter
from video2anim.errors import StageError
from video2anim.geometry.perspective_field import PerspectiveField, field_of_camera
from video2anim.geometry.projection import invert_rigid, project
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.humans.initial import landmark_rotation, ray_rotation
from video2anim.humans.landmarks import KEYPOINT_INDEX, LANDMARK_ORDER
from video2anim.humans.lifter_input import LiftedBody
from video2anim.humans.lifting import lift
from video2anim.humans.optimize import fit_body
from video2anim.humans.problem import FittedBody, Observations
from video2anim.networks import load_model
from video2anim.networks.landmarks import BLAZEPOSE_OF_KEYPOINT
from video2anim.pipeline.stage import StageContext
from video2anim.types import CameraEstimate, Intrinsics, PayloadFile, PersonTrack, PersonTracks, SourceInfo, VideoClip
from video2anim.types.skeleton import forward_kinematics

FOCAL_PX = 1100.0
LENS = Intrinsics.centered(FOCAL_PX, 1280, 720)
LIMBS = [16, 17, 18, 19, 20, 21, 1, 2, 4, 5, 7, 8]
NOISE_PX, NOISE_M = 1.5, 0.02


@dataclass(frozen=True)
class Filmed:
    """A walk through the picture, and its truth in the camera."""

    whole: Observations
    """All frames."""
    observed: Observations
    """Every third of them, and what follows of the same frames."""
    lifted: LiftedBody
    joints_camera_m: np.ndarray


@pytest.fixture(scope="module")
def filmed() -> Filmed:
    """A walk towards a camera that looks down a little, with detector-like noise."""
    motion = planted_walk(75)
    tilt = np.radians(12.0)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.diag([1.0, -1, -1]) @ matrix_from_axis_angle(np.array([-tilt, 0, 0]))
    T_world_camera[:3, 3] = [0.6, 1.7, 5.5]
    T_camera_world = invert_rigid(T_world_camera)
    points = true_keypoints(motion) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    joints = motion.joints_world_m @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    rng = np.random.default_rng(11)
    pixels = project(points, LENS)
    hips = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]
    # A landmark model sees a crop, which hides a part of the viewing ray's tilt.
    up_camera = np.tile(T_camera_world[:3, 1], (75, 1))
    R_camera_landmarks = landmark_rotation(pixels[:, hips].mean(1), LENS, up_camera)
    seen = np.einsum("tba,tkb->tka", R_camera_landmarks, points - points[:, hips].mean(1, keepdims=True))
    whole = Observations(
        motion.frame_time_s, np.ones(75, bool),
        pixels + rng.normal(0, NOISE_PX, pixels.shape), seen + rng.normal(0, NOISE_M, seen.shape),
        np.ones(pixels.shape[:2]), LENS, up_camera,
    )  # fmt: skip
    assert (points[..., 2] > 1).all()
    some = np.arange(0, 75, 3)
    observed = Observations(
        whole.frame_time_s[some], whole.valid[some], whole.keypoints_px[some], whole.keypoints_m[some],
        whole.weight[some], LENS, up_camera[some],
    )  # fmt: skip
    return Filmed(whole, observed, lift(whole, load_model("lifter")).rows(some), joints[some])


@pytest.fixture(scope="module")
def fitted(filmed: Filmed) -> FittedBody:
    return fit_body(filmed.observed, filmed.lifted, iterations=150)


def root_relative_error_m(fit: FittedBody, truth_m: np.ndarray) -> float:
    a, b = fit.joints_camera_m - fit.joints_camera_m[:, :1], truth_m - truth_m[:, :1]
    return float(np.linalg.norm((a - b)[:, LIMBS], axis=-1).mean())


def test_joints_are_recovered(filmed: Filmed, fitted: FittedBody) -> None:
    assert root_relative_error_m(fitted, filmed.joints_camera_m) < 0.03
    distance_m = np.linalg.norm(filmed.joints_camera_m[:, 0], axis=-1)
    root_m = np.linalg.norm(fitted.joints_camera_m[:, 0] - filmed.joints_camera_m[:, 0], axis=-1)
    assert (root_m / distance_m).max() < 0.06, "depth follows the body height prior within its 5 %"
    found, truth = fitted.joints_camera_m[:, 0], filmed.joints_camera_m[:, 0]
    assert np.abs(found[:, :2] - truth[:, :2] * (found[:, 2:] / truth[:, 2:])).max() < 0.03, "across the line of sight"


def test_fit_is_consistent_in_itself(fitted: FittedBody) -> None:
    joints_m, _ = forward_kinematics(fitted.R_parent_joint, fitted.translation_camera_m, fitted.rest_joints_m)
    np.testing.assert_allclose(joints_m, fitted.joints_camera_m, atol=1e-4)
    identity = np.tile(np.eye(3), (len(joints_m), 22, 1, 1))
    np.testing.assert_allclose(fitted.R_parent_joint @ np.swapaxes(fitted.R_parent_joint, -1, -2), identity, atol=1e-5)
    assert np.nanmedian(fitted.reprojection_px) < 3 * NOISE_PX
    assert fitted.shape.model == "anny"
    assert all(-1 <= value <= 1 for value in fitted.shape.parameters.values())
    assert all(fitted.shape.parameters[name] >= 0 for name in PHENOTYPES)


def test_fit_is_repeatable(filmed: Filmed) -> None:
    again = [fit_body(filmed.observed, filmed.lifted, iterations=5).joints_camera_m for _ in range(2)]
    np.testing.assert_array_equal(*again)


@pytest.fixture(autouse=True)
def static_background(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keypoints have no video; its background is that of a static camera."""
    nothing = BackgroundTracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    monkeypatch.setattr(background_tracks, "background_motion", lambda *_: BackgroundMotion(nothing, 0.0))


def as_stage_input(observed: Observations, focal_35mm: float = 0.0) -> tuple[VideoClip, PersonTracks]:
    """A clip and its tracks as the camera stage gets them."""
    o, count = observed, len(observed.valid)
    landmarks_px, landmarks_m = np.zeros((count, 33, 2)), np.zeros((count, 33, 3))
    landmarks_px[:, LANDMARK_ORDER], landmarks_m[:, LANDMARK_ORDER] = o.keypoints_px, o.keypoints_m
    track = PersonTrack(
        1, o.valid, np.ones(count), np.zeros((count, 4)), landmarks_px, landmarks_m, np.ones((count, 33)),
        np.zeros((count, 64, 64), np.uint8), np.zeros((count, 2, 3)),
    )  # fmt: skip
    source = SourceInfo("h264", "yuv420p", 1280, 720, 0, 1.0, 30.0, count, count, 2.5, focal_35mm)
    times = o.frame_time_s
    clip = VideoClip(PayloadFile(Path("none.mp4")), 1280, 720, 30.0, times, times, source, ((0.0, 2.5),), 0, ())
    return clip, PersonTracks((track,), (1,))


class SeenField:
    """A network that sees one camera in every picture."""

    def __init__(self, focal_px: float, up: np.ndarray, sigma_rad: float) -> None:
        ratio = focal_px / 720
        self._field = PerspectiveField(
            *field_of_camera(12, 20, 1280 / 720, ratio, up), np.full((12, 20), sigma_rad), np.full((12, 20), sigma_rad)
        )

    def field(self, image_rgb: np.ndarray) -> PerspectiveField:
        return self._field


UP = matrix_from_axis_angle(np.array([np.radians(12.0), 0, 0])) @ [0, -1.0, 0]
"""Of the camera of `filmed`."""


@pytest.fixture
def camera_of(filmed: Filmed, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[CameraEstimate, StageContext]]:
    """Runs the stage on keypoints and a perspective field, without a picture."""
    monkeypatch.setattr(image_camera, "read_frame", lambda *_: np.zeros((720, 1280, 3), np.uint8))

    def run(
        factor: float = 1.0, sigma_rad: float = 0.005, focal_35mm: float = 0.0, focal_px: float | None = None,
        rolled_deg: float = 0.0,
    ) -> tuple[CameraEstimate, StageContext]:  # fmt: skip
        clip, tracks = as_stage_input(filmed.whole, focal_35mm)
        up = matrix_from_axis_angle(np.array([0, 0, np.radians(rolled_deg)])) @ UP
        seen = SeenField(factor * FOCAL_PX, up, sigma_rad)
        ctx = StageContext(Path(), load_model=lambda name: seen if name == "seen" else load_model(name))
        return estimate_camera(clip, tracks, CameraConfig(focal_px=focal_px, camera_model="seen"), ctx), ctx

    return run


def test_the_users_focal_length_is_kept(camera_of: Callable[..., tuple[CameraEstimate, StageContext]]) -> None:
    known, _ = camera_of(focal_px=900.0)
    assert (known.intrinsics.fx_px, known.focal_source) == (900.0, "user")


@pytest.mark.parametrize(
    ("factor", "source"), [(1.0, "metadata"), (1.15, "metadata"), (4.0, "picture"), (0.3, "picture")]
)
def test_metadata_is_used_unless_the_picture_contradicts_it(
    camera_of: Callable[..., tuple[CameraEstimate, StageContext]], factor: float, source: str
) -> None:
    """A file that gives the true 4 mm of a phone's lens for its equivalent on full frame is off by 6."""
    camera, ctx = camera_of(focal_35mm=factor * FOCAL_PX * np.hypot(36, 24) / np.hypot(1280, 720))
    assert camera.focal_source == source
    contradicted = [text for text in ctx.warnings if "contradicts" in text]
    if source == "metadata":
        assert camera.intrinsics.fx_px == pytest.approx(factor * FOCAL_PX, rel=1e-4)
        assert not contradicted
    else:
        assert abs(np.log(camera.intrinsics.fx_px / FOCAL_PX)) < 0.2
        assert len(contradicted) == 1


@pytest.mark.parametrize(("sigma_rad", "share"), [(0.005, 1.0), (1.0, 0.0)])
def test_the_picture_is_believed_as_far_as_it_is_sure(
    camera_of: Callable[..., tuple[CameraEstimate, StageContext]], sigma_rad: float, share: float
) -> None:
    """A sure field of another lens is followed; an unsure one leaves the usual focal length and the people's up."""
    usual_px = 0.9 * 1280
    camera, _ = camera_of(factor=1.4, sigma_rad=sigma_rad)
    assert camera.focal_source == "picture"
    whole = np.log(1.4 * FOCAL_PX / usual_px)
    assert np.log(camera.intrinsics.fx_px / usual_px) / whole == pytest.approx(share, abs=0.1)
    off_rad = np.arccos(np.clip(camera.up_camera @ UP, -1, 1))
    assert off_rad < 2 * camera.up_sigma_rad
    assert off_rad < (0.01 if share == 1 else 0.15)
    assert camera.focal_sigma_ratio < 0.03 if share == 1 else 0.2 < camera.focal_sigma_ratio <= 0.3


@pytest.mark.parametrize(("rolled_deg", "named"), [(0.0, False), (25.0, True)])
def test_sources_of_gravity_that_disagree_are_named(
    camera_of: Callable[..., tuple[CameraEstimate, StageContext]], rolled_deg: float, named: bool
) -> None:
    """A picture that has gravity 25 degrees off, sure as it is, against people who stand."""
    camera, ctx = camera_of(rolled_deg=rolled_deg)
    assert any("up direction by the people" in text for text in ctx.warnings) == named
    told = {quality.key: quality.value for quality in ctx.qualities}
    assert (told["up_by_people_off"] > 12) == named
    assert told["up_by_image_off"] < 3
    assert (camera.up_sigma_rad > 0.005) == named


def test_gravity_is_seen_in_whom_the_lifter_is_sure_of(filmed: Filmed) -> None:
    """Somebody in an odd pose, seen for as long, hardly turns what a walker says of gravity; neither does a glimpse."""
    _, tracks = as_stage_input(filmed.whole)
    track = tracks.people[0].whole(len(filmed.whole.valid))
    frames = len(track.valid)
    upright, aslant = np.array([0.0, -1.0, 0.0]), np.array([np.sin(0.5), -np.cos(0.5), 0.0])

    def body(up: np.ndarray, error_m: float) -> LiftedBody:
        return LiftedBody(
            np.tile(np.eye(3), (frames, 22, 1, 1)), np.zeros((frames, 8)), np.tile(up, (frames, 1)),
            np.full((frames, 22), error_m),
        )  # fmt: skip

    still = np.tile(np.eye(3), (frames, 1, 1))
    found = up_by_lifter([(body(aslant, 0.06), track), (body(upright, 0.03), track)], still)
    assert np.arccos(found @ upright) < 0.05
    glimpse = replace(track, valid=np.arange(frames) == 3)
    found = up_by_lifter([(body(upright, 0.03), track), (body(aslant, 0.03), glimpse)], still)
    assert np.arccos(found @ upright) < 0.05
    assert np.linalg.norm(found) == pytest.approx(1.0)


def test_frames_without_landmarks_are_bridged(filmed: Filmed) -> None:
    o = filmed.observed
    valid = o.valid.copy()
    valid[[0, 10, 11]] = False
    pixels, points, weight = o.keypoints_px.copy(), o.keypoints_m.copy(), o.weight.copy()
    pixels[~valid], points[~valid], weight[~valid] = np.nan, np.nan, 0.0
    seen = replace(o, valid=valid, keypoints_px=pixels, keypoints_m=points, weight=weight)
    fit = fit_body(seen, filmed.lifted, iterations=120)
    assert np.isfinite(fit.joints_camera_m).all()
    assert np.isnan(fit.reprojection_px[~valid]).all()
    assert np.isfinite(fit.reprojection_px[valid]).all()
    gap_m = np.linalg.norm(fit.joints_camera_m[10:12, 0] - filmed.joints_camera_m[10:12, 0], axis=-1)
    assert gap_m.max() < 0.4


def test_nobody_is_refused(filmed: Filmed) -> None:
    o = filmed.observed
    with pytest.raises(StageError, match="at least one frame"):
        fit_body(replace(o, valid=~o.valid, weight=0 * o.weight), filmed.lifted)


def test_viewing_ray_rotation() -> None:
    pixels = np.array([[LENS.cx_px, LENS.cy_px], [100.0, 600.0], [1200.0, 10.0]])
    R = ray_rotation(pixels, LENS)
    np.testing.assert_allclose(R[0], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(project(R @ [0, 0, 1.0], LENS), pixels, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_landmarks_lie_between_the_viewing_ray_and_a_level_camera() -> None:
    """Whatever the camera's pitch, roll and lens, only the slope of the ray counts, and a part of it is undone."""
    away = np.array([0.3, -0.4, 1.0])
    angles = []
    for turned in ([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [-0.1, 0.1, 0.3]):
        R_camera_level = matrix_from_axis_angle(np.array(turned))
        ray, up_camera = (R_camera_level @ away)[None], (R_camera_level @ [0.0, -1.0, 0.0])[None]
        pixel = project(ray, LENS)
        R_ray_landmarks = ray_rotation(pixel, LENS)[0].T @ landmark_rotation(pixel, LENS, up_camera)[0]
        up_landmarks = R_ray_landmarks.T @ ray_rotation(pixel, LENS)[0].T @ up_camera[0]
        angles.append(np.degrees(np.arctan2(up_landmarks[2], np.linalg.norm(up_landmarks[:2]))))
    slope_deg = np.degrees(np.arctan2(0.4, np.hypot(0.3, 1.0)))
    np.testing.assert_allclose(angles, angles[0], atol=1e-6)
    assert 0.2 * slope_deg < abs(angles[0]) < 0.8 * slope_deg
    level = np.array([[100.0, LENS.cy_px]])
    np.testing.assert_allclose(
        landmark_rotation(level, LENS, np.array([[0.0, -1.0, 0.0]])), ray_rotation(level, LENS), atol=1e-9
    )


def test_landmark_table() -> None:
    """BlazePose GHUM numbering: left is even-odd paired, 11/12 shoulders, 23/24 hips, 31/32 toes."""
    for name, number in BLAZEPOSE_OF_KEYPOINT.items():
        if name.startswith("left") and "eye" not in name:
            assert BLAZEPOSE_OF_KEYPOINT[name.replace("left", "right")] == number + 1
    assert len(set(LANDMARK_ORDER)) == len(KEYPOINT_INDEX)
