"""Repairs after sampling: what slides stops, what is inside comes out, the rest stays."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scenemi.features import BODY_LENGTHS, FEATURE_COUNT, Statistics, encode
from scenemi.model.cleanup import Cleanup, penetration_cost
from scenemi.model.kinematics import Pose, joints_of, pose_of
from scenemi.scene.boxes import Boxes
from scenemi.scene.geometry import SceneGeometry
from scenemi.scene.grid import distance_grid
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.skeleton import JOINT_INDEX
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.motion import BodyShape

FRAMES = 61
BODY = shaped_body(BodyShape("anny", dict(ADULT)))
REST = torch.from_numpy(BODY.rest_joints_m).float()[None]
STATISTICS = Statistics(
    np.zeros(FEATURE_COUNT, np.float32), np.full(FEATURE_COUNT, 0.3, np.float32),
    np.zeros(BODY_LENGTHS, np.float32), np.ones(BODY_LENGTHS, np.float32),
)  # fmt: skip
LEGS = [JOINT_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("knee", "ankle", "foot")]


def gliding(speed_m_s: float) -> Tensor:
    """Normalized features of somebody with bent knees who glides along +z on both feet."""
    bend = np.zeros((FRAMES, 22, 3))
    for side in ("left", "right"):
        for part, angle in (("hip", -0.3), ("knee", 0.6), ("ankle", -0.3)):
            bend[:, JOINT_INDEX[f"{side}_{part}"], 0] = angle
    R = matrix_from_axis_angle(bend)
    feet = np.stack([np.zeros(FRAMES), np.zeros(FRAMES), speed_m_s * np.arange(FRAMES) / 30], -1)
    at_rest = encode(R, feet, BODY.rest_joints_m, np.eye(4))
    feet[:, 1] = 0.02 - at_rest[0, 135 + 3 * JOINT_INDEX["left_foot"] + 1]
    values = encode(R, feet, BODY.rest_joints_m, np.eye(4))
    return torch.from_numpy(STATISTICS.normalize(values)).float()[None]


def joints(x: Tensor) -> Tensor:
    return joints_of(STATISTICS.denormalize(x), REST)


def pose(x: Tensor) -> Pose:
    return pose_of(STATISTICS.denormalize(x), REST)


def feet_only(rounds: int = 1) -> Cleanup:
    return Cleanup(STATISTICS, REST, 30.0, foot_rounds=rounds, clear_rounds=0, clearing=None)


def test_feet_are_held_by_the_legs_alone() -> None:
    x = gliding(0.25)
    made = feet_only(3)(x)

    def slide(x: Tensor) -> float:
        return float(30 * joints(x)[0, :, JOINT_INDEX["left_foot"]].diff(dim=0).norm(dim=-1).median())

    assert slide(x) > 0.24
    assert slide(made) < 0.6 * slide(x)
    others = [j for j in range(22) if j not in LEGS]
    torch.testing.assert_close(joints(made)[:, :, others], joints(x)[:, :, others])
    torch.testing.assert_close(feet_only(0)(x), x)


def test_lifted_feet_are_left_alone() -> None:
    x = gliding(0.25)
    x[..., 1] += 0.4 / 0.3
    torch.testing.assert_close(feet_only()(x), x)


def test_the_body_leaves_a_box_but_not_where_a_keyframe_has_it() -> None:
    """A wall on the left in which the left hand is; one window has a keyframe that reaches in as deep."""
    x = gliding(0.0).repeat(2, 1, 1)
    wrist_x_m = float(joints(x[:1])[0, 0, JOINT_INDEX["left_wrist"], 0])
    wall = SceneGeometry.of(Boxes(np.array([[wrist_x_m + 0.95, 1, 0]]), np.array([[1.0, 2, 3]]), np.zeros(1)))
    base = pose(x)
    base.joints_m[0] -= torch.tensor([0.4, 0, 0])
    mask = torch.zeros(2, FRAMES)
    mask[:, 30] = 1
    cost = penetration_cost([wall, wall], [BODY, BODY], torch.eye(4).expand(2, 4, 4), base, mask)
    assert cost is not None
    depth_m = cost.depth_m(pose(x))
    assert float(depth_m[0]) > 0.08
    assert float(depth_m[1]) == 0
    made = Cleanup(STATISTICS, REST.expand(2, -1, -1), 30.0, foot_rounds=0, clear_rounds=3, clearing=cost)(x)
    assert float(cost.depth_m(pose(made))[0]) < 0.5 * float(depth_m[0])
    torch.testing.assert_close(made[1], x[1])
    assert penetration_cost([None], [BODY], torch.eye(4)[None], pose(x[:1]), mask[:1]) is None


def test_distances_are_signed_and_turn_with_the_canonical_frame() -> None:
    box = Boxes(np.array([[0.5, 0.4, 0.2]]), np.array([[0.3, 0.4, 0.5]]), np.array([0.4]))
    scene = SceneGeometry.of(box)
    grid = distance_grid(scene, np.array([-0.5, -0.2, -1]), np.array([1.5, 1.4, 1.4]))
    points_m = np.random.default_rng(0).uniform([-0.4, 0, -0.8], [1.4, 1.2, 1.2], (2000, 3))
    true_m, found_m = box.signed_distance(points_m[None])[0], grid.sample(points_m)
    near = true_m < 0.3
    assert np.abs(found_m - true_m)[near].max() < 0.06
    assert (np.sign(found_m) == np.sign(true_m))[np.abs(true_m) > 0.03].all()

    angle = np.array([0.0, 1.1, 0.0])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_axis_angle(angle), (2.0, 0.0, -1.0)
    x, mask = gliding(0.0), torch.zeros(1, FRAMES)
    here = penetration_cost([scene], [BODY], torch.eye(4)[None], pose(x), mask)
    there = penetration_cost([scene.transformed(T)], [BODY], torch.from_numpy(T).float()[None], pose(x), mask)
    assert here is not None
    assert there is not None
    assert float(here.depth_m(pose(x))) > 0.01
    torch.testing.assert_close(there.depth_m(pose(x)), here.depth_m(pose(x)), atol=1e-5, rtol=0)


def test_a_signed_distance_grid_is_read_in_the_world() -> None:
    """A wall at x > 4 of the world, seen from a canonical frame that is turned and shifted."""
    grid = SdfGrid(np.tile((4.0 - 0.1 * np.arange(60))[:, None, None], (1, 40, 40)), np.zeros(3), 0.1)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_axis_angle(np.array([0.0, 0.5 * np.pi, 0.0])), (3.6, 0.0, 2.0)
    x = gliding(0.0)
    cost = penetration_cost([grid], [BODY], torch.from_numpy(T).float()[None], pose(x), torch.zeros(1, FRAMES))
    assert cost is not None
    # Canonical +z is the world's +x: somebody 0.4 m before the wall, whose toes do not reach it, and then 0.3 m nearer.
    assert float(cost.depth_m(pose(x))) == 0
    nearer = x.clone()
    nearer[..., 2] += 0.3 / 0.3
    assert 0.0 < float(cost.depth_m(pose(nearer))) < 0.3
