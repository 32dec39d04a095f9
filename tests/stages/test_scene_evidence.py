"""The body's path as evidence about the scene: supports under raised feet, objects refuted by a walk through them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import planted_walk

from stages.scene import SceneConfig, _not_refuted, _rested, _supports, _under_high_feet
from video2anim.body.anny_body import shaped_body
from video2anim.body.skeleton import JOINT_INDEX
from video2anim.fitting.free_space import stood_inside
from video2anim.fitting.supports import SUPPORT
from video2anim.fitting.touching import posed_vertices
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, BodyTracks, PlacedObject


def raised(motion: BodyMotion, height_m: float) -> BodyMotion:
    root_m = motion.T_world_root[:, :3, 3] + [0.0, height_m, 0.0]
    return motion.with_pose(translation_world_m=root_m, R_parent_joint=motion.R_parent_joint)


def box_at(x_m: float, z_m: float) -> PlacedObject:
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = x_m, z_m
    return PlacedObject(1, "object", box_mesh(1.0, 1.5, 1.0), 1.0, T_world_object, 0.0, 0.0, True, "")


def supports(motion: BodyMotion, objects: list[PlacedObject], ctx: StageContext) -> list[PlacedObject]:
    bodies = BodyTracks((motion,))
    return _supports(objects, _rested(bodies), bodies, ctx)


def test_feet_on_a_roof_put_a_support_under_them(tmp_path: Path) -> None:
    ctx = StageContext(tmp_path)
    (made,) = supports(raised(planted_walk(90), 1.6), [box_at(5.0, 0.0)], ctx)
    assert (made.label, made.object_id) == (SUPPORT, 2)
    assert made.reason.startswith("inferred: the feet of person 1 rested in ")
    solid = world_mesh(made.mesh, made.T_world_object, made.scale)
    assert solid.vertices_m[:, 1].max() == pytest.approx(1.6, abs=0.05)
    assert solid.vertices_m[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    assert len(ctx.warnings) == 1


def test_feet_on_the_floor_need_no_support(tmp_path: Path) -> None:
    assert supports(planted_walk(90), [], StageContext(tmp_path)) == []


def test_feet_on_something_that_is_there_need_no_support(tmp_path: Path) -> None:
    roof = replace(box_at(0.0, 1.0), mesh=box_mesh(4.0, 1.5, 6.0))
    assert supports(raised(planted_walk(90), 1.6), [roof], StageContext(tmp_path)) == []


def test_feet_in_the_air_without_contact_claim_nothing(tmp_path: Path) -> None:
    motion = raised(planted_walk(90), 1.6)
    motion = replace(motion, contact=np.zeros_like(motion.contact))
    assert supports(motion, [], StageContext(tmp_path)) == []


@pytest.mark.parametrize(("aside_m", "kept"), [(0.0, 0), (2.5, 1)])
def test_only_an_object_that_is_walked_through_is_refuted(tmp_path: Path, aside_m: float, kept: int) -> None:
    motion = planted_walk(90)
    middle = motion.T_world_root[45, :3, 3]
    forward = motion.T_world_root[-1, :3, 3] - motion.T_world_root[0, :3, 3]
    side = np.cross(forward / np.linalg.norm(forward), [0.0, 1.0, 0.0])
    place = middle + aside_m * side
    ctx = StageContext(tmp_path)
    placed = [box_at(place[0], place[2])]
    assert len(_not_refuted(placed, BodyTracks((motion,)), SceneConfig(), ctx)) == kept
    assert len(ctx.warnings) == 1 - kept


def test_an_object_a_little_off_is_brought_under_the_feet(tmp_path: Path) -> None:
    motion = raised(planted_walk(90), 1.6)
    T_world_camera = np.tile(np.eye(4), (90, 1, 1))
    T_world_camera[:, :3, 3] = motion.T_world_root[45, :3, 3] + [0.0, 0.0, 8.0]
    motion = replace(motion, T_world_camera=T_world_camera)
    feet_m = motion.joints_world_m[:, [10, 11]].reshape(-1, 3)
    middle = 0.5 * (feet_m.min(0) + feet_m.max(0))
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = middle[[0, 2]] + [0.4, 0.0]
    size = np.ptp(feet_m, axis=0)[[0, 2]] + 1.0
    shed = PlacedObject(1, "object", box_mesh(size[0], 1.45, size[1]), 1.0, T_world_object, None, None, True, "")
    bodies = BodyTracks((motion,))
    made = _under_high_feet([shed], _rested(bodies), bodies, StageContext(tmp_path))
    assert [item.object_id for item in made] == [1]
    assert made[0].mesh.vertices_m[:, 1].max() == pytest.approx(1.6, abs=0.05)
    under = made[0].mesh.vertices_m[:, [0, 2]] + made[0].T_world_object[[0, 2], 3]
    assert (under.min(0) <= feet_m.min(0)[[0, 2]]).all()
    assert (under.max(0) >= feet_m.max(0)[[0, 2]]).all()


@pytest.mark.parametrize(("deep_m", "hollow"), [(0.09, True), (0.02, False)])
def test_a_bench_is_hollowed_where_a_knee_stays_deep_inside(tmp_path: Path, deep_m: float, hollow: bool) -> None:
    """Somebody stands at a bench's end: a knee is little of a body's skin, but too deep for an error of the pose."""
    walk = planted_walk(60)
    motion = walk.with_pose(
        translation_world_m=np.repeat(walk.T_world_root[:1, :3, 3], 60, axis=0),
        R_parent_joint=np.tile(np.eye(3), (60, 22, 1, 1)),
    )
    body = shaped_body(motion.shape)
    knee_m = motion.joints_world_m[0, JOINT_INDEX["left_knee"]]
    shin = np.flatnonzero(body.vertex_part == JOINT_INDEX["left_knee"])
    front_m = float(posed_vertices(motion, body, shin, np.array([0]))[..., 2].max())
    bench = box_mesh(0.2, 0.5, 1.0)
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = knee_m[0], front_m - deep_m + 0.5
    placed = [PlacedObject(1, "bench", bench, 1.0, T_world_object, 0.0, 0.0, True, "")]
    ctx = StageContext(tmp_path)
    (kept,) = _not_refuted(placed, BodyTracks((motion,)), SceneConfig(), ctx)
    assert ("hollowed" in kept.reason) is hollow
    assert len(ctx.warnings) == hollow


@pytest.mark.parametrize(("too_high_m", "taken_out"), [(0.1, True), (0.02, False)])
def test_a_step_that_is_too_high_is_taken_out_above_the_soles(
    tmp_path: Path, too_high_m: float, taken_out: bool
) -> None:
    """Somebody stands on a platform whose top is over their soles: by much it is wrong, by little the pose may be."""
    walk = planted_walk(60)
    motion = walk.with_pose(
        translation_world_m=np.repeat(walk.T_world_root[:1, :3, 3], 60, axis=0),
        R_parent_joint=np.tile(np.eye(3), (60, 22, 1, 1)),
    )
    feet = [JOINT_INDEX[name] for name in ("left_ankle", "right_ankle", "left_foot", "right_foot")]
    contact = np.zeros_like(motion.contact)
    contact[:, feet] = 1.0
    body = shaped_body(motion.shape)
    soles = np.flatnonzero(np.isin(body.vertex_part, feet))
    low_m = float(posed_vertices(motion, body, soles, np.array([0]))[..., 1].min())
    motion = replace(raised(motion, 0.4 - low_m), contact=contact)
    middle_m = motion.joints_world_m[0, feet].mean(0)
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = middle_m[[0, 2]]
    platform = box_mesh(1.2, 0.4 + too_high_m, 1.2)
    placed = [PlacedObject(1, "platform", platform, 1.0, T_world_object, 0.0, 0.0, True, "")]
    ctx = StageContext(tmp_path)
    (kept,) = _not_refuted(placed, BodyTracks((motion,)), SceneConfig(), ctx)
    assert ("hollowed" in kept.reason) is taken_out
    assert len(ctx.warnings) == taken_out
    solid = world_mesh(kept.mesh, kept.T_world_object, kept.scale)
    bounds_m = np.array([[-0.8, -0.1, -0.8], [0.8, 1.0, 0.8]]) + middle_m * [1, 0, 1]
    field = build_sdf_grid([solid], bounds_m, 0.02, floor_y_m=None)
    foot_m = posed_vertices(motion, body, soles, np.array([0]))
    assert field.sample(foot_m).min() == pytest.approx(-0.02, abs=0.03)
    assert field.sample(middle_m * [1, 0, 1] + [0.0, 0.2, 0.0]) < -0.1, "what is under the soles stays"


def test_only_feet_in_contact_stand_in_a_thing() -> None:
    """Everything is solid here: the frames that count are those of contact."""
    walk, everything = planted_walk(90), SdfGrid(np.full((3, 3, 3), -1.0), np.full(3, -50.0), 50.0)
    body = shaped_body(walk.shape)
    feet = [JOINT_INDEX[name] for name in ("left_ankle", "right_ankle", "left_foot", "right_foot")]
    standing = walk.valid & (walk.contact[:, feet].max(1) > 0.5)
    assert standing.any()
    np.testing.assert_array_equal(stood_inside(everything, walk, body, deep_m=0.04), standing)
    swinging = replace(walk, contact=np.zeros_like(walk.contact))
    assert not stood_inside(everything, swinging, body, deep_m=0.04).any()
