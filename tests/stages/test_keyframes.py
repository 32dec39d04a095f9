"""Keyframe optimization on a walk with known truth: floor, a box in the way, depth, gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from keyframe_problem import depth_of, optimize, quality, root_m, scene
from synthetic import planted_walk, with_root_shift

from video2anim.body.skeleton import JOINT_INDEX
from video2anim.fitting import keyframe_points
from video2anim.fitting.keyframe_points import TOUCHING
from video2anim.geometry.rotations import matrix_from_axis_angle

FRAMES = 91


def test_a_body_sunk_into_the_floor_is_put_on_it() -> None:
    truth = planted_walk(FRAMES)
    sunk_m = np.stack([np.zeros(FRAMES), -0.06 + 0.02 * np.sin(0.1 * np.arange(FRAMES)), np.zeros(FRAMES)], -1)
    done, ctx = optimize(with_root_shift(truth, sunk_m), scene())
    error_m = (root_m(done.people[0]) - root_m(truth))[:, 1]
    assert np.abs(error_m).mean() < 0.008
    assert quality(ctx, "penetration max after") < 0.25 * quality(ctx, "penetration max before")
    assert quality(ctx, "contact distance after") < 0.2 * quality(ctx, "contact distance before")


def test_a_floating_body_comes_down_by_its_contacts() -> None:
    truth = planted_walk(FRAMES)
    done, _ = optimize(with_root_shift(truth, np.tile([0.0, 0.08, 0.0], (FRAMES, 1))), scene())
    assert np.abs(root_m(done.people[0]) - root_m(truth))[:, 1].max() < 0.02


def test_a_good_body_is_left_where_it_is() -> None:
    truth = planted_walk(FRAMES)
    done, _ = optimize(truth, scene())
    assert np.abs(root_m(done.people[0]) - root_m(truth)).max() < 0.01


def test_a_body_is_pushed_out_of_an_object() -> None:
    truth = planted_walk(FRAMES)
    done, ctx = optimize(truth, scene(box_at_m=(0.52, 0.45, 1.2)))
    assert quality(ctx, "penetration max before") > 0.05
    assert quality(ctx, "penetration max after") < 0.25 * quality(ctx, "penetration max before")
    assert root_m(done.people[0])[:, 0].min() < root_m(truth)[:, 0].min() - 0.02


def test_depth_pulls_the_body_along_the_camera_axis() -> None:
    truth = planted_walk(FRAMES)
    shift_m = np.tile([0.10, 0.0, 0.0], (FRAMES, 1))
    depth, plate = depth_of(truth, np.arange(0, FRAMES, 6))
    done, ctx = optimize(with_root_shift(truth, shift_m), scene(), (depth, plate))
    error_m = np.abs(root_m(done.people[0]) - root_m(truth))[:, 0]
    assert error_m.mean() < 0.04
    assert quality(ctx, "depth chamfer after") < quality(ctx, "depth chamfer before")


def test_untrusted_depth_is_left_out_and_told() -> None:
    truth = planted_walk(31)
    depth = depth_of(truth, np.arange(0, 31, 10), trusted=False)
    shifted = with_root_shift(truth, np.tile([0.10, 0.0, 0.0], (31, 1)))
    done, ctx = optimize(shifted, scene(), depth)
    assert any("not trusted (person too small)" in warning for warning in ctx.warnings)
    assert np.abs(root_m(done.people[0]) - root_m(shifted))[:, 0].max() < 0.01


def test_keyframes_lie_in_valid_frames_and_gaps_are_bridged_without_a_pop() -> None:
    truth = planted_walk(FRAMES)
    valid = np.ones(FRAMES, dtype=bool)
    valid[[0, 1]] = False
    valid[32:44] = False
    sunk_m = np.stack([np.zeros(FRAMES), np.linspace(-0.08, 0.0, FRAMES), np.zeros(FRAMES)], -1)
    raw = with_root_shift(truth, sunk_m)
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
    raw = planted_walk(10)
    object.__setattr__(raw, "valid", np.zeros(10, dtype=bool))
    done, ctx = optimize(raw, scene())
    assert done.people[0] is raw
    assert len(done.keyframe_index[0]) == 0
    assert any("no valid frame" in warning for warning in ctx.warnings)


def test_results_repeat_exactly() -> None:
    raw = with_root_shift(planted_walk(31), np.tile([0.0, -0.05, 0.0], (31, 1)))
    first, second = optimize(raw, scene())[0], optimize(raw, scene())[0]
    np.testing.assert_array_equal(root_m(first.people[0]), root_m(second.people[0]))


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_shortest_clips_work(frames: int) -> None:
    raw = with_root_shift(planted_walk(frames), np.tile([0.0, -0.05, 0.0], (frames, 1)))
    done, _ = optimize(raw, scene())
    assert np.abs(root_m(done.people[0]) - root_m(raw))[:, 1].min() > 0.03


def test_a_foot_of_the_wrong_pitch_touches_where_it_is_lowest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both heel and toe are said to touch; drawn to the floor apart, each would press the other into it."""
    truth = planted_walk(FRAMES)
    R = truth.R_parent_joint.copy()
    for name in ("left_ankle", "right_ankle"):
        R[:, JOINT_INDEX[name]] = R[:, JOINT_INDEX[name]] @ matrix_from_axis_angle(np.array([-0.3, 0.0, 0.0]))
    contact = truth.contact.copy()
    for side in ("left", "right"):
        pair = [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]
        contact[:, pair] = contact[:, pair].max(1, keepdims=True)
    pitched = replace(truth.with_pose(translation_world_m=root_m(truth), R_parent_joint=R), contact=contact)
    _, together = optimize(pitched, scene())
    monkeypatch.setattr(keyframe_points, "TOUCHING", tuple((joint,) for part in TOUCHING for joint in part))
    _, apart = optimize(pitched, scene())
    deepest = [quality(ctx, "penetration mean after") for ctx in (together, apart)]
    assert deepest[0] < 0.6 * deepest[1]
    assert quality(together, "contact distance after") < 0.01
