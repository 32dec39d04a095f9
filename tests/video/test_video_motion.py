"""Static-camera test against known camera motion."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from video2anim.camera.background_registration import BackgroundRegistration, CameraMotion

WIDTH, HEIGHT = 480, 300


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A textured wall larger than the picture."""
    rng = np.random.default_rng(5)
    wall = np.full((600, 1200, 3), 120, np.uint8)
    for _ in range(900):
        x, y = rng.integers(0, 1200), rng.integers(0, 600)
        w, h = rng.integers(4, 40, 2)
        cv2.rectangle(wall, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 256, 3).tolist(), -1)
    return cv2.GaussianBlur(wall, (0, 0), 1.0)


def seen(wall: np.ndarray, shift_px: tuple[float, float], zoom: float = 1.0, person_x: int | None = None) -> np.ndarray:
    """The wall through a camera that has moved; a moving person covers a fifth of the picture."""
    H = np.array([[zoom, 0, -200 * zoom - shift_px[0]], [0, zoom, -100 * zoom - shift_px[1]]])
    picture = cv2.warpAffine(wall, H, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    if person_x is not None:
        rng = np.random.default_rng(9)
        person = cv2.resize(rng.integers(0, 256, (40, 15, 3), dtype=np.uint8), (100, 250))
        picture[40:290, person_x : person_x + 100] = person
    noise = np.random.default_rng(int(shift_px[0] * 7 + 1) % 97).normal(0, 2, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def test_static_camera_with_a_moving_person(wall: np.ndarray) -> None:
    motion = CameraMotion()
    for i in range(8):
        motion.add(seen(wall, (0, 0), person_x=20 + 40 * i))
    assert motion.drift_ratio < 0.0005


def test_drift_is_measured(wall: np.ndarray) -> None:
    motion = CameraMotion()
    for i in range(6):
        motion.add(seen(wall, (6.0 * i, 0.0), person_x=20 + 40 * i))
    assert motion.drift_ratio == pytest.approx(30 / WIDTH, rel=0.02)


def test_a_camera_that_leaves_the_first_view_is_followed(wall: np.ndarray) -> None:
    motion = CameraMotion()
    for i in range(9):
        motion.add(seen(wall, (60.0 * i, 0.0)))
    assert motion.drift_ratio == pytest.approx(480 / WIDTH, rel=0.05)


def test_registration_maps_the_frame_onto_the_first(wall: np.ndarray) -> None:
    registration = BackgroundRegistration(seen(wall, (0, 0)))
    found = registration.register(seen(wall, (8.0, -5.0), zoom=1.05))
    assert found is not None
    # A wall point lies at 1.0 * (w - offset) in the first picture and 1.05 * (w - offset) - shift in the second.
    frame_px = np.array([[100.0, 50.0, 1.0], [400.0, 250.0, 1.0]])
    want_px = (frame_px[:, :2] + [8.0, -5.0]) / 1.05
    moved = frame_px @ found.H_reference_frame.T
    assert np.abs(moved[:, :2] / moved[:, 2:] - want_px).max() < 0.3


def test_nothing_to_see_is_nan() -> None:
    motion = CameraMotion()
    for _ in range(4):
        motion.add(np.full((HEIGHT, WIDTH, 3), 127, np.uint8))
    assert math.isnan(motion.drift_ratio)
    assert math.isnan(CameraMotion().drift_ratio) or CameraMotion().drift_ratio == 0.0
