"""The path of a moving camera, from points whose true motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from video2anim.camera.background_tracks import BackgroundTracks, track_background
from video2anim.camera.path import path_of_tracks
from video2anim.types import Intrinsics

FRAMES = 60
LENS = Intrinsics.centered(800.0, 960, 540)


def seen_by(
    turn: np.ndarray,
    center_m: np.ndarray,
    *,
    moving_ratio: float = 0.05,
    depths_m: tuple[float, float] = (2, 14),
    nearer_below: float = 0.0,
    seed: int = 0,
) -> BackgroundTracks:
    """Points at depths from 2 to 14 m, tracked with noise of 0.3 px while they are in the image. A share of them
    moves. Those that are lower by 1 m are nearer by `nearer_below`."""
    rng = np.random.default_rng(seed)
    points_m = np.c_[rng.uniform(-12, 12, 800), rng.uniform(-4, 2, 800), rng.uniform(*depths_m, 800)]
    points_m[:, 2] -= nearer_below * points_m[:, 1]
    speed_m = (rng.random(800) < moving_ratio)[:, None] * rng.normal(0.0, 0.03, (800, 3))
    number, made = np.full(800, -1), 0
    frames, points, pixels = [], [], []
    for frame, R in enumerate(Rotation.from_rotvec(turn).as_matrix()):
        x = (points_m + speed_m * frame - center_m[frame]) @ R
        pixel = x[:, :2] / np.maximum(x[:, 2:], 0.1) * LENS.fx_px + [LENS.cx_px, LENS.cy_px]
        visible = (x[:, 2] > 0.3) & ((pixel >= 0) & (pixel < [960, 540])).all(1) & (rng.random(800) > 0.01)
        new = visible & (number < 0)
        number[new] = made + np.arange(new.sum())
        made += int(new.sum())
        number[~visible] = -1
        frames.append(np.full(visible.sum(), frame))
        points.append(number[visible])
        pixels.append(pixel[visible] + rng.normal(0.0, 0.3, (visible.sum(), 2)))
    return BackgroundTracks(np.concatenate(frames), np.concatenate(points), np.concatenate(pixels))


def distorted(tracks: BackgroundTracks, coefficient: float) -> BackgroundTracks:
    """The same through a lens with a first radial coefficient."""
    middle_px = np.array([LENS.cx_px, LENS.cy_px])
    ray = (tracks.pixel - middle_px) / LENS.fx_px
    pixel = middle_px + LENS.fx_px * ray * (1 + coefficient * (ray**2).sum(1, keepdims=True))
    return BackgroundTracks(tracks.frame, tracks.point, pixel)


def turn_error_deg(T: np.ndarray, turn: np.ndarray) -> float:
    """Largest angle between estimated and true rotations."""
    off = Rotation.from_rotvec(turn).inv() * Rotation.from_matrix(T[:, :3, :3])
    return float(np.rad2deg(off.magnitude().max()))


t = np.arange(FRAMES)
still = np.zeros((FRAMES, 3))


@pytest.mark.parametrize(
    "turn", [still, np.c_[0.1 * np.sin(t / 20), 0.01 * t, 0 * t]], ids=["still", "pan of 34 degrees"]
)
def test_a_camera_that_turns_stays_where_it_is(turn: np.ndarray) -> None:
    path = path_of_tracks(seen_by(turn, still), FRAMES, LENS, 0.0)
    assert path.located.all()
    assert turn_error_deg(path.T_first_camera, turn) < 0.05
    assert not path.T_first_camera[:, :3, 3].any()
    assert path.residual_px < 0.8
    assert not path.faults(960)


@pytest.mark.parametrize(
    ("turn", "center_m"),
    [
        (np.c_[0 * t, 0.05 * np.sin(t / 15), 0 * t], np.c_[0.03 * t, 0 * t, 0 * t]),
        (np.c_[0.02 * np.sin(t / 4), 0.05 * np.sin(t / 15), 0 * t], np.c_[0 * t, 0.03 * np.sin(t / 5), 0.05 * t]),
    ],
    ids=["sideways", "forward"],
)
def test_a_camera_that_travels(turn: np.ndarray, center_m: np.ndarray) -> None:
    """Up to the unit of length, which images leave open."""
    path = path_of_tracks(seen_by(turn, center_m), FRAMES, LENS, 0.0)
    assert turn_error_deg(path.T_first_camera, turn) < 0.3
    found = path.T_first_camera[:, :3, 3]
    scale = (found * center_m).sum() / (found**2).sum()
    assert scale > 0
    assert np.linalg.norm(scale * found - center_m, axis=1).max() < 0.01 * np.abs(center_m).max()


@pytest.mark.parametrize("assumed", [0.7, 1.3])
@pytest.mark.parametrize(
    ("turn", "center_m"),
    [
        (np.c_[0 * t, 0.0015 * t, 0 * t], still),
        (np.c_[0 * t, 0.05 * np.sin(t / 15), 0 * t], np.c_[0.03 * t, 0 * t, 0 * t]),
        (np.c_[0.02 * np.sin(t / 4), 0.05 * np.sin(t / 15), 0 * t], np.c_[0 * t, 0.03 * np.sin(t / 5), 0.05 * t]),
    ],
    ids=["pan of 5 degrees", "sideways", "forward"],
)
def test_a_camera_that_turns_tells_its_focal_length(turn: np.ndarray, center_m: np.ndarray, assumed: float) -> None:
    """Images alone are off by 30 % outdoors. How a usual lens distorts is all that is left open."""
    wrong = Intrinsics.centered(assumed * LENS.fx_px, 960, 540)
    path = path_of_tracks(seen_by(turn, center_m), FRAMES, wrong, 1.0)
    assert abs(path.log_focal + np.log(assumed)) < 0.01
    assert 0.05 < path.focal_log_sigma < 0.1
    assert turn_error_deg(path.T_first_camera, turn) < 0.3


def test_motion_and_images_share_the_focal_length() -> None:
    """The mean of both, weighted by their variances."""
    wrong = Intrinsics.centered(1.3 * LENS.fx_px, 960, 540)
    tracks = seen_by(np.c_[0 * t, 0.0015 * t, 0 * t], still)
    alone, both = (path_of_tracks(tracks, FRAMES, wrong, sigma) for sigma in (10.0, 0.1))
    told = 1 / (1 + (alone.focal_log_sigma / 0.1) ** 2)
    assert 0.5 < told < 0.8
    assert both.log_focal == pytest.approx(told * alone.log_focal, rel=0.01)
    assert both.focal_log_sigma == pytest.approx(told**0.5 * alone.focal_log_sigma, rel=0.02)


@pytest.mark.parametrize(
    ("turn", "center_m"),
    [(still, still), (np.c_[0 * t, 0 * t, 0.01 * t], still), (still, np.c_[0 * t, 0 * t, 0.05 * t])],
    ids=["still", "roll", "forward"],
)
def test_motion_that_suits_any_lens_leaves_the_focal_length(turn: np.ndarray, center_m: np.ndarray) -> None:
    wrong = Intrinsics.centered(1.3 * LENS.fx_px, 960, 540)
    path = path_of_tracks(seen_by(turn, center_m), FRAMES, wrong, 0.15)
    assert abs(path.log_focal) < 0.01
    assert path.focal_log_sigma == pytest.approx(0.15, rel=0.05)


sideways_m = np.c_[0.02 * t, 0 * t, 0 * t]


def test_what_a_camera_travels_past_has_a_known_depth() -> None:
    """Points of the first frame are on its pixels, and as far apart in depth as they are."""
    tracks = seen_by(still, sideways_m, moving_ratio=0.0)
    path = path_of_tracks(tracks, FRAMES, LENS, 0.0)
    shown = path.points.in_first_frame
    first = path.points.place[shown]
    assert len(first) > 100
    assert not shown.all(), "others come into view later"
    pixel = first[:, :2] / first[:, 2:] * LENS.fx_px + [LENS.cx_px, LENS.cy_px]
    apart_px = np.linalg.norm(pixel[:, None] - tracks.pixel[tracks.frame == 0], axis=-1).min(1)
    assert apart_px.max() < 1.0
    unit_m = np.linalg.norm(sideways_m[-1]) / np.linalg.norm(path.T_first_camera[-1, :3, 3])
    depth_m = unit_m * first[:, 2]
    assert depth_m.min() > 1.8
    assert depth_m.max() < 16.0
    assert np.median(path.points.log_sigma[shown]) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_relief_is_not_turned_inside_out(seed: int) -> None:
    """A camera that sways around what it looks at shows much the same of a relief and of its opposite, if the lens is
    not what it is taken for."""
    sway_m = np.c_[0.3 * np.sin(t / 10), 0 * t, 0.15 * np.sin(t / 13)]
    turn = np.c_[0.01 * np.sin(t / 7), -sway_m[:, 0] / 9, 0 * t]
    seen = seen_by(turn, sway_m, moving_ratio=0.0, depths_m=(8.5, 9.5), nearer_below=1.0, seed=seed)
    shorter = Intrinsics.centered(0.8 * LENS.fx_px, 960, 540)
    path = path_of_tracks(distorted(seen, -0.1), FRAMES, shorter, 0.15)
    _, y, depth = path.points.place.T
    assert len(depth) > 50
    # Depth falls down the image: z = 9 m - y.
    assert np.corrcoef(np.log(depth), -np.log(1 + y / depth))[0, 1] > 0.9


@pytest.mark.parametrize("seed", range(3))
def test_a_small_way_around_something_is_no_evidence_of_another_lens(seed: int) -> None:
    """As a turn alone it would be explained by a third of the focal length."""
    sway_m = np.c_[0.15 * np.sin(t / 10), 0 * t, 0 * t]
    turn = np.c_[0 * t, -sway_m[:, 0] / 9, 0 * t]
    tracks = seen_by(turn, sway_m, moving_ratio=0.0, depths_m=(8.9, 9.1), nearer_below=1.0, seed=seed)
    path = path_of_tracks(tracks, FRAMES, LENS, 0.17)
    assert abs(path.log_focal) < path.focal_log_sigma


@pytest.mark.parametrize("distortion", [-0.1, 0.1])
@pytest.mark.parametrize("assumed", [0.8, 1.25])
def test_a_lens_that_distorts_makes_no_path_of_a_turn(assumed: float, distortion: float) -> None:
    turn = np.c_[0.02 * np.sin(t / 4), 0.05 * np.sin(t / 15), 0 * t]
    seen = seen_by(turn, still, moving_ratio=0.0)
    wrong = Intrinsics.centered(assumed * LENS.fx_px, 960, 540)
    path = path_of_tracks(distorted(seen, distortion), FRAMES, wrong, 0.15)
    assert not path.T_first_camera[:, :3, 3].any()
    assert len(path.points.place) == 0


def test_frames_without_background_are_interpolated_and_named() -> None:
    turn = np.c_[0 * t, 0.005 * t, 0 * t]
    tracks = seen_by(turn, still)
    kept = (tracks.frame < 20) | (tracks.frame > 22)
    path = path_of_tracks(
        BackgroundTracks(tracks.frame[kept], tracks.point[kept], tracks.pixel[kept]), FRAMES, LENS, 0.0
    )
    assert np.flatnonzero(~path.located).tolist() == [20, 21, 22]
    assert turn_error_deg(path.T_first_camera, turn) < 0.05
    assert path.faults(960) == ["3 of 60 frames show too little background to locate the camera"]


def test_a_background_that_no_path_explains_is_named() -> None:
    tracks = seen_by(still, still)
    rng = np.random.default_rng(0)
    scattered = tracks.pixel + rng.normal(0.0, 8.0, tracks.pixel.shape)
    path = path_of_tracks(BackgroundTracks(tracks.frame, tracks.point, scattered), FRAMES, LENS, 0.0)
    assert path.residual_px > 4
    assert "not reliable" in path.faults(960)[0]


def test_without_background_the_camera_stays() -> None:
    nothing = BackgroundTracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    path = path_of_tracks(nothing, FRAMES, LENS, 0.0)
    assert np.array_equal(path.T_first_camera, np.tile(np.eye(4), (FRAMES, 1, 1)))
    assert path.located.sum() == 1


def test_tracking_follows_an_image_that_moves() -> None:
    """Points keep their place on a textured plane to a fraction of a pixel, and none is on the person."""
    rng = np.random.default_rng(0)
    plane = cv2.GaussianBlur(rng.integers(0, 256, (400, 600, 3)).astype(np.uint8), (0, 0), 2)
    images = [cv2.warpAffine(plane, np.array([[1, 0, -2.3 * k], [0, 1, -1.1 * k]]), (480, 320)) for k in range(8)]
    person = np.zeros((160, 240), bool)
    person[40:120, 80:140] = True
    tracks = track_background(images, [person] * len(images))
    on_plane = tracks.pixel + tracks.frame[:, None] * [2.3, 1.1]
    for point in np.unique(tracks.point)[:50]:
        own = on_plane[tracks.point == point]
        assert np.linalg.norm(own - own[0], axis=1).max() < 0.3
    assert np.bincount(tracks.frame).min() > 100
    x, y = tracks.pixel.T
    assert not ((x > 164) & (x < 276) & (y > 84) & (y < 236)).any()
