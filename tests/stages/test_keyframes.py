"""Keyframe optimization on a walk with known truth, seen from above: floor, a box in the way, gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from keyframe_problem import optimize, quality, root_m, scene
from synthetic import planted_walk, rotation, with_root_shift

from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.motion import keyframe_points, keyframe_problem
from video2anim.motion.keyframe_points import TOUCHING
from video2anim.types import BodyMotion
from video2anim.types.skeleton import JOINT_INDEX

FRAMES = 91
CAMERA_M = np.array([3.0, 3.0, 1.0])


def walk(frames: int = FRAMES) -> BodyMotion:
    """A walk that a camera above its left side looks down on."""
    motion = planted_walk(frames)
    down = rotation("x", np.array(np.deg2rad(-35.0)))
    T = np.eye(4)
    T[:3, :3] = motion.T_world_camera[0, :3, :3] @ down
    T[:3, 3] = CAMERA_M
    return replace(motion, T_world_camera=np.tile(T, (frames, 1, 1)))


def along_sight(motion: BodyMotion, way_m: np.ndarray | float) -> BodyMotion:
    """The motion with its roots farther from the camera by so much."""
    away_m = root_m(motion) - CAMERA_M
    direction = away_m / np.linalg.norm(away_m, axis=1, keepdims=True)
    return with_root_shift(motion, np.broadcast_to(way_m, len(direction))[:, None] * direction)


def off_m(found: BodyMotion, truth: BodyMotion) -> np.ndarray:
    """Distance of the roots (T,)."""
    return np.linalg.norm(root_m(found) - root_m(truth), axis=1)


def test_a_body_sunk_into_the_floor_is_put_on_it() -> None:
    truth = walk()
    sunk = along_sight(truth, 0.10 + 0.02 * np.sin(0.1 * np.arange(FRAMES)))
    done, ctx = optimize(sunk, scene(), REGULARIZATION=0.2)
    assert off_m(done.people[0], truth).mean() < 0.02
    assert quality(ctx, "penetration_max_after") < 0.25 * quality(ctx, "penetration_max_before")
    assert quality(ctx, "contact_distance_after") < 0.2 * quality(ctx, "contact_distance_before")


def test_a_floating_body_comes_down_by_its_contacts() -> None:
    truth = walk()
    done, _ = optimize(along_sight(truth, -0.10), scene(), REGULARIZATION=0.05)
    assert off_m(done.people[0], truth).max() < 0.04


def test_the_body_stays_where_the_picture_shows_it() -> None:
    """Whatever the scene says, roots go along their lines of sight."""
    truth = walk()
    raw = with_root_shift(truth, np.tile([0.0, -0.06, 0.03], (FRAMES, 1)))
    done, _ = optimize(raw, scene(box_at_m=(0.52, 0.45, 1.2)), PENETRATION=5e3)
    keys = done.keyframe_index[0]
    shift_m = (root_m(done.people[0]) - root_m(raw))[keys]
    away_m = root_m(raw)[keys] - CAMERA_M
    assert np.linalg.norm(shift_m, axis=1).max() > 0.02
    np.testing.assert_allclose(np.cross(shift_m, away_m / np.linalg.norm(away_m, axis=1)[:, None]), 0.0, atol=1e-6)


def test_a_good_body_is_left_where_it_is() -> None:
    truth = walk()
    done, _ = optimize(truth, scene())
    assert off_m(done.people[0], truth).max() < 0.01


def test_a_body_is_pushed_out_of_an_object() -> None:
    truth = walk()
    _, ctx = optimize(truth, scene(box_at_m=(-0.52, 0.45, 1.2)), REGULARIZATION=0.05)
    assert quality(ctx, "penetration_max_before") > 0.05
    assert quality(ctx, "penetration_max_after") < 0.5 * quality(ctx, "penetration_max_before")


def test_keyframes_lie_in_valid_frames_and_gaps_are_bridged_without_a_pop() -> None:
    truth = walk()
    valid = np.ones(FRAMES, dtype=bool)
    valid[[0, 1]] = False
    valid[32:44] = False
    raw = along_sight(truth, np.linspace(0.12, 0.0, FRAMES))
    object.__setattr__(raw, "valid", valid)
    done, _ = optimize(raw, scene())
    keys = done.keyframe_index[0]
    assert {2, 5, 31, 44, 45, FRAMES - 1} <= set(keys)
    assert valid[keys].all()
    shift_m = root_m(done.people[0]) - root_m(raw)
    assert np.abs(np.diff(shift_m, axis=0)).max() < 0.01
    np.testing.assert_allclose(shift_m[:2], np.tile(shift_m[2], (2, 1)))
    np.testing.assert_array_equal(done.people[0].R_parent_joint, raw.R_parent_joint)


def test_a_person_never_seen_is_passed_on_with_a_warning() -> None:
    raw = walk(10)
    object.__setattr__(raw, "valid", np.zeros(10, dtype=bool))
    done, ctx = optimize(raw, scene())
    assert done.people[0] is raw
    assert len(done.keyframe_index[0]) == 0
    assert any("no valid frame" in warning for warning in ctx.warnings)


def test_results_repeat_exactly() -> None:
    raw = along_sight(walk(31), 0.08)
    first, second = optimize(raw, scene())[0], optimize(raw, scene())[0]
    np.testing.assert_array_equal(root_m(first.people[0]), root_m(second.people[0]))


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_shortest_clips_work(frames: int) -> None:
    raw = along_sight(walk(frames), 0.10)
    done, _ = optimize(raw, scene())
    assert (root_m(done.people[0]) - root_m(raw))[:, 1].min() > 0.01


def test_a_foot_of_the_wrong_pitch_touches_where_it_is_lowest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both heel and toe are said to touch; drawn to the floor apart, each would press the other into it."""
    truth = walk()
    R = truth.R_parent_joint.copy()
    for name in ("left_ankle", "right_ankle"):
        R[:, JOINT_INDEX[name]] = R[:, JOINT_INDEX[name]] @ matrix_from_axis_angle(np.array([-0.3, 0.0, 0.0]))
    contact = truth.contact.copy()
    for side in ("left", "right"):
        pair = [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]
        contact[:, pair] = contact[:, pair].max(1, keepdims=True)
    pitched = replace(truth.with_pose(translation_world_m=root_m(truth), R_parent_joint=R), contact=contact)
    _, together = optimize(pitched, scene())
    for module in (keyframe_points, keyframe_problem):
        monkeypatch.setattr(module, "TOUCHING", tuple((joint,) for part in TOUCHING for joint in part))
    _, apart = optimize(pitched, scene())
    deepest = [quality(ctx, "penetration_mean_after") for ctx in (together, apart)]
    assert deepest[0] < 0.6 * deepest[1]
    assert quality(together, "contact_distance_after") < 0.01
