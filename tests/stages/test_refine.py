"""Refinement on a walk with known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import FPS, planted_walk, with_root_shift

import scenemi.prior
import stages.refine
from scenemi.metrics import jerk_m_s3, mpjpe
from stages.refine import RefineConfig, calm_frames, refine_motion
from video2anim.body.leg_ik import LEGS
from video2anim.errors import ModelMissingError
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, KeyframedMotion, Mesh, RefinedMotion, SceneModel

FRAMES = 150


@pytest.fixture(autouse=True)
def _no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpolation prior, whatever weights are installed."""
    monkeypatch.setattr(scenemi.prior, "WEIGHTS_FOLDER", tmp_path)


def floor_only() -> SceneModel:
    grid = build_sdf_grid([], np.array([[-1.5, -0.4, -1.2], [1.5, 2.0, 6.0]]), 0.1)
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.uint8))
    return SceneModel((), empty, empty, grid.sdf_m, grid.origin_m, grid.spacing_m)


def keyframed(motion: BodyMotion) -> KeyframedMotion:
    keys = np.union1d(np.arange(0, motion.frame_count, 5), [motion.frame_count - 1])
    return KeyframedMotion((motion,), (keys[motion.valid[keys]],))


def refine(motion: BodyMotion, config: RefineConfig | None = None) -> tuple[RefinedMotion, StageContext]:
    ctx = StageContext(Path())
    return refine_motion(keyframed(motion), floor_only(), config or RefineConfig(), ctx), ctx


def quality(ctx: StageContext, name: str) -> float:
    return next(q.value for q in ctx.qualities if q.name == name)


def jittered(motion: BodyMotion) -> BodyMotion:
    noise_m = np.random.default_rng(0).normal(0, 0.003, (motion.frame_count, 3))
    return with_root_shift(motion, noise_m)


def test_jitter_goes_and_the_motion_stays() -> None:
    truth = planted_walk(FRAMES)
    raw = jittered(truth)
    refined, ctx = refine(raw)
    result = refined.people[0]
    assert refined.prior == ("interpolation",)
    assert quality(ctx, "jerk refined") < 0.3 * quality(ctx, "jerk raw")
    assert quality(ctx, "foot skating gmd refined") <= quality(ctx, "foot skating gmd raw") + 0.05
    assert quality(ctx, "penetration max refined") <= quality(ctx, "penetration max raw") + 0.01
    assert mpjpe(result.joints_world_m, truth.joints_world_m) < 0.015


def test_without_weights_auto_is_interpolation_and_says_so() -> None:
    refined, ctx = refine(planted_walk(40), RefineConfig(prior="auto", fallback=False))
    assert (refined.prior, refined.prior_share) == (("interpolation",), (1.0,))
    assert any("no scenemi weights" in warning for warning in ctx.warnings)


def test_a_prior_whose_windows_were_all_turned_down_is_not_told_as_used() -> None:
    refined, ctx = refine(planted_walk(40), RefineConfig(prior="interpolation"))
    assert (refined.prior, refined.prior_share) == (("none",), (0.0,))
    assert quality(ctx, "frames shaped by interpolation") == 0.0


def test_windows_that_interpolation_spoils_are_filled_again_and_told() -> None:
    # A walk with steps of half a second cannot be told from keyframes half a second apart.
    _, ctx = refine(planted_walk(FRAMES))
    assert quality(ctx, "foot skating gmd interpolation every 15") > 0.5
    assert quality(ctx, "windows with denser keyframes") == 1.0
    assert any("windows worse than the observed motion" in warning for warning in ctx.warnings)


def test_the_papers_baseline_is_there_without_fallback_and_foot_lock() -> None:
    truth = planted_walk(FRAMES)
    config = RefineConfig(fallback=False, settle=False, foot_lock=False, low_pass_hz=0)
    refined, ctx = refine(truth, config)
    keys = np.union1d(np.arange(0, FRAMES, 15), [FRAMES - 1])
    np.testing.assert_allclose(refined.people[0].joints_world_m[keys], truth.joints_world_m[keys], atol=1e-9)
    assert quality(ctx, "jerk refined") == pytest.approx(quality(ctx, "jerk interpolation every 15"))
    assert quality(ctx, "windows with denser keyframes") == 0.0


def test_foot_lock_holds_the_feet() -> None:
    raw = planted_walk(FRAMES)
    drift_m = np.stack([0.04 * np.sin(0.09 * np.arange(FRAMES)), np.zeros(FRAMES), np.zeros(FRAMES)], -1)
    raw = with_root_shift(raw, drift_m)
    toe, touching = 10, raw.contact[:, 10] > 0.5
    planted = touching[1:] & touching[:-1]
    speed_m_s = {}
    for lock in (False, True):
        refined, _ = refine(raw, RefineConfig(foot_lock=lock))
        step_m = np.diff(refined.people[0].joints_world_m[:, toe], axis=0)
        speed_m_s[lock] = float(np.linalg.norm(step_m, axis=-1)[planted].mean() * FPS)
    assert speed_m_s[True] < 0.2 * speed_m_s[False]


