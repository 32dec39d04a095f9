"""Frames of which the lifter says that it does not know the body."""

from __future__ import annotations

import numpy as np

from video2anim.body.anny_body import KEYPOINT_NAMES
from video2anim.geometry.rotations import axis_angle_from_matrix, rot6d_from_matrix
from video2anim.humans.lifter_input import CONTACT_OUTPUTS, ERROR_OUTPUTS, OUTPUTS
from video2anim.humans.lifting import lift
from video2anim.humans.problem import Observations
from video2anim.types import Intrinsics
from video2anim.types.skeleton import JOINT_INDEX

FRAMES = 12
ELBOW = JOINT_INDEX["left_elbow"]


def turned(angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def network(known: dict[int, float]):
    """Knows a body with a bent elbow in some frames, and says so; all others are nonsense with a large error."""

    def answer(features: np.ndarray) -> np.ndarray:
        output = np.random.default_rng(0).normal(size=(FRAMES, OUTPUTS))
        output[:, ERROR_OUTPUTS], output[:, CONTACT_OUTPUTS] = 0.4, 5.0
        for frame, angle_rad in known.items():
            R = np.tile(np.eye(3), (22, 1, 1))
            R[ELBOW] = turned(angle_rad)
            output[frame, :132] = rot6d_from_matrix(R).reshape(-1)
            output[frame, ERROR_OUTPUTS] = np.log(0.03)
        return output

    return answer


def seen(valid: np.ndarray) -> Observations:
    """Somebody in the middle of the picture, so that the viewing ray is the optical axis."""
    lens, count = Intrinsics.centered(500.0, 640, 480), len(KEYPOINT_NAMES)
    pixels = np.tile([lens.cx_px, lens.cy_px], (FRAMES, count, 1)).astype(float)
    return Observations(
        np.arange(FRAMES) / 30, valid, pixels, np.zeros((FRAMES, count, 3)), np.ones((FRAMES, count)), lens
    )  # fmt: skip


def elbow_rad(R_parent_joint: np.ndarray) -> np.ndarray:
    return axis_angle_from_matrix(R_parent_joint[:, ELBOW])[:, 0]


def test_unknown_bodies_are_between_known_ones() -> None:
    """0.2 rad in frame 3 and 1.0 in frame 7; the same as these before and after."""
    found = lift(seen(np.ones(FRAMES, bool)), network({3: 0.2, 7: 1.0}))
    wanted = np.interp(np.arange(FRAMES), [3, 7], [0.2, 1.0])
    np.testing.assert_allclose(elbow_rad(found.R_parent_joint), wanted, atol=1e-6)
    assert (found.contact[[3, 7]] > 0.9).all()
    assert (np.delete(found.contact, [3, 7], axis=0) == 0).all(), "nor what it touches"
    assert (found.error_m[[0, 5, 11]] > 1.0).all(), "the error stays"


def test_one_known_body_is_that_of_all_others() -> None:
    found = lift(seen(np.ones(FRAMES, bool)), network({4: 0.7}))
    np.testing.assert_allclose(elbow_rad(found.R_parent_joint), 0.7, atol=1e-6)


def test_bodies_stay_where_all_or_none_are_known() -> None:
    every = {frame: 0.1 * frame for frame in range(FRAMES)}
    found = lift(seen(np.ones(FRAMES, bool)), network(every))
    np.testing.assert_allclose(elbow_rad(found.R_parent_joint), list(every.values()), atol=1e-6)
    none = lift(seen(np.ones(FRAMES, bool)), network({}))
    assert np.ptp(elbow_rad(none.R_parent_joint)) > 0.5


def test_frames_without_a_person_are_not_known() -> None:
    """Whatever the network says of them."""
    valid = np.ones(FRAMES, bool)
    valid[7] = False
    found = lift(seen(valid), network({3: 0.2, 7: 1.0}))
    np.testing.assert_allclose(elbow_rad(found.R_parent_joint), 0.2, atol=1e-6)
