"""Refinement on a walk with known truth, with the shipped prior and without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import FPS, planted_walk, with_root_shift

import scenemi.model.load
from scenemi.metrics import jerk_m_s3, mpjpe
from scenemi.postprocess.motion_solve import TRUNK
from stages.refine import RefineConfig, refine_motion
from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import touches
from video2anim.errors import ModelMissingError
from video2anim.geometry.projection import project
from video2anim.geometry.scene_mesh import box_mesh, empty_mesh, world_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.motion.movable_scene import moving_fields, scene_field
from video2anim.motion.observation import image_distance_ratio, inlier_frames, observation
from video2anim.pipeline.stage import StageContext
from video2anim.types import (
    BodyMotion,
    BodyTracks,
    Hold,
    KeyframedMotion,
    MetricDepth,
    ObjectPath,
    PlacedObject,
    RefinedMotion,
    RoomPiece,
    SceneModel,
)
from video2anim.types.skeleton import FEET, MIRROR_JOINT, forward_kinematics

FRAMES = 150
PLAIN = RefineConfig(prior="interpolation")


@pytest.fixture
def no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenemi.model.load, "WEIGHTS_FOLDER", tmp_path)


def scene(*objects: PlacedObject) -> SceneModel:
    """A floor, and objects; those that somebody moves are not in the field."""
    solids = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in objects if not item.path]
    grid = build_sdf_grid(solids, np.array([[-1.5, -0.4, -1.2], [1.5, 2.0, 6.0]]), 0.1)
    return SceneModel(objects, RoomPiece("floor", empty_mesh()), (), grid.sdf_m, grid.origin_m, grid.spacing_m)


def pillar(x_m: float, z_m: float) -> PlacedObject:
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = x_m, z_m
    return PlacedObject(7, "pillar", box_mesh(0.3, 1.7, 0.3), 1.0, T_world_object, None, None, True, "")


def metric(motion: BodyMotion) -> MetricDepth:
    """What the fit of stage metric gives, of which refine takes the bodies."""
    maps, flat = np.ones((1, 2, 2)), np.ones((2, 2))
    return MetricDepth(
        1.0, 0.0, 0.0, 0.0, None, None, True, "", np.zeros(1, int), maps, maps > 0, flat, flat > 0, {},
        BodyTracks((motion,)),
    )  # fmt: skip


def refine(
    motion: BodyMotion,
    config: RefineConfig | None = None,
    where: SceneModel | None = None,
    fitted: BodyMotion | None = None,
) -> tuple[RefinedMotion, StageContext]:
    """Refine a motion whose path-giving body, that of stage metric, may be another."""
    ctx = StageContext(Path())
    keys = np.union1d(np.arange(0, motion.frame_count, 5), [motion.frame_count - 1])
    given = KeyframedMotion((motion,), (keys[motion.valid[keys]],))
    depth = metric(fitted or motion)
    return refine_motion(BodyTracks((motion,)), depth, given, where or scene(), config or RefineConfig(), ctx), ctx


def quality(ctx: StageContext, name: str) -> float:
    return next(q.value for q in ctx.qualities if q.key == name)


def test_the_shipped_prior_is_at_work_and_a_good_motion_stays() -> None:
    truth = planted_walk(FRAMES)
    refined, ctx = refine(truth)
    found = refined.people[0]
    assert refined.prior == ("scenemi",)
    assert 0 < refined.prior_share[0] == quality(ctx, "frames_shaped_by_prior") <= 1
    assert mpjpe(found.joints_world_m, truth.joints_world_m) < 0.03
    assert np.median(image_distance_ratio(found, truth)) < 0.015
    feet_m_s, true_m_s = (
        np.linalg.norm(np.diff(one.joints_world_m[:, FEET][..., [0, 2]], axis=0), axis=-1) * FPS
        for one in (found, truth)
    )
    stands = true_m_s < 0.02
    assert stands.mean() > 0.3
    assert np.percentile(feet_m_s[stands], 99) < 0.12, "feet that stand do not slide"
    assert jerk_m_s3(found.joints_world_m, FPS) < 1.5 * jerk_m_s3(truth.joints_world_m, FPS)


def test_the_shipped_prior_adds_no_skating_to_a_good_motion() -> None:
    _, ctx = refine(planted_walk(FRAMES))
    assert quality(ctx, "foot_skating_gmd_refined") <= quality(ctx, "foot_skating_gmd_raw") + 0.02


@pytest.mark.usefixtures("no_weights")
def test_without_weights_auto_keeps_the_observation_and_says_so() -> None:
    truth = planted_walk(40)
    refined, ctx = refine(truth)
    assert (refined.prior, refined.prior_share) == (("none",), (0.0,))
    assert any("no scenemi weights" in warning for warning in ctx.warnings)
    assert mpjpe(refined.people[0].joints_world_m, truth.joints_world_m) < 0.005


@pytest.mark.usefixtures("no_weights")
def test_scenemi_without_weights_is_an_error() -> None:
    with pytest.raises(ModelMissingError, match="prior scenemi: no weights"):
        refine(planted_walk(10), RefineConfig(prior="scenemi"))


@pytest.mark.parametrize("config", [PLAIN, RefineConfig()])
def test_standing_feet_are_held(config: RefineConfig) -> None:
    truth = planted_walk(FRAMES)
    # Along the sight, where the picture says nothing against it.
    drift_m = np.stack([0.04 * np.sin(0.09 * np.arange(FRAMES)), np.zeros(FRAMES), np.zeros(FRAMES)], -1)
    raw = with_root_shift(truth, drift_m)
    refined, _ = refine(raw, config)
    stands = (raw.contact[1:, 10] > 0.5) & (raw.contact[:-1, 10] > 0.5)
    before, after = (
        FPS * np.linalg.norm(np.diff(m.joints_world_m[:, 10], axis=0), axis=-1)[stands].mean()
        for m in (raw, refined.people[0])
    )
    assert after < 0.35 * before


def test_a_body_a_little_under_the_floor_is_put_on_it() -> None:
    truth = planted_walk(FRAMES)
    sunk = with_root_shift(truth, np.tile([0.0, -0.03, 0.0], (FRAMES, 1)))
    refined, ctx = refine(sunk, PLAIN)
    assert quality(ctx, "penetration_max_raw") > 0.02
    assert quality(ctx, "penetration_max_refined") < 0.015
    assert np.median(image_distance_ratio(refined.people[0], sunk)) < 0.015


@pytest.mark.parametrize("config", [PLAIN, RefineConfig()])
def test_a_gap_is_filled_without_a_pop_and_stays_marked(config: RefineConfig) -> None:
    truth = planted_walk(FRAMES)
    valid = np.ones(FRAMES, dtype=bool)
    valid[60:75] = False
    held = truth.with_pose(
        translation_world_m=np.where(valid[:, None], truth.T_world_root[:, :3, 3], [9.0, 9.0, 9.0]),
        R_parent_joint=truth.R_parent_joint,
    )
    refined, _ = refine(replace(held, valid=valid), config)
    found = refined.people[0]
    np.testing.assert_array_equal(found.valid, valid)
    root_m = found.T_world_root[:, :3, 3]
    assert np.linalg.norm(np.diff(root_m, axis=0), axis=-1).max() < 2 * 0.8 / FPS
    assert np.abs(root_m - truth.T_world_root[:, :3, 3]).max() < 0.1


def test_an_object_in_a_body_gives_way_and_the_scene_says_so() -> None:
    """The camera looks along -X; the pillar's distance from it is what is uncertain."""
    truth = planted_walk(61)
    shoulder_m = truth.joints_world_m[30, 16]
    item = pillar(float(shoulder_m[0]) + 0.2, float(shoulder_m[2]))
    refined, ctx = refine(truth, PLAIN, scene(item))
    moved = refined.scene.objects[0].T_world_object[:3, 3] - item.T_world_object[:3, 3]
    assert moved[0] > 0.02
    assert abs(moved[2]) < 0.3 * moved[0]
    assert quality(ctx, "moved") == pytest.approx(np.linalg.norm(moved))
    field = SdfGrid(refined.scene.sdf_m, refined.scene.sdf_origin_m, refined.scene.sdf_spacing_m)
    assert field.sample(shoulder_m[None])[0] > scene(item).sdf_m.min()
    center_m = refined.scene.objects[0].T_world_object[:3, 3] + [0.0, 0.85, 0.0]
    assert field.sample(center_m[None])[0] < -0.05
    assert mpjpe(refined.people[0].joints_world_m, truth.joints_world_m) < 0.02
    stiff, _ = refine(truth, replace(PLAIN, objects_move=False), scene(item))
    assert stiff.scene.objects[0] is item


