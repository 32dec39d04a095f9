"""Retargeting: limbs keep their directions, feet stand on the floor, on bodies of any height."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from retarget_quality import measure_retarget

from scenemi.contacts import foot_contacts
from scenemi.data.container import MotionArchive, SourceClip
from scenemi.data.fading import envelope, faded
from scenemi.data.hinge_limb import LegBones, bend_leg, move_wrist
from scenemi.data.rest_pose import rest_axes
from scenemi.data.retarget import RetargetedMotion, retarget
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.legs import LEGS
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.runs import runs
from video2anim.types import BodyShape
from video2anim.types.skeleton import FEET, JOINT_INDEX, PARENTS, forward_kinematics

EXAMPLES = (
    ("cmu.npz", "cmu_02_06"),
    ("cmu.npz", "cmu38_train_walking_20"),
    ("cmu.npz", "cmu38_train_jumping_1"),
    ("cmu.npz", "cmucc_07_10"),
    ("cmu.npz", "cmudaz_martial_04"),
    ("cmu.npz", "cmuh_140_03"),
    ("bandai.npz", "bandai1_walk_feminine_001"),
    ("bandai.npz", "bandai2_walk_feminine_017"),
    ("deepmimic.npz", "dm_walk"),
    ("deepmimic.npz", "sie_run_left12"),
)
"""At least one clip of every source and every kind of skeleton."""


def body_of(height: float) -> ShapedBody:
    return shaped_body(BodyShape("anny", {**ADULT, "height": height}))


def test_a_planted_walk_comes_back_on_its_own_body(smpl_walk: SourceClip) -> None:
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    motion = retarget(smpl_walk, body)
    joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    error_m = np.linalg.norm(joints_m - smpl_walk.joints_m(), axis=-1)
    assert error_m.mean() < 0.006
    assert error_m.max() < 0.03
    assert (motion.name, motion.kind, motion.source) == ("walk_a", "walk", "synthetic")
    assert motion.contact[:, FEET].any(axis=1).mean() > 0.9
    assert not np.delete(motion.contact, FEET, axis=1).any()


@pytest.mark.parametrize("height", [0.1, 0.5, 0.9])
def test_feet_stay_planted_on_other_bodies(smpl_walk: SourceClip, height: float) -> None:
    body = body_of(height)
    motion = retarget(smpl_walk, body)
    quality = measure_retarget(smpl_walk, body, motion)
    assert quality.contact_share > 0.8
    assert quality.slide_mm < 0.5
    assert quality.slide_max_mm < 5.0
    assert quality.sink_mm < 5.0
    assert quality.float_mm < 5.0
    assert quality.limb_error_deg < 3.0
    R = motion.R_parent_joint
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)


@pytest.mark.parametrize(("archive", "name"), EXAMPLES, ids=[name for _, name in EXAMPLES])
@pytest.mark.parametrize("height", [0.15, 0.8])
def test_captured_clips_of_every_source(shared_motion: Path, archive: str, name: str, height: float) -> None:
    clip, body = MotionArchive.read(shared_motion / archive).clip(name), body_of(height)
    motion = retarget(clip, body)
    quality = measure_retarget(clip, body, motion)
    assert quality.contact_share > 0.35
    assert quality.slide_mm < 1.0
    assert quality.slide_max_mm <= 5.0
    assert quality.sink_mm < 5.0
    assert quality.float_mm < 15.0
    assert quality.below_floor_mm < 10.0
    assert quality.body_below_mm < 15.0
    assert 0.7 < quality.jerk_ratio < 1.25
    assert quality.limb_error_deg < 4.0
    assert quality.knee_min_deg > 0.0
    assert_elbows_bend_forward(motion)


def assert_elbows_bend_forward(motion: RetargetedMotion) -> None:
    """Elbows flex forward only: about the body's -y on the left, +y on the right (forearms may twist about x)."""
    for side, sign in (("left", -1.0), ("right", 1.0)):
        outward = -sign
        forearm = outward * motion.R_parent_joint[:, JOINT_INDEX[f"{side}_elbow"], :, 0]
        angle = np.degrees(np.arctan2(forearm[:, 2], outward * forearm[:, 0]))
        assert np.percentile(angle, 1) > -10.0
        assert np.percentile(np.abs(np.degrees(np.arcsin(np.clip(forearm[:, 1], -1, 1)))), 95) < 15.0


