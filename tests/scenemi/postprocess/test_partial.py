"""Partial keyframes in the solve: places, path and pinned feet are met, whole poses stay, and no jerk is added."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import FPS, planted_walk

from scenemi.animation.partial_motion import missed
from scenemi.longmotion import KeyframeMotion
from scenemi.metrics import jerk_m_s3
from scenemi.postprocess.in_scene import OBSERVED, put_in_scene
from scenemi.postprocess.motion_solve import JointTargets
from scenemi.postprocess.partial import PartialKeyframes, PinnedFoot
from scenemi.prior import KeyframeWindow, WindowMotion
from scenemi.scene.geometry import SceneGeometry
from video2anim.body.anny_body import shaped_body
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

FRAMES = 61
WRIST, PELVIS = JOINT_INDEX["right_wrist"], JOINT_INDEX["pelvis"]
WALK = planted_walk(FRAMES)


def nothing_asked() -> tuple[np.ndarray, np.ndarray]:
    return np.full((FRAMES, 22, 3), np.nan), np.full((FRAMES, 2), np.nan)


def solved(partial: PartialKeyframes) -> np.ndarray:
    """Joints of the walk after the solve; first and last frame are whole poses."""
    made = WindowMotion(WALK.R_parent_joint, WALK.T_world_root[:, :3, 3])
    ends = np.isin(np.arange(FRAMES), (0, FRAMES - 1))
    given = KeyframeWindow(
        made.R_parent_joint, made.translation_world_m, ends, WALK.rest_joints_m, FPS, SceneGeometry.floor(),
        body=shaped_body(WALK.shape),
    )  # fmt: skip
    found = put_in_scene(made, given, OBSERVED, partial)
    motion = KeyframeMotion(made.R_parent_joint, made.translation_world_m, ends, WALK.rest_joints_m)
    assert missed(found, motion, partial) == []
    for now, before in (
        (found.R_parent_joint, made.R_parent_joint),
        (found.translation_world_m, made.translation_world_m),
    ):
        np.testing.assert_allclose(now[ends], before[ends], atol=1e-9)
    joints_m, _ = forward_kinematics(found.R_parent_joint, found.translation_world_m, WALK.rest_joints_m)
    assert jerk_m_s3(joints_m, FPS) < 1.2 * jerk_m_s3(WALK.joints_world_m, FPS)
    return joints_m


def test_a_hand_goes_where_it_is_wanted_and_the_rest_stays() -> None:
    position_m, path_m = nothing_asked()
    position_m[30, WRIST] = WALK.joints_world_m[30, WRIST] + [-0.1, 0.25, 0.15]
    joints_m = solved(PartialKeyframes(position_m, path_m))
    assert np.linalg.norm(joints_m[30, WRIST] - position_m[30, WRIST]) < 0.005
    assert np.linalg.norm(joints_m - WALK.joints_world_m, axis=-1)[:, PELVIS].max() < 0.08


def test_one_coordinate_may_be_wanted_alone() -> None:
    position_m, path_m = nothing_asked()
    position_m[30, WRIST, 1] = WALK.joints_world_m[30, WRIST, 1] + 0.2
    joints_m = solved(PartialKeyframes(position_m, path_m))
    assert abs(joints_m[30, WRIST, 1] - position_m[30, WRIST, 1]) < 0.005


def test_the_pelvis_follows_its_path() -> None:
    position_m, path_m = nothing_asked()
    bend_m = 0.2 * np.sin(np.linspace(0, np.pi, FRAMES)) ** 2
    path_m[:] = WALK.joints_world_m[:, PELVIS][:, [0, 2]] + np.stack([bend_m, 0 * bend_m], -1)
    joints_m = solved(PartialKeyframes(position_m, path_m))
    assert np.linalg.norm(joints_m[:, PELVIS][:, [0, 2]] - path_m, axis=1).max() < 0.05


@pytest.mark.parametrize(("side", "swings_m"), [(0, 0.02), (1, 0.2)])
def test_a_pinned_foot_does_not_slide(side: int, swings_m: float) -> None:
    """In the walk it swings meanwhile."""
    position_m, path_m = nothing_asked()
    joints_m = solved(PartialKeyframes(position_m, path_m, (PinnedFoot(side, 10, 20),)))
    foot = [JOINT_INDEX[f"{('left', 'right')[side]}_{name}"] for name in ("ankle", "foot")]
    before_m, moved_m = (
        np.linalg.norm(np.ptp(one[10:21][:, foot][..., [0, 2]], axis=0), axis=-1)
        for one in (WALK.joints_world_m, joints_m)
    )
    assert before_m.min() > swings_m
    assert moved_m.max() < 0.01


def test_a_foot_is_pinned_where_a_whole_pose_has_it() -> None:
    position_m, path_m = nothing_asked()
    partial = PartialKeyframes(position_m, path_m, (PinnedFoot(0, 5, 20),))
    fixed = np.arange(FRAMES) == 12
    found = partial.targets(WALK.joints_world_m, fixed)
    ankle = JOINT_INDEX["left_ankle"]
    np.testing.assert_array_equal(found.position_m[5:21, ankle, 0], WALK.joints_world_m[12, ankle, 0])
    assert np.isinf(found.sigma_m[4, ankle]).all()
    assert np.isinf(found.sigma_m[5, ankle, 1])
    assert (partial.contact[5:21, ankle] == 1).all()
    assert partial.contact.sum() == 32


def test_what_is_not_met_is_told() -> None:
    position_m, path_m = nothing_asked()
    position_m[30, WRIST], path_m[40] = 9.0, 9.0
    partial = PartialKeyframes(position_m, path_m, (PinnedFoot(0, 0, 60),))
    motion = KeyframeMotion(WALK.R_parent_joint, WALK.T_world_root[:, :3, 3], np.ones(FRAMES, bool), WALK.rest_joints_m)
    notes = missed(WindowMotion(motion.R_parent_joint, motion.translation_world_m), motion, partial)
    assert [note.split(" is ")[0].split(" slides")[0] for note in notes] == [
        "right_wrist",
        "the pelvis",
        "the left foot",
    ]


def test_impossible_targets_are_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        JointTargets(np.zeros((1, 22, 3)), np.zeros((1, 22, 3)))
