"""Refinement on a walk with known truth, with the shipped prior and without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import FPS, planted_walk, with_root_shift

import scenemi.prior
from scenemi.metrics import jerk_m_s3, mpjpe
from stages.refine import RefineConfig, calm_frames, picture_distance_ratio, refine_motion
from video2anim.errors import ModelMissingError
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, BodyTracks, KeyframedMotion, Mesh, PlacedObject, RefinedMotion, SceneModel

FRAMES = 150
PLAIN = RefineConfig(prior="interpolation")


@pytest.fixture
def no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenemi.prior, "WEIGHTS_FOLDER", tmp_path)


def scene(*objects: PlacedObject) -> SceneModel:
    """A floor, and objects."""
    solids = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in objects]
    grid = build_sdf_grid(solids, np.array([[-1.5, -0.4, -1.2], [1.5, 2.0, 6.0]]), 0.1)
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.uint8))
    return SceneModel(objects, empty, empty, grid.sdf_m, grid.origin_m, grid.spacing_m)


def pillar(x_m: float, z_m: float) -> PlacedObject:
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = x_m, z_m
    return PlacedObject(7, "pillar", box_mesh(0.3, 1.7, 0.3), 1.0, T_world_object, None, None, True, "")


def refine(
    motion: BodyMotion, config: RefineConfig | None = None, where: SceneModel | None = None
) -> tuple[RefinedMotion, StageContext]:
    ctx = StageContext(Path())
    keys = np.union1d(np.arange(0, motion.frame_count, 5), [motion.frame_count - 1])
    given = KeyframedMotion((motion,), (keys[motion.valid[keys]],))
    return refine_motion(BodyTracks((motion,)), given, where or scene(), config or RefineConfig(), ctx), ctx


def quality(ctx: StageContext, name: str) -> float:
    return next(q.value for q in ctx.qualities if q.name == name)


def test_the_shipped_prior_is_at_work_and_a_good_motion_stays() -> None:
    truth = planted_walk(FRAMES)
    refined, ctx = refine(truth)
    found = refined.people[0]
    assert refined.prior == ("scenemi",)
    assert 0 < refined.prior_share[0] == quality(ctx, "frames shaped by scenemi") <= 1
    assert mpjpe(found.joints_world_m, truth.joints_world_m) < 0.03
    assert np.median(picture_distance_ratio(found, truth)) < 0.015
    assert quality(ctx, "foot skating gmd refined") <= quality(ctx, "foot skating gmd raw") + 0.02
    assert jerk_m_s3(found.joints_world_m, FPS) < 1.5 * jerk_m_s3(truth.joints_world_m, FPS)


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
    assert quality(ctx, "penetration max raw") > 0.02
    assert quality(ctx, "penetration max refined") < 0.015
    assert np.median(picture_distance_ratio(refined.people[0], sunk)) < 0.015


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
    assert quality(ctx, "object 7 moved") == pytest.approx(np.linalg.norm(moved))
    field = SdfGrid(refined.scene.sdf_m, refined.scene.sdf_origin_m, refined.scene.sdf_spacing_m)
    assert field.sample(shoulder_m[None])[0] > scene(item).sdf_m.min()
    middle_m = refined.scene.objects[0].T_world_object[:3, 3] + [0.0, 0.85, 0.0]
    assert field.sample(middle_m[None])[0] < -0.05
    assert mpjpe(refined.people[0].joints_world_m, truth.joints_world_m) < 0.02
    stiff, _ = refine(truth, replace(PLAIN, objects_move=False), scene(item))
    assert stiff.scene.objects[0] is item


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
    assert calm_frames(motion).all()
    joints_m = motion.joints_world_m.copy()
    joints_m[30:33, 5:9] += 0.3
    jumped = calm_frames(replace(motion, joints_world_m=joints_m))
    assert not jumped[30:33].any()
    assert jumped[:24].all()
    assert jumped[40:].all()
    restless = (
        joints_m + np.random.default_rng(0).normal(0, 0.2, joints_m.shape) * (np.arange(60) % 9 == 0)[:, None, None]
    )
    valid = np.arange(60) > 4
    kept = calm_frames(replace(motion, joints_world_m=restless, valid=valid))
    assert not kept[:5].any()
    assert kept.sum() > 0.5 * valid.sum()


def test_a_moved_keyframe_changes_the_motion_there_and_nothing_far_before() -> None:
    """As a user edits it: the body of some frames 5 cm beside."""
    walk = planted_walk(270)
    shift_m = np.zeros((270, 3))
    shift_m[220:251, 1] = 0.05
    before, after = (refine(one)[0].people[0] for one in (walk, with_root_shift(walk, shift_m)))
    moved_m = after.joints_world_m - before.joints_world_m
    assert np.abs(moved_m[:90]).max() < 0.002
    assert moved_m[235, 0, 1] == pytest.approx(0.05, abs=0.03)