@pytest.mark.parametrize(
    ("archive", "name"),
    [("cmu.npz", "cmu38_train_walking_20"), ("bandai.npz", "bandai2_walk_feminine_017"), ("deepmimic.npz", "dm_walk")],
)
def test_walkers_face_where_they_go_and_stand_upright(shared_motion: Path, archive: str, name: str) -> None:
    clip, body = MotionArchive.read(shared_motion / archive).clip(name), body_of(0.4)
    motion = retarget(clip, body)
    joints_m, R_world = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    travel = motion.translation_m[-1] - motion.translation_m[0]
    for joint in ("pelvis", "spine3", "head"):
        front = R_world[:, JOINT_INDEX[joint], :, 2].mean(axis=0)
        assert front @ travel > 0.9 * np.linalg.norm(front) * np.linalg.norm(travel)
    assert R_world[:, JOINT_INDEX["spine3"], 1, 1].mean() > 0.93
    assert (joints_m[:, JOINT_INDEX["head"], 1] > joints_m[:, 0, 1] + 0.4).all()
    left = joints_m[:, 1] - joints_m[:, 2]
    front = R_world[:, 0, :, 2]
    assert (np.cross(left, [0.0, 1.0, 0.0]) * front).sum(-1).min() > 0.0


def test_paths_scale_with_the_leg(shared_motion: Path) -> None:
    clip = MotionArchive.read(shared_motion / "cmu.npz").clip("cmu38_train_walking_20")
    paths_m, legs_m = [], []
    for height in (0.2, 0.7):
        body = body_of(height)
        paths_m.append(retarget(clip, body).translation_m)
        legs_m.append(LegBones.of(body.rest_joints_m, LEGS[0]).length_m)
    ratio = legs_m[1] / legs_m[0]
    lengths_m = [np.linalg.norm(path[-1, ::2] - path[0, ::2]) for path in paths_m]
    assert lengths_m[1] / lengths_m[0] == pytest.approx(ratio, rel=0.01)


def test_uneven_clips_keep_their_heights(shared_motion: Path) -> None:
    clip = MotionArchive.read(shared_motion / "cmu.npz").clip("cmuh_43_03")
    assert clip.uneven
    body = body_of(0.4)
    motion = retarget(clip, body)
    joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    held = motion.contact[1:] & motion.contact[:-1]
    steps_m = np.linalg.norm(np.diff(joints_m, axis=0), axis=-1)
    assert held.any()
    assert steps_m[held].max() <= 0.005
    scale = LegBones.of(body.rest_joints_m, LEGS[0]).length_m / _leg_length(clip)
    source_m = clip.smpl_joints_m()[:, list(FEET), 1]
    assert np.abs(joints_m[:, list(FEET), 1] - scale * source_m).max() < 0.1
    assert np.isnan(measure_retarget(clip, body, motion).sink_mm)


def _leg_length(clip: SourceClip) -> float:
    joints_m, leg = clip.smpl_joints_m()[0], LEGS[0]
    thigh_m, shin_m = joints_m[leg.knee] - joints_m[leg.hip], joints_m[leg.ankle] - joints_m[leg.knee]
    return float(np.linalg.norm(thigh_m) + np.linalg.norm(shin_m))


def test_quality_sees_what_is_wrong(smpl_walk: SourceClip) -> None:
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    good = retarget(smpl_walk, body)
    sunk = replace(good, translation_m=good.translation_m - [0.0, 0.02, 0.0])
    drift = np.arange(len(good.translation_m))[:, None] * [0.004, 0.0, 0.0]
    sliding = replace(good, translation_m=good.translation_m + drift)
    before = measure_retarget(smpl_walk, body, good)
    assert measure_retarget(smpl_walk, body, sunk).sink_mm == pytest.approx(before.sink_mm + 20.0, abs=0.5)
    raised = replace(good, translation_m=good.translation_m - [0.0, -0.02, 0.0])
    assert measure_retarget(smpl_walk, body, raised).float_mm == pytest.approx(before.float_mm + 20.0, abs=1.5)
    assert measure_retarget(smpl_walk, body, sliding).slide_mm == pytest.approx(4.0, abs=0.6)
    turned = good.R_parent_joint.copy()
    turned[:, 16] = turned[:, 16] @ matrix_from_axis_angle(np.array([0.0, 0.0, 0.5]))
    worse = measure_retarget(smpl_walk, body, replace(good, R_parent_joint=turned))
    # Upper arm and forearm of one side, 2 of 8 bones, by 0.5 rad.
    assert worse.limb_error_deg == pytest.approx(before.limb_error_deg + np.degrees(0.5) / 4, abs=0.6)