def test_contact_phases_that_the_lock_refuses_are_counted() -> None:
    walk = planted_walk(90)
    _, ctx = refine(walk)
    assert quality(ctx, "foot phases left free") == 0
    assert quality(ctx, "foot phases held") >= 4
    _, ctx = refine(replace(walk, contact=np.ones_like(walk.contact)))
    assert (quality(ctx, "foot phases held"), quality(ctx, "foot phases left free")) == (0, 2)


def test_contacts_that_contradict_the_motion_do_not_shake_the_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """Feet that are said to stand in turn, five frames each, whatever they do."""
    walk = planted_walk(FRAMES, speed_m_s=0.3)
    told = np.zeros_like(walk.contact)
    left = np.arange(FRAMES) // 5 % 2 == 0
    for side, leg in enumerate(LEGS):
        told[np.ix_(left == (side == 0), [leg.ankle, leg.toe])] = 1.0
    config = RefineConfig(foot_lock=False)
    calm, _ = refine(replace(walk, contact=told), config)
    monkeypatch.setattr(stages.refine, "_SETTLING_ACCELERATIONS_M_S2", (2.0,))
    shaken, _ = refine(replace(walk, contact=told), config)
    before, after, loose = (jerk_m_s3(m.joints_world_m, FPS) for m in (walk, calm.people[0], shaken.people[0]))
    assert loose > 1.5 * before
    assert after < 1.1 * before


def test_a_body_a_little_under_the_floor_is_settled_on_it() -> None:
    truth = planted_walk(FRAMES)
    sunk = with_root_shift(truth, np.tile([0.0, -0.03, 0.0], (FRAMES, 1)))
    deepest_m, off_m = {}, {}
    for settle in (False, True):
        refined, ctx = refine(sunk, RefineConfig(settle=settle))
        deepest_m[settle] = quality(ctx, "penetration max refined")
        off_m[settle] = mpjpe(refined.people[0].joints_world_m, truth.joints_world_m)
    assert deepest_m[False] > 0.02
    assert deepest_m[True] < 0.01
    assert off_m[True] < off_m[False]


def test_settling_joins_windows_without_a_pop() -> None:
    """Four windows and a root that drifts to and fro: no step of the root stands out."""
    truth = planted_walk(300)
    sway_m = 0.05 * np.sin(0.05 * np.arange(300))
    refined, _ = refine(with_root_shift(truth, np.stack([sway_m, 0 * sway_m, 0 * sway_m], -1)))
    bend_m = np.linalg.norm(np.diff(refined.people[0].T_world_root[:, :3, 3], n=2, axis=0), axis=-1)
    assert bend_m.max() < 6 * np.median(bend_m) + 0.002


def test_a_gap_is_filled_without_a_pop_and_stays_marked() -> None:
    truth = planted_walk(FRAMES)
    valid = np.ones(FRAMES, dtype=bool)
    valid[60:75] = False
    held = truth.with_pose(
        translation_world_m=np.where(valid[:, None], truth.T_world_root[:, :3, 3], [9.0, 9.0, 9.0]),
        R_parent_joint=truth.R_parent_joint,
    )
    refined, _ = refine(replace(held, valid=valid))
    result = refined.people[0]
    np.testing.assert_array_equal(result.valid, valid)
    root_m = result.T_world_root[:, :3, 3]
    assert np.linalg.norm(np.diff(root_m, axis=0), axis=-1).max() < 2 * 0.8 / FPS
    assert np.abs(root_m - truth.T_world_root[:, :3, 3]).max() < 0.1


def test_a_pose_that_stands_is_interpolated_as_asked() -> None:
    truth = planted_walk(FRAMES, speed_m_s=0.0)
    still = truth.with_pose(
        translation_world_m=np.tile(truth.T_world_root[0, :3, 3], (FRAMES, 1)),
        R_parent_joint=np.tile(truth.R_parent_joint[0], (FRAMES, 1, 1, 1)),
    )
    refined, ctx = refine(jittered(still))
    assert quality(ctx, "windows with denser keyframes") == 0.0
    assert jerk_m_s3(refined.people[0].joints_world_m, FPS) < 20


def test_scenemi_without_weights_is_an_error() -> None:
    with pytest.raises(ModelMissingError, match="prior scenemi: no weights"):
        refine(planted_walk(10), RefineConfig(prior="scenemi"))


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