def carried(motion: BodyMotion, wrist: int, hold: Hold, *, half_m: float = 0.12) -> PlacedObject:
    """A box around a wrist, moved rigidly with it, while it is held, and stays where that begins and ends."""
    _, R_world_joint = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    frame = np.clip(np.arange(motion.frame_count), hold.first_frame, hold.last_frame)
    T_world_object = np.tile(np.eye(4), (motion.frame_count, 1, 1))
    T_world_object[:, :3, :3] = R_world_joint[frame, wrist]
    T_world_object[:, :3, 3] = motion.joints_world_m[frame, wrist]
    mesh = box_mesh(2 * half_m, 2 * half_m, 2 * half_m)
    mesh = replace(mesh, vertices_m=mesh.vertices_m - np.array([0.0, half_m, 0.0]))
    path = ObjectPath(T_world_object, (hold,))
    return PlacedObject(5, "cup", mesh, 1.0, T_world_object[0], None, None, True, "", path=(path,))


def test_a_carried_object_is_no_solid_and_follows_the_hand() -> None:
    """The path was found with a body that was 6 cm farther from the camera than the result's."""
    truth, wrist = planted_walk(61), 21
    item = carried(truth, wrist, Hold(truth.person_id, "right hand", 15, 45))
    beside = pillar(3.0, 3.0)
    nearer = with_root_shift(truth, np.tile([0.06, 0.0, 0.0], (61, 1)))
    refined, _ = refine(nearer, PLAIN, scene(item, beside), fitted=truth)
    found, body = refined.scene.objects[0], refined.people[0]
    T = found.path[0].T_world_object
    np.testing.assert_array_equal(found.T_world_object, T[0])
    np.testing.assert_allclose(T[21:40, :3, 3], body.joints_world_m[21:40, wrist], atol=1e-6)
    np.testing.assert_array_equal(T[:15], item.path[0].T_world_object[:15])
    np.testing.assert_array_equal(T[46:], item.path[0].T_world_object[46:])
    assert (body.contact[15:46, wrist] == 1.0).all(), "a hand that holds touches what it holds"
    # The same motion without the object: nothing pushes or pulls the body.
    alone, _ = refine(nearer, PLAIN, scene(beside))
    np.testing.assert_array_equal(body.joints_world_m, alone.people[0].joints_world_m)


