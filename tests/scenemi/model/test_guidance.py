"""Each extra cost lowers itself on a small example, and leaves alone what it should."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT, Statistics, encode
from scenemi.model.guidance import ContactCost, Cost, Guidance, KeyframeCost, PenetrationCost, smoothed_over_time
from scenemi.model.kinematics import Pose, joints_of, pose_of
from scenemi.scene.body_balls import BodyBalls
from video2anim.body.skeleton import JOINT_INDEX

FRAMES = 40
STATISTICS = Statistics(
    np.zeros(FEATURE_COUNT, np.float32), np.full(FEATURE_COUNT, 0.3, np.float32),
    np.zeros(BODY_LENGTHS, np.float32), np.ones(BODY_LENGTHS, np.float32),
)  # fmt: skip


def rest() -> np.ndarray:
    """A plain T-pose, pelvis at the origin."""
    joints = np.zeros((22, 3))
    places = {
        "left_hip": (0.1, -0.05, 0), "right_hip": (-0.1, -0.05, 0), "left_knee": (0.1, -0.45, 0),
        "right_knee": (-0.1, -0.45, 0), "left_ankle": (0.1, -0.82, 0), "right_ankle": (-0.1, -0.82, 0),
        "left_foot": (0.1, -0.88, 0.12), "right_foot": (-0.1, -0.88, 0.12), "spine1": (0, 0.1, 0),
        "spine2": (0, 0.2, 0), "spine3": (0, 0.3, 0), "neck": (0, 0.45, 0), "head": (0, 0.6, 0),
        "left_collar": (0.05, 0.42, 0), "right_collar": (-0.05, 0.42, 0), "left_shoulder": (0.18, 0.42, 0),
        "right_shoulder": (-0.18, 0.42, 0), "left_elbow": (0.45, 0.42, 0), "right_elbow": (-0.45, 0.42, 0),
        "left_wrist": (0.7, 0.42, 0), "right_wrist": (-0.7, 0.42, 0),
    }  # fmt: skip
    for name, place in places.items():
        joints[JOINT_INDEX[name]] = place
    return joints


REST = torch.from_numpy(rest()).float()[None]


def standing(drift_m_s: float = 0.0, height_m: float = 0.9) -> Tensor:
    """Normalized features (1, N, 201) of somebody upright who glides forward."""
    R = np.broadcast_to(np.eye(3), (FRAMES, 22, 3, 3)).copy()
    translation_m = np.stack([np.zeros(FRAMES), np.full(FRAMES, height_m), drift_m_s * np.arange(FRAMES) / 30], -1)
    values = encode(R, translation_m, rest(), np.eye(4))
    return torch.from_numpy(STATISTICS.normalize(values)).float()[None]


def joints(x: Tensor) -> Tensor:
    return joints_of(STATISTICS.denormalize(x), REST)


def pose(x: Tensor) -> Pose:
    return pose_of(STATISTICS.denormalize(x), REST)


def guide(x: Tensor, cost: Cost, iterations: int = 10) -> Tensor:
    return Guidance(STATISTICS, REST, [cost], iterations=iterations)(x)


def test_standing_feet_stop_gliding() -> None:
    x = standing(drift_m_s=0.3)
    made = guide(x, ContactCost(30.0))

    def glide(x: Tensor) -> float:
        feet = joints(x)[0, :, [JOINT_INDEX["left_ankle"], JOINT_INDEX["left_foot"]]]
        return float(30 * feet.diff(dim=0).norm(dim=-1).mean())

    assert glide(x) > 0.29
    assert glide(made) < 0.7 * glide(x)


def test_feet_in_the_air_are_left_alone() -> None:
    x = standing(drift_m_s=0.3, height_m=1.4)
    torch.testing.assert_close(guide(x, ContactCost(30.0)), x, rtol=0, atol=0)


def test_a_body_in_a_wall_moves_out_of_it() -> None:
    """The wall fills x > 0.5, and the left arm reaches in; balls of the hand may be as deep as allowed."""

    def wall(points_m: Tensor) -> Tensor:
        return 0.5 - points_m[..., 0]

    hand = BodyBalls(
        np.array([JOINT_INDEX["left_wrist"], JOINT_INDEX["left_elbow"]]), np.zeros((2, 3), np.float32),
        np.array([0.03, 0.04], np.float32),
    )  # fmt: skip
    x = standing()
    none = torch.zeros(2)
    cost = PenetrationCost([wall], [hand], [none])
    assert float(cost.depth_m(pose(x))[0]) == pytest.approx(0.23, abs=1e-5)
    made = guide(x, cost, 30)
    assert float(cost.depth_m(pose(made))[0]) < 0.5 * 0.23
    deep = PenetrationCost([wall], [hand], [torch.full((2,), 0.3)])
    for unmoved in (PenetrationCost([None], [hand], [none]), deep):
        torch.testing.assert_close(guide(x, unmoved), x, rtol=0, atol=0)
        assert float(unmoved.depth_m(pose(x))[0]) == 0


def test_keyframes_pull_their_frames() -> None:
    x, goal = standing(), standing(height_m=1.0)
    mask = torch.zeros(1, FRAMES)
    mask[0, [5, 30]] = 1
    made = guide(x, KeyframeCost(joints(goal), mask), 20)
    error_m = (joints(made) - joints(goal)).norm(dim=-1).mean(-1)[0]
    assert error_m[[5, 30]].max() < 0.05
    assert error_m[18] > 0.08


def test_two_windows_are_guided_apart() -> None:
    calm, gliding = standing(), standing(drift_m_s=0.3)
    both = Guidance(STATISTICS, REST.expand(2, -1, -1), [ContactCost(30.0)])(torch.cat([calm, gliding]))
    torch.testing.assert_close(both[:1], calm, rtol=0, atol=0)
    torch.testing.assert_close(both[1:], guide(gliding, ContactCost(30.0), 3), rtol=0, atol=1e-5)


def test_smoothing_is_symmetric_and_positive() -> None:
    """So a smoothed gradient is a direction of descent."""
    matrix = smoothed_over_time(torch.eye(FRAMES)[None], 2.0)[0]
    torch.testing.assert_close(matrix, matrix.T, rtol=0, atol=1e-6)
    assert torch.linalg.eigvalsh(matrix.double()).min() > -1e-6
