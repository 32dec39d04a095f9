"""Procedural motions keep feet planted, joints within human range, bodies on their props."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
from acting_checks import FPS, Numbers, adult, numbers

from scenemi.data.container import MotionArchive, write_archive
from video2anim.errors import UsageError
from video2anim.lab.synth.acting import ACTS, act, to_source_clip
from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.world import ProceduralMotion, Prop
from video2anim.types.skeleton import forward_kinematics

HEIGHTS = (0.1, 0.45, 0.9)
CASES = [(kind, height, seed) for kind in ACTS for height, seed in zip(HEIGHTS, (1, 2, 3), strict=True)]
PROPS = {
    "walk": set(), "return": set(), "sit": {"seat"}, "lie": {"bed"}, "step_up": {"step"}, "pick_up": {"item", "table"},
    "lean": {"table", "wall"}, "reach": {"table"},
}  # fmt: skip


def made_anew(kind: str, height: float, seed: int) -> ProceduralMotion:
    return act(kind, adult(height), np.random.default_rng(seed))


made = functools.cache(made_anew)
"""Several tests look at the same motion."""


@functools.cache
def found(kind: str, height: float, seed: int) -> Numbers:
    return numbers(made(kind, height, seed), adult(height))


def skin(motion: ProceduralMotion, height: float, parts: tuple[int, ...] | None = None) -> np.ndarray:
    body = adult(height)
    joints, world = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    chosen = None if parts is None else np.flatnonzero(np.isin(body.vertex_part, parts))
    return body.vertices(world, joints, chosen).astype(float)


def over(points: np.ndarray, prop: Prop) -> np.ndarray:
    local = (points - np.array(prop.position_m)) @ yaw_rotation(prop.yaw_rad)
    return (np.abs(local[..., 0]) < 0.5 * prop.size_m[0]) & (np.abs(local[..., 2]) < 0.5 * prop.size_m[1])


@pytest.mark.parametrize(("kind", "height", "seed"), CASES)
def test_planted_feet_do_not_slide_and_soles_do_not_sink(kind: str, height: float, seed: int) -> None:
    motion = made(kind, height, seed)
    got = found(kind, height, seed)
    assert got.slide_m < 0.001
    assert got.sole_lowest_m > -0.005
    assert motion.contact[:, [7, 8]].any(0).all()


@pytest.mark.parametrize(("kind", "height", "seed"), CASES)
def test_joints_stay_in_human_range(kind: str, height: float, seed: int) -> None:
    got = found(kind, height, seed)
    assert got.knee_deg[0] > 0
    assert got.knee_deg[1] < 160
    assert got.elbow_deg[1] < 155
    assert got.ankle_deg < 80
    assert got.wrist_deg < 85
    assert got.neck_deg < 45
    assert got.hip_deg < 145


@pytest.mark.parametrize(("kind", "height", "seed"), CASES)
def test_motion_is_as_smooth_as_people_are(kind: str, height: float, seed: int) -> None:
    got = found(kind, height, seed)
    low = {"walk": 50, "step_up": 30, "pick_up": 25, "reach": 25}.get(kind, 10)
    assert low < got.jerk_m_s3 < 300
    assert got.peak_jerk_m_s3 < 4000
    assert got.root_speed_m_s < 2.2


@pytest.mark.parametrize("kind", ACTS)
def test_length_names_and_props(kind: str) -> None:
    motion = made(kind, 0.45, 5)
    assert 5.0 <= len(motion.translation_m) / FPS <= 9.0
    assert (motion.kind, motion.source) == (kind, "synthetic")
    assert {prop.kind for prop in motion.props} <= PROPS[kind]
    assert bool(motion.props) == bool(PROPS[kind])
    assert motion.contact.shape == motion.R_parent_joint.shape[:2]
    for prop in motion.props:
        assert 0 <= prop.frames[0] <= prop.frames[1] < len(motion.translation_m)
    determinant = np.linalg.det(motion.R_parent_joint)
    np.testing.assert_allclose(determinant, 1.0, atol=1e-9)


@pytest.mark.parametrize("kind", ["walk", "pick_up", "reach"])
@pytest.mark.parametrize("height", HEIGHTS)
def test_mass_center_over_the_feet_when_still(kind: str, height: float) -> None:
    assert found(kind, height, 4).off_balance_m < 0.08


def test_same_seed_same_motion_and_other_seed_another() -> None:
    first, again, other = (made_anew("sit", 0.45, seed) for seed in (7, 7, 8))
    assert first.R_parent_joint.tobytes() == again.R_parent_joint.tobytes()
    assert first.props == again.props
    assert first.translation_m.shape != other.translation_m.shape or not np.allclose(
        first.translation_m, other.translation_m
    )


@pytest.mark.parametrize("height", HEIGHTS)
@pytest.mark.parametrize("seed", [0, 4])
def test_sitter_rests_on_the_seat_and_never_in_it(height: float, seed: int) -> None:
    motion = made("sit", height, seed)
    (seat,) = motion.props
    points = skin(motion, height)
    low = np.where(over(points, seat), points[..., 1], np.inf).min(1)
    while_sitting = low[seat.frames[0] : seat.frames[1] + 1]
    top = seat.position_m[1]
    assert 0.25 < top < 0.6
    assert (low - top).min() > -0.002
    assert np.ptp(while_sitting) < 0.025
    assert np.median(while_sitting) - top < 0.015
    assert motion.contact[seat.frames[0] + 1 : seat.frames[1], 0].all()
    facing = yaw_rotation(seat.yaw_rad)[:, 2]
    pelvis = motion.R_parent_joint[(seat.frames[0] + seat.frames[1]) // 2, 0, :, 2]
    assert facing @ pelvis > 0.9


@pytest.mark.parametrize("height", HEIGHTS)
def test_sleeper_lies_on_the_bed(height: float) -> None:
    motion = made("lie", height, 2)
    (bed,) = motion.props
    points = skin(motion, height)
    top = bed.position_m[1]
    flat = np.flatnonzero(np.abs(motion.R_parent_joint[:, 0, 1, 1]) < 0.15)
    assert len(flat) > 20
    center = points[flat[len(flat) // 2]]
    assert center[:, 1].max() < top + 0.5
    assert over(center, bed).mean() > 0.97
    trunk = np.where(over(points, bed), points[..., 1], np.inf).min(1)
    assert (trunk - top).min() > -0.03


@pytest.mark.parametrize("height", HEIGHTS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_both_feet_stand_on_the_step_and_not_in_it(height: float, seed: int) -> None:
    motion = made("step_up", height, seed)
    feet = skin(motion, height, (7, 8, 10, 11))
    top = max(prop.position_m[1] for prop in motion.props)
    on_top = (feet[..., 1].min(1) > top - 0.005) & motion.contact[:, [7, 8, 10, 11]].all(1)
    assert on_top.sum() >= 5
    for step in motion.props:
        inside = over(feet, step)
        inside &= feet[..., 1] < step.position_m[1] - 0.006
        assert inside.any(1).sum() == 0


def test_item_is_carried_after_it_was_grasped() -> None:
    motion = made("pick_up", 0.45, 3)
    assert motion.item_pose is not None
    item = next(p for p in motion.props if p.kind == "item")
    height = motion.item_pose[:, 1, 3]
    np.testing.assert_allclose(motion.item_pose[0, :3, 3], item.position_m, atol=1e-9)
    assert height.max() - height[0] > 0.25
    body = adult(0.45)
    joints, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    gap = np.linalg.norm(joints[:, [20, 21]] - motion.item_pose[:, None, :3, 3], axis=-1).min(1)
    moving = np.linalg.norm(np.diff(motion.item_pose[:, :3, 3], axis=0), axis=1) > 1e-3
    assert gap[1:][moving].max() < 0.3


@pytest.mark.parametrize("seed", range(6))
def test_leaning_body_touches_and_does_not_enter(seed: int) -> None:
    motion = made("lean", 0.45, seed)
    (prop,) = motion.props
    used = slice(prop.frames[0] + 3, prop.frames[1] - 3)
    if prop.kind == "wall":
        normal = yaw_rotation(prop.yaw_rad)[:, 2]
        front = (skin(motion, 0.45)[used] - np.array(prop.position_m)) @ normal
        assert -0.001 < front.min() < 0.02
        assert motion.contact[used, 9].mean() > 0.5
    else:
        hand = skin(motion, 0.45, (20, 21))[used]
        low = np.where(over(hand, prop), hand[..., 1], np.inf).min(1)
        assert np.abs(low - prop.position_m[1]).max() < 0.015
        assert motion.contact[used, 20:22].any(1).all()


def test_round_trip_through_the_motion_archive(tmp_path: Path) -> None:
    body, motion = adult(0.45), made("reach", 0.45, 1)
    write_archive(tmp_path / "acted.npz", [to_source_clip(motion, body, name="one")])
    clip = MotionArchive.read(tmp_path / "acted.npz").clip("one")
    joints, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    assert (clip.source, clip.kind) == ("synthetic", "reach")
    np.testing.assert_allclose(clip.smpl_joints_m(), joints, atol=2e-3)


def test_unknown_kind_is_refused_in_one_line() -> None:
    with pytest.raises(UsageError, match="want one of walk, return, sit"):
        act("swim", adult(0.45), np.random.default_rng(0))


@pytest.mark.parametrize("kind", ["reach", "lean", "pick_up"])
@pytest.mark.parametrize("height", HEIGHTS)
@pytest.mark.parametrize("seed", [1, 4])
def test_nobody_reaches_or_walks_through_a_table_top(kind: str, height: float, seed: int) -> None:
    motion = made(kind, height, seed)
    points = skin(motion, height)
    for prop in motion.props:
        if prop.kind == "table":
            depth = prop.position_m[1] - points[..., 1]
            assert not (over(points, prop) & (depth > 0.004) & (depth < 0.03)).any()
