from __future__ import annotations

import numpy as np
import pytest

from scenemi.features import (
    BODY_LENGTHS,
    FEATURE_COUNT,
    JOINTS,
    LEVEL_X,
    LEVEL_Z,
    Statistics,
    body_lengths,
    canonical_frame,
    decode,
    encode,
    to_world,
)
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types import BodyShape
from video2anim.types.skeleton import forward_kinematics

BODY = shaped_body(BodyShape("anny", dict(ADULT)))
REST = BODY.rest_joints_m


def motion(seed: int = 0, frames: int = 12) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    R = matrix_from_axis_angle(0.4 * rng.standard_normal((frames, 22, 3)))
    R[:, 0] = matrix_from_axis_angle(np.array([0.0, 2.1, 0.0])) @ R[:, 0]
    return R, np.array([3.0, 0.9, -2.0]) + np.cumsum(0.02 * rng.standard_normal((frames, 3)), 0)


def test_there_and_back() -> None:
    R, translation = motion()
    x = encode(R, translation, REST)
    assert x.shape == (12, FEATURE_COUNT)
    back = to_world(*decode(x), canonical_frame(R[0, 0], translation[0]))
    np.testing.assert_allclose(back[0], R, atol=1e-9)
    np.testing.assert_allclose(back[1], translation, atol=1e-9)


def test_first_frame_stands_over_the_origin_and_faces_z() -> None:
    R, translation = motion(3)
    x = encode(R, translation, REST)
    np.testing.assert_allclose(x[0, [0, 2]], 0.0, atol=1e-12)
    np.testing.assert_allclose(x[:, 1], translation[:, 1], atol=1e-12)
    facing = decode(x)[0][0, 0][:, 2]
    assert abs(facing[0]) < 1e-9
    assert facing[2] > 0


def test_where_the_motion_happens_and_which_way_it_faces_does_not_matter() -> None:
    R, translation = motion(1)
    yaw = matrix_from_axis_angle(np.array([0.0, -1.3, 0.0]))
    moved = R.copy()
    moved[:, 0] = yaw @ R[:, 0]
    there = encode(moved, translation @ yaw.T + [5.0, 0.0, 7.0], REST)
    np.testing.assert_allclose(there, encode(R, translation, REST), atol=1e-9)


def test_joint_columns_are_forward_kinematics() -> None:
    x = encode(*motion(2), REST)
    joints, _ = forward_kinematics(*decode(x), REST)
    np.testing.assert_allclose(x[:, JOINTS].reshape(-1, 22, 3), joints, atol=1e-9)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_a_lying_body_has_a_frame(pitch: float) -> None:
    """Face up and face down the head lies along -z or +z of the frame, never an undefined direction."""
    for yaw in (0.0, 1.0, 3.0):
        R = matrix_from_axis_angle(np.array([0.0, yaw, 0.0])) @ matrix_from_axis_angle(np.array([pitch, 0.0, 0.0]))
        T = canonical_frame(R, np.zeros(3))
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        head = T[:3, :3].T @ R @ np.array([0.0, 1.0, 0.0])
        np.testing.assert_allclose(head, [0.0, 0.0, np.sign(pitch)], atol=1e-6)


def test_statistics_undo_themselves_and_are_of_their_data() -> None:
    x = np.concatenate([encode(*motion(seed), REST) for seed in range(6)])
    lengths = body_lengths(BODY)
    statistics = Statistics.of(x, np.stack([lengths, 1.1 * lengths]))
    z = statistics.normalize(x)
    wide = x.std(0) > 0.1
    wide[[*LEVEL_X, *LEVEL_Z]] = False
    np.testing.assert_allclose(z[:, wide].std(0), 1.0, atol=1e-3)
    np.testing.assert_array_equal(statistics.std[LEVEL_X], statistics.std[LEVEL_Z])
    np.testing.assert_allclose(z.mean(0), 0.0, atol=1e-4)
    np.testing.assert_allclose(statistics.denormalize(z), x, atol=1e-5)


def test_body_lengths_of_an_adult_are_an_adults() -> None:
    lengths = body_lengths(BODY)
    assert lengths.shape == (BODY_LENGTHS,)
    head, shoulders, arm, hips, leg, chest, hip = lengths
    assert 0.5 < head < 0.8
    assert 0.25 < shoulders < 0.45
    assert 0.45 < arm < 0.65
    assert 0.1 < hips < 0.3
    assert 0.75 < leg < 1.0
    assert 0.15 < chest < 0.4
    assert 0.12 < hip < 0.4
    heavy = body_lengths(shaped_body(BodyShape("anny", {**ADULT, "weight": 0.9})))
    assert (heavy[5:] > lengths[5:]).all()