def test_a_hand_that_holds_something_is_not_drawn_to_solids() -> None:
    slow, wrist = planted_walk(61, speed_m_s=0.1), 21
    contact = slow.contact.copy()
    contact[:, wrist] = 1.0
    motion = replace(slow, contact=contact)
    item = carried(motion, wrist, Hold(motion.person_id, "right hand", 15, 45))
    empty, full = (observation(motion, objects).contact[:, wrist] for objects in ((), (item,)))
    assert (empty == 1.0).all()
    np.testing.assert_array_equal(np.flatnonzero(full == 0.0), np.arange(15, 46))


def test_a_moved_object_is_touched_where_it_rests() -> None:
    """A block under a standing foot, that is pulled away later; it is in no field of the scene."""
    truth = planted_walk(61)
    stance = np.flatnonzero(truth.contact[:, 10] > 0.5)[1:9]
    assert (np.diff(stance) == 1).all()
    lifted = with_root_shift(truth, np.tile([0.0, 0.3, 0.0], (61, 1)))
    at_m = lifted.joints_world_m[stance, 10].mean(0)
    T_world_object = np.tile(np.eye(4), (61, 1, 1))
    T_world_object[:, [0, 2], 3] = at_m[[0, 2]]
    T_world_object[stance[-1] + 8 :, 0, 3] += 1.0
    path = ObjectPath(T_world_object, ())
    block = PlacedObject(5, "box", box_mesh(0.4, 0.3, 0.4), 1.0, T_world_object[0], None, None, True, "", path=(path,))
    body, field = shaped_body(lifted.shape), scene_field(scene())
    without = touches(lifted, body, field, lifted.contact)
    contact = touches(lifted, body, field, lifted.contact, moving_fields(scene(block)))
    assert not without[stance, 10].any()
    assert contact[stance[2:-2], 10].all()
    assert not contact[stance[-1] + 8 :, 10].any()


