"""The body's path as evidence about the scene: supports under raised feet, objects left out that are walked through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import planted_walk

from stages.scene import SceneConfig, _not_walked_through, _rested, _supports
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.pipeline.stage import StageContext
from video2anim.scene.supports import SUPPORT
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
def test_only_an_object_that_is_walked_through_is_left_out(tmp_path: Path, aside_m: float, kept: int) -> None:
    motion = planted_walk(90)
    center = motion.T_world_root[45, :3, 3]
    forward = motion.T_world_root[-1, :3, 3] - motion.T_world_root[0, :3, 3]
    side = np.cross(forward / np.linalg.norm(forward), [0.0, 1.0, 0.0])
    place = center + aside_m * side
    ctx = StageContext(tmp_path)
    placed = [box_at(place[0], place[2])]
    assert len(_not_walked_through(placed, [], BodyTracks((motion,)), SceneConfig(), ctx)) == kept
    assert ["somebody walks" in warning for warning in ctx.warnings] == [True] * (1 - kept)


def test_what_somebody_rests_on_stays_though_another_walks_in_it(tmp_path: Path) -> None:
    """One stands still on a roof, another walks along under it: the roof is there, the other's place is off."""
    still = raised(planted_walk(90), 1.6)
    walker, ctx = planted_walk(90), StageContext(tmp_path)
    shed = [replace(box_at(0.0, 1.0), mesh=box_mesh(4.0, 1.6, 6.0))]
    bodies = BodyTracks((still, walker))
    assert _not_walked_through(shed, [], bodies, SceneConfig(), ctx) == []
    assert _not_walked_through(shed, _rested(bodies), bodies, SceneConfig(), ctx) == shed


def test_a_body_that_stands_in_an_object_does_not_take_it_away(tmp_path: Path) -> None:
    """Its depth may be off by as much; only who walks there, over half a meter, says that nothing is there."""
    walk = planted_walk(60)
    standing = walk.with_pose(
        translation_world_m=np.repeat(walk.T_world_root[30:31, :3, 3], 60, axis=0), R_parent_joint=walk.R_parent_joint
    )
    x_m, _, z_m = standing.T_world_root[0, :3, 3]
    placed, ctx = [box_at(x_m, z_m)], StageContext(tmp_path)
    assert _not_walked_through(placed, [], BodyTracks((standing,)), SceneConfig(), ctx) == placed
    assert ctx.warnings == []
    assert _not_walked_through(placed, [], BodyTracks((walk,)), SceneConfig(), ctx) == []
