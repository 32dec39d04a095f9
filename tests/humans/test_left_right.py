"""Left taken for right for a moment is set right; turning people and longer stretches are left alone."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.body.anny_body import KEYPOINT_NAMES
from video2anim.humans.landmarks import MIRROR_KEYPOINT
from video2anim.humans.left_right import left_right_flips

FRAMES, FPS = 90, 30.0


def walker() -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (pixels, meters) of a body that turns once about itself in three seconds while it walks."""
    rng = np.random.default_rng(0)
    side = np.array([-1.0 if n.startswith("right") else 1.0 if n.startswith("left") else 0.0 for n in KEYPOINT_NAMES])
    rest = np.stack([0.22 * side, rng.uniform(-0.8, 0.8, len(side)), 0.05 * rng.normal(size=len(side))], 1)
    rest[MIRROR_KEYPOINT, 1] = rest[:, 1]
    angle = 2 * np.pi * np.arange(FRAMES) / FRAMES
    turn = np.stack([np.cos(angle), 0 * angle, np.sin(angle), 0 * angle, 1 + 0 * angle, 0 * angle,
                     -np.sin(angle), 0 * angle, np.cos(angle)], 1).reshape(-1, 3, 3)  # fmt: skip
    points = np.einsum("tab,kb->tka", turn, rest) + rng.normal(0, 0.01, (FRAMES, len(side), 3))
    pixels = 200.0 * points[..., :2] + np.array([300.0, 200.0]) + np.arange(FRAMES)[:, None, None] * [2.0, 0.0]
    return pixels, points


def found(pixels: np.ndarray, points: np.ndarray, valid: np.ndarray | None = None) -> list[int]:
    valid = np.ones(FRAMES, bool) if valid is None else valid
    weight = np.where(valid[:, None], 1.0, 0.0) * np.ones(len(KEYPOINT_NAMES))
    return np.flatnonzero(left_right_flips(pixels, points, weight, valid, np.arange(FRAMES) / FPS)).tolist()


@pytest.mark.parametrize("wrong", [[], [5, 6, 7], [0, 1, 2], [40], [3, 4, 60, 61, 62], [87, 88, 89]])
def test_exchanged_frames_are_found_and_no_others(wrong: list[int]) -> None:
    pixels, points = walker()
    for values in (pixels, points):
        values[wrong] = values[wrong][:, MIRROR_KEYPOINT]
    assert found(pixels, points) == wrong


def test_a_long_stretch_may_be_somebody_who_turned_unseen() -> None:
    pixels, points = walker()
    for values in (pixels, points):
        values[:40] = values[:40][:, MIRROR_KEYPOINT]
    assert found(pixels, points) == []


def test_gaps_and_few_frames() -> None:
    pixels, points = walker()
    valid = np.ones(FRAMES, bool)
    valid[10:13] = False
    pixels[10:13] = points[10:13] = np.nan
    assert found(pixels, points, valid) == []
    assert found(pixels, points, np.arange(FRAMES) < 2) == []