def test_result_is_the_same_again(smpl_walk: SourceClip) -> None:
    body = body_of(0.3)
    first, second = retarget(smpl_walk, body), retarget(smpl_walk, body)
    assert first.R_parent_joint.tobytes() == second.R_parent_joint.tobytes()
    assert first.translation_m.tobytes() == second.translation_m.tobytes()


def test_unknown_skeletons_and_single_frames_are_refused(smpl_walk: SourceClip) -> None:
    body = body_of(0.3)
    names = tuple(f"bone{i}" for i in range(22))
    strange = replace(smpl_walk, skeleton=replace(smpl_walk.skeleton, name="robot", names=names))
    with pytest.raises(InputError, match=r"'robot'.*known family"):
        retarget(strange, body)
    one = replace(smpl_walk, root_position_m=smpl_walk.root_position_m[:1], rotation_wxyz=smpl_walk.rotation_wxyz[:1])
    with pytest.raises(InputError, match="at least 2 frames"):
        retarget(one, body)


def test_short_clips_work(smpl_walk: SourceClip) -> None:
    for frames in (2, 3, 5, 9):
        short = replace(
            smpl_walk,
            root_position_m=smpl_walk.root_position_m[:frames],
            rotation_wxyz=smpl_walk.rotation_wxyz[:frames],
        )
        motion = retarget(short, body_of(0.3))
        assert np.isfinite(motion.R_parent_joint).all()
        assert np.isfinite(motion.translation_m).all()


def test_rest_axes_are_rotations_along_the_bones(shared_motion: Path) -> None:
    for file, name in EXAMPLES:
        clip = MotionArchive.read(shared_motion / file).clip(name)
        axes, table = rest_axes(clip.skeleton), clip.skeleton.smpl_rotation
        known = np.flatnonzero(table >= 0)
        for joint in known:
            if np.isnan(axes[joint]).any():
                continue
            np.testing.assert_allclose(axes[joint] @ axes[joint].T, np.eye(3), atol=1e-9)
            assert np.linalg.det(axes[joint]) == pytest.approx(1.0)
        joints_m, R_source = clip.forward()
        for leg in LEGS:
            shin = (
                joints_m[:, clip.skeleton.smpl_position[leg.ankle]] - joints_m[:, clip.skeleton.smpl_position[leg.knee]]
            )
            down = -(R_source[:, table[leg.knee]] @ axes[leg.knee])[:, :, 1]
            np.testing.assert_allclose(shin / np.linalg.norm(shin, axis=-1, keepdims=True), down, atol=1e-6)


def test_contacts_of_a_known_step() -> None:
    """One foot stands for 20 frames, swings 0.6 m in 12, stands again; the ball leaves 3 frames after the heel."""
    still, swing = np.zeros(20), np.linspace(0, 1, 13)[1:]
    ease = swing**3 * (10 - 15 * swing + 6 * swing**2)
    z = np.concatenate([still, 0.6 * ease, np.full(20, 0.6)])
    y = np.concatenate([still, 0.12 * np.sin(np.pi * swing), np.zeros(20)])
    toe_m = np.stack([0 * z, y + 0.02, z], -1)
    ankle_m = toe_m - [0.0, -0.06, 0.12]
    ankle_m[17:20, 1] += [0.03, 0.06, 0.09]
    contact = foot_contacts(ankle_m, toe_m, 0.06, 30.0, has_floor=True)
    (heel_a, heel_b), (ball_a, ball_b) = runs(contact[:, 0]), runs(contact[:, 1])
    assert heel_a[0] == ball_a[0] == 0
    assert 15 <= heel_a[1] <= 17
    assert 19 <= ball_a[1] <= 22
    assert 30 <= ball_b[0] <= 33
    assert heel_b[1] == ball_b[1] == len(z)