def test_a_person_never_seen_is_passed_on_with_a_warning() -> None:
    motion = replace(planted_walk(10), valid=np.zeros(10, bool))
    refined, ctx = refine(motion, PLAIN)
    assert refined.people[0] is motion
    assert any("no valid frame" in warning for warning in ctx.warnings)


@pytest.mark.parametrize("frames", [1, 2, 14, 121, 122])
def test_any_length_works(frames: int) -> None:
    refined, _ = refine(planted_walk(frames))
    assert refined.people[0].frame_count == frames
    assert np.isfinite(refined.people[0].joints_world_m).all()


def test_frames_in_which_the_observation_jumps_are_not_calm() -> None:
    motion = planted_walk(60)
    assert inlier_frames(motion).all()
    joints_m = motion.joints_world_m.copy()
    joints_m[30:33, 5:9] += 0.3
    jumped = inlier_frames(replace(motion, joints_world_m=joints_m))
    assert not jumped[30:33].any()
    assert jumped[:24].all()
    assert jumped[40:].all()
    restless = (
        joints_m + np.random.default_rng(0).normal(0, 0.2, joints_m.shape) * (np.arange(60) % 9 == 0)[:, None, None]
    )
    valid = np.arange(60) > 4
    kept = inlier_frames(replace(motion, joints_world_m=restless, valid=valid))
    assert not kept[:5].any()
    assert kept.sum() > 0.5 * valid.sum()


def test_a_body_taken_for_its_mirror_image_in_the_first_frames_stays_on_the_person() -> None:
    """Nothing but the trunk in the picture says how fast somebody starts who walks at a steady pace later."""
    truth = planted_walk(60)
    ahead_m = np.zeros((60, 3))
    ahead_m[:10, 0] = 0.01 * np.arange(10, 0, -1) ** 2 / 10
    truth = with_root_shift(truth, ahead_m)
    R = truth.R_parent_joint.copy()
    R[:3] = R[:3, MIRROR_JOINT] * np.array([[1, -1, -1], [-1, 1, 1], [-1, 1, 1]])
    flipped = truth.with_pose(translation_world_m=truth.T_world_root[:, :3, 3], R_parent_joint=R)
    assert not inlier_frames(flipped)[:3].any()
    found = refine(flipped)[0].people[0]
    trunk = list(TRUNK)
    off_px = [project(one.joints_camera_m[:3, trunk], one.intrinsics) for one in (found, truth)]
    height_px = truth.intrinsics.fy_px * 1.7 / truth.joints_camera_m[:3, 0, 2].min()
    assert np.linalg.norm(off_px[0] - off_px[1], axis=-1).max() < 0.03 * height_px


def test_who_stands_for_most_of_a_clip_may_walk_in_the_rest() -> None:
    """Ten seconds of standing, a second of setting off, two of walking: no frame of it is a jump."""
    walk = planted_walk(90)
    speed = np.concatenate([np.zeros(300), np.linspace(0, 1, 30), np.ones(60)])
    at = np.cumsum(speed)
    frame, share = at.astype(int), (at % 1.0)[:, None, None]
    joints_m = (1 - share) * walk.joints_world_m[frame] + share * walk.joints_world_m[frame + 1]
    every = {
        name: getattr(walk, name)[frame]
        for name in ("valid", "T_world_root", "R_parent_joint", "T_world_camera", "contact")
    }
    motion = replace(walk, frame_time_s=np.arange(len(at)) / 30, joints_world_m=joints_m, **every)
    assert inlier_frames(motion).all()
    joints_m[370:373, 5:9] += 0.3
    assert not inlier_frames(replace(motion, joints_world_m=joints_m))[370:373].any()


def test_a_moved_keyframe_changes_the_motion_there_and_nothing_far_before() -> None:
    """As a user edits it: the body of some frames 5 cm beside."""
    walk = planted_walk(270)
    shift_m = np.zeros((270, 3))
    shift_m[220:251, 1] = 0.05
    before, after = (refine(one)[0].people[0] for one in (walk, with_root_shift(walk, shift_m)))
    moved_m = after.joints_world_m - before.joints_world_m
    assert np.abs(moved_m[:90]).max() < 0.002
    assert moved_m[235, 0, 1] == pytest.approx(0.05, abs=0.03)
