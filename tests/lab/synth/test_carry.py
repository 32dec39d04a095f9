"""Objects that somebody moves: rigid with the hand while held, at rest on something before and after."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from acting_checks import adult
from scipy.spatial import KDTree

from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.lab.synth.acting import CARRIES, act_carry
from video2anim.lab.synth.acting.grip import Grip, fingers, side_grip
from video2anim.lab.synth.acting.measure import measure
from video2anim.lab.synth.compose import ComposeOptions, compose
from video2anim.lab.synth.object_view import box_points, swept_points
from video2anim.lab.synth.presets import PROCEDURAL, clip_specs, hiding_of
from video2anim.lab.synth.rooms.clearance import penetration_m
from video2anim.lab.synth.world import ProceduralMotion
from video2anim.types.skeleton import forward_kinematics

SEEDS = (1, 3)
TOUCH_M = 0.03
MAX_INSIDE_M = 0.03
"""Palms and fingers are stiff, and may go so deep into what they hold."""


@functools.cache
def made(kind: str, seed: int) -> tuple[ProceduralMotion, ShapedBody]:
    """The first draw that works out, as `compose` takes it."""
    body = adult(0.4 + 0.05 * seed)
    for attempt in range(6):
        try:
            return act_carry(kind, body, np.random.default_rng([seed, attempt])), body
        except InputError:
            continue
    raise AssertionError(f"no draw of {kind} works out")


def poses(motion: ProceduralMotion) -> tuple[np.ndarray, np.ndarray]:
    assert motion.item_pose is not None
    assert motion.item_held is not None
    return motion.item_pose, motion.item_held


def each(*kinds: str) -> list[tuple[str, int]]:
    return [(kind, seed) for kind in kinds or tuple(CARRIES) for seed in SEEDS]


@pytest.mark.parametrize(("kind", "seed"), each())
def test_the_object_is_rigid_with_every_hand_that_holds_it(kind: str, seed: int) -> None:
    motion, body = made(kind, seed)
    T, held = poses(motion)
    joints, R = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    assert held.any()
    for side in np.flatnonzero(held.any(0)):
        rows = np.flatnonzero(held[:, side])
        wrist = np.tile(np.eye(4), (len(rows), 1, 1))
        wrist[:, :3, :3], wrist[:, :3, 3] = R[rows, 20 + side], joints[rows, 20 + side]
        own = np.linalg.inv(T[rows]) @ wrist
        assert np.linalg.norm(own[:, :3, 3] - own[0, :3, 3], axis=1).max() < 1e-3
        assert np.abs(own[:, :3, :3] - own[0, :3, :3]).max() < 2e-3


@pytest.mark.parametrize(("kind", "seed"), each())
def test_at_rest_it_stands_still_upright_on_a_surface(kind: str, seed: int) -> None:
    motion, _ = made(kind, seed)
    T, held = poses(motion)
    rows = np.flatnonzero(held.any(1))
    before, after = T[: rows[0] + 1], T[rows[-1] + 1 :]
    rests = [stretch for stretch in (before, after) if len(stretch) > 1]
    assert len(rests) == {"carry_from_floor": 1, "carry_bag": 0}.get(kind, 2)
    heights = {0.0, *(prop.position_m[1] for prop in motion.props)}
    for stretch in rests:
        np.testing.assert_array_equal(stretch, np.broadcast_to(stretch[0], stretch.shape))
        np.testing.assert_allclose(stretch[0, :3, 1], [0.0, 1.0, 0.0], atol=1e-6)
        assert min(abs(stretch[0, 1, 3] - height) for height in heights) < 1e-6


@pytest.mark.parametrize(("kind", "seed"), each())
def test_it_never_jumps_and_goes_somewhere(kind: str, seed: int) -> None:
    T, held = poses(made(kind, seed)[0])
    step_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    # 2.5 m/s at most, and no sudden start: a step differs from the next by less than 1.5 cm.
    assert step_m.max() < 2.5 / 30
    assert np.abs(np.diff(step_m)).max() < 0.015
    assert np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1).max() > 0.3
    assert held.any(1).mean() > 0.3


@pytest.mark.parametrize(("kind", "seed"), each())
def test_hands_touch_it_and_bodies_do_not_go_through_it(kind: str, seed: int) -> None:
    motion, body = made(kind, seed)
    T, held = poses(motion)
    assert motion.item is not None
    joints, R = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    skin = body.vertices(R, joints).astype(float)
    surface = _surface(motion)
    for frame in range(0, len(T), 6):
        local = (skin[frame] - T[frame, :3, 3]) @ T[frame, :3, :3]
        for side in np.flatnonzero(held[frame]):
            gap_m, _ = KDTree(surface).query(local[body.vertex_part == 20 + side])
            assert gap_m.min() < TOUCH_M, f"frame {frame}, side {side}"
        at_rest = motion.item.moved(np.eye(4))
        depth_m = penetration_m([at_rest], local)
        assert depth_m.max() < MAX_INSIDE_M, f"frame {frame}, part {body.vertex_part[depth_m.argmax()]}"


def _surface(motion: ProceduralMotion) -> np.ndarray:
    """Many points on the faces of the object, its own frame."""
    assert motion.item is not None
    vertices, faces = motion.item.moved(np.eye(4)).merged()
    rng = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    pick = rng.choice(len(faces), 20_000, p=area / area.sum())
    u, v = rng.random((2, len(pick), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[pick] + u * (b - a)[pick] + v * (c - a)[pick]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_cup_comes_to_the_mouth(seed: int) -> None:
    motion, body = made("drink", seed)
    T, _ = poses(motion)
    assert motion.item is not None
    joints, R = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
    lips = joints[:, 15] + R[:, 15] @ np.array([0.0, 0.01, 0.13])
    top = T[:, :3, 3] + T[:, :3, 1] * np.ptp(motion.item.merged()[0][:, 1])
    assert np.linalg.norm(top - lips, axis=1).min() < 0.1
    assert T[:, 1, 1].min() < np.cos(0.4)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_chair_slides_on_the_floor(seed: int) -> None:
    T, held = poses(made("pull_chair", seed)[0])
    assert np.abs(T[:, 1, 3]).max() < 2e-3
    assert 0.5 < np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3]) < 1.0
    assert not held[0].any()
    assert not held[-1].any()


def test_a_hand_lies_against_a_side() -> None:
    size = measure(adult(0.45))
    obj = Grip.furniture_piece(np.random.default_rng(0), ("box",), (0.3, 0.3), 0.3)
    for side, out in ((0, 1.0), (1, -1.0)):
        R = fingers(side, 0.4, 0.6)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
        # The palm looks level to the other side.
        np.testing.assert_allclose(R[1, 1], 0.0, atol=1e-12)
        assert -R[0, 1] * out < 0
        grip = side_grip(size, side, obj, inward_rad=0.0, droop_rad=0.5, flat=True)
        assert grip.offset_m[0] * out == pytest.approx(0.15 + 0.046 * size.scale, abs=0.03)


def test_points_around_an_object() -> None:
    motion, _ = made("carry_box", 1)
    assert motion.item is not None
    corners = motion.item.merged()[0]
    points = box_points(motion, 0.1)
    assert (points > corners.min(0)).all()
    assert (points < corners.max(0)).all()
    T, _ = poses(motion)
    assert len(swept_points(motion, 0.1)) == len(points) * len(T[::2])


def test_preset_carried() -> None:
    specs = clip_specs("carried", None, 0)
    assert [spec.kinds[0] for spec in specs] == list(CARRIES)
    assert specs[0].name == "00_pick_up_from_floor"
    assert all(hiding_of(spec) is None and spec.camera == "static" for spec in specs)
    # The draws of `random` hang on how many kinds there are.
    assert not set(CARRIES) & set(PROCEDURAL)


def test_the_moved_object_is_visible() -> None:
    spec = clip_specs("carried", None, 9101)[2]
    shot = compose(spec, ComposeOptions())
    (moving,) = shot.moving
    assert moving.scene_object.label == "box"
    assert moving.scene_object.object_id not in {obj.object_id for obj in shot.room.objects}
    np.testing.assert_array_equal(moving.scene_object.T_world_object, moving.T_world_object[0])
    assert moving.held.shape == (shot.frame_count, 2)
    assert moving.held.all(1).any()
    swept = np.concatenate([moving.scene_object.moved(T).merged()[0] for T in moving.T_world_object[::5]])
    assert penetration_m(shot.room.furniture, swept).max() < 0.01
    assert shot.is_static
