"""The scale of a moving camera's path by feet that stand."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.humans.camera_scale import camera_scale_m
from video2anim.humans.lifter_input import CONTACT_INDEX

FRAMES, FPS = 90, 30.0


def walk(speed_m: float) -> tuple[np.ndarray, np.ndarray]:
    """World joints and contacts of somebody who walks along x, 4 m ahead; one foot stands, the other swings."""
    joints_m = np.tile([0.0, 0.0, 4.0], (FRAMES, 22, 1))
    joints_m[:, :, 0] += speed_m * np.arange(FRAMES)[:, None]
    contact = np.zeros((FRAMES, 8))
    for foot in range(2):
        phase = (np.arange(FRAMES) + 15 * foot) // 15
        stands = phase % 2 == 0
        place = speed_m * 15 * (phase + 1 - foot)
        joints_m[:, CONTACT_INDEX[foot], 0] = np.where(stands, place, joints_m[:, CONTACT_INDEX[foot], 0])
        contact[:, foot] = stands
    return joints_m, contact


def scale_of(joints_m: np.ndarray, contact: np.ndarray, T: np.ndarray, unit_m: float) -> tuple[float, float]:
    """The estimate for a camera whose path is given in units of `unit_m`."""
    path = T.copy()
    path[:, :3, 3] /= unit_m
    joints_camera_m = transform_points(invert_rigid(T), joints_m)
    return camera_scale_m(joints_camera_m, contact, np.ones(FRAMES, bool), path, FPS)


@pytest.mark.parametrize("unit_m", [2.0, 7.0])
def test_standing_feet_give_the_scale(unit_m: float) -> None:
    joints_m, contact = walk(0.04)
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, 0, 3] = 0.04 * np.arange(FRAMES)
    scale_m, log_sigma = scale_of(joints_m, contact, T, unit_m)
    assert scale_m == pytest.approx(unit_m, rel=0.02)
    assert log_sigma < 0.1


def test_without_rests_it_is_the_usual_one_and_unsure() -> None:
    joints_m, contact = walk(0.04)
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, 0, 3] = 0.04 * np.arange(FRAMES)
    scale_m, log_sigma = scale_of(joints_m, 0 * contact, T, 9.0)
    assert scale_m == pytest.approx(4.0, rel=0.01)
    assert log_sigma == pytest.approx(0.7, rel=0.01)


def test_a_camera_that_only_turns_has_no_scale_to_find() -> None:
    joints_m, contact = walk(0.04)
    assert scale_of(joints_m, contact, np.tile(np.eye(4), (FRAMES, 1, 1)), 1.0)[1] == pytest.approx(0.7)