def test_a_foot_that_slides_slowly_is_cut_into_pieces() -> None:
    z = np.linspace(0.0, 0.3, 90)
    toe_m = np.stack([0 * z, 0 * z, z], -1)
    contact = foot_contacts(toe_m - [0, -0.06, 0.1], toe_m, 0.06, 30.0, has_floor=True)
    pieces = runs(contact[:, 1])
    assert len(pieces) >= 3
    assert max(np.ptp(z[a:b]) for a, b in pieces) <= 0.08


def test_fading_joins_and_ends_smoothly() -> None:
    known = np.zeros(60, bool)
    known[10:20] = known[26:35] = True
    values = np.zeros((60, 1))
    values[10:20], values[26:35] = 1.0, 2.0
    curve = faded(values, known, 6)
    np.testing.assert_array_equal(curve[known], values[known])
    assert np.abs(curve[:4]).max() == 0.0
    assert np.abs(curve[41:]).max() == 0.0
    assert ((curve[20:26] > 1.0) & (curve[20:26] < 2.0)).all()
    assert np.abs(np.diff(curve[:, 0], 2)).max() < 0.25


def test_an_envelope_is_smooth_and_nowhere_too_low() -> None:
    least = np.zeros(80)
    least[30:33], least[60] = [0.02, 0.05, 0.02], 0.1
    curve = envelope(least, 8)
    assert (curve >= least - 1e-12).all()
    assert np.abs(np.diff(curve, 2)).max() < 0.01
    assert curve[0] == curve[79] == 0.0


def test_legs_reach_and_knees_bend_forward() -> None:
    rest = body_of(0.4).rest_joints_m
    rng = np.random.default_rng(2)
    bones = LegBones.of(rest, LEGS[0])
    R_hip = matrix_from_axis_angle(rng.normal(0, 0.6, (200, 3)))
    hip_m = rng.normal(0, 1, (200, 3))
    direction = rng.normal(0, 1, (200, 3))
    distance_m = rng.uniform(0.2, 0.99, 200) * bones.length_m
    ankle_m = hip_m + direction / np.linalg.norm(direction, axis=-1, keepdims=True) * distance_m[:, None]
    R_thigh, R_shin = bend_leg(R_hip, hip_m, ankle_m, bones)
    np.testing.assert_allclose(hip_m + R_thigh @ bones.thigh_m + R_shin @ bones.shin_m, ankle_m, atol=1e-9)
    R_knee = np.swapaxes(R_thigh, -1, -2) @ R_shin
    np.testing.assert_allclose(R_knee[:, :, 0], np.broadcast_to([1.0, 0.0, 0.0], (200, 3)), atol=1e-12)
    assert (R_knee[:, 2, 1] > 0).all()


def test_wrists_move_where_they_should() -> None:
    rest = body_of(0.4).rest_joints_m
    shoulder, elbow, wrist = (JOINT_INDEX[f"left_{name}"] for name in ("shoulder", "elbow", "wrist"))
    assert PARENTS[elbow] == shoulder
    arm_m = (rest[elbow] - rest[shoulder], rest[wrist] - rest[elbow])
    rng = np.random.default_rng(4)
    R_shoulder = matrix_from_axis_angle(rng.normal(0, 0.8, (50, 3)))
    R_elbow = R_shoulder @ matrix_from_axis_angle(
        np.stack([np.zeros(50), rng.uniform(-1.5, -0.6, 50), np.zeros(50)], -1)
    )
    shift_m = rng.uniform(-0.04, 0.04, (50, 3))
    R_upper, R_fore = move_wrist(R_shoulder, R_elbow, arm_m, np.array([0.0, -1.0, 0.0]), shift_m)
    before, after = R_shoulder @ arm_m[0] + R_elbow @ arm_m[1], R_upper @ arm_m[0] + R_fore @ arm_m[1]
    within = np.linalg.norm(before + shift_m, axis=-1) < 0.999 * sum(np.linalg.norm(bone) for bone in arm_m)
    assert within.sum() > 40
    np.testing.assert_allclose((after - before)[within], shift_m[within], atol=1e-9)
