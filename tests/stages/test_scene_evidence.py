"""The body's path as evidence about the scene: supports under raised feet, objects left out that are walked through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import planted_walk

from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.scene.inferred_supports import inferred_supports, rested_on, without_walked_through
from video2anim.scene.supports import SUPPORT, Support
from video2anim.types import BodyMotion, BodyTracks, PlacedObject


def raised(motion: BodyMotion, height_m: float) -> BodyMotion:
    root_m = motion.T_world_root[:, :3, 3] + [0.0, height_m, 0.0]
    return motion.with_pose(translation_world_m=root_m, R_parent_joint=motion.R_parent_joint)


def box_at(x_m: float, z_m: float) -> PlacedObject:
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = x_m, z_m
    return PlacedObject(1, "object", box_mesh(1.0, 1.5, 1.0), 1.0, T_world_object, 0.0, 0.0, True, "")


def supports(motion: BodyMotion, objects: list[PlacedObject]) -> tuple[list[PlacedObject], list[str]]:
    bodies = BodyTracks((motion,))
    return inferred_supports(objects, rested_on(bodies), bodies, max((item.object_id for item in objects), default=0))


def unrejected(
    objects: list[PlacedObject], rested: list[tuple[int, Support]], *people: BodyMotion
) -> tuple[list[PlacedObject], list[str]]:
    return without_walked_through(objects, rested, BodyTracks(people), spacing_m=0.06, max_path_m=0.5)


def test_feet_on_a_roof_put_a_support_under_them() -> None:
    (made,), warnings = supports(raised(planted_walk(90), 1.6), [box_at(5.0, 0.0)])
    assert (made.label, made.object_id) == (SUPPORT, 2)
    assert made.reason.startswith("inferred: the feet of person 1 rested in ")
    solid = world_mesh(made.mesh, made.T_world_object, made.scale)
    assert solid.vertices_m[:, 1].max() == pytest.approx(1.6, abs=0.05)
    assert solid.vertices_m[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    assert len(warnings) == 1


def test_numbers_of_supports_follow_those_of_all_objects() -> None:
    """Also of those that somebody moves, which are no supports."""
    bodies = BodyTracks((raised(planted_walk(90), 1.6),))
    (made,), _ = inferred_supports([box_at(5.0, 0.0)], rested_on(bodies), bodies, last_id=7)
    assert made.object_id == 8


def test_feet_on_the_floor_need_no_support() -> None:
    assert supports(planted_walk(90), []) == ([], [])


@pytest.mark.parametrize(("camera_m", "count"), [(1.5, 1), (4.0, 1), (8.0, 0)])
def test_seen_from_high_above_feet_a_little_off_the_floor_are_on_it(camera_m: float, count: int) -> None:
    motion = raised(planted_walk(90), 0.45)
    T_world_camera = motion.T_world_camera.copy()
    T_world_camera[:, 1, 3] = camera_m
    made, _ = supports(replace(motion, T_world_camera=T_world_camera), [])
    assert len(made) == count


def test_feet_on_something_that_is_there_need_no_support() -> None:
    roof = replace(box_at(0.0, 1.0), mesh=box_mesh(4.0, 1.5, 6.0))
    assert supports(raised(planted_walk(90), 1.6), [roof]) == ([], [])


def test_feet_in_the_air_without_contact_claim_nothing() -> None:
    motion = raised(planted_walk(90), 1.6)
    motion = replace(motion, contact=np.zeros_like(motion.contact))
    assert supports(motion, []) == ([], [])


@pytest.mark.parametrize(("aside_m", "kept"), [(0.0, 0), (2.5, 1)])
def test_only_an_object_that_is_walked_through_is_left_out(aside_m: float, kept: int) -> None:
    motion = planted_walk(90)
    center = motion.T_world_root[45, :3, 3]
    forward = motion.T_world_root[-1, :3, 3] - motion.T_world_root[0, :3, 3]
    side = np.cross(forward / np.linalg.norm(forward), [0.0, 1.0, 0.0])
    place = center + aside_m * side
    left, warnings = unrejected([box_at(place[0], place[2])], [], motion)
    assert len(left) == kept
    assert ["somebody walks" in warning for warning in warnings] == [True] * (1 - kept)


def test_what_somebody_rests_on_stays_though_another_walks_in_it() -> None:
    """One stands still on a roof, another walks along under it: the roof is there, the other's place is off."""
    still = raised(planted_walk(90), 1.6)
    walker = planted_walk(90)
    shed = [replace(box_at(0.0, 1.0), mesh=box_mesh(4.0, 1.6, 6.0))]
    bodies = BodyTracks((still, walker))
    assert unrejected(shed, [], *bodies.people)[0] == []
    assert unrejected(shed, rested_on(bodies), *bodies.people) == (shed, [])


def test_a_body_that_stands_in_an_object_does_not_take_it_away() -> None:
    """Its depth may be off by as much; only who walks there, over half a meter, says that nothing is there."""
    walk = planted_walk(60)
    standing = walk.with_pose(
        translation_world_m=np.repeat(walk.T_world_root[30:31, :3, 3], 60, axis=0), R_parent_joint=walk.R_parent_joint
    )
    x_m, _, z_m = standing.T_world_root[0, :3, 3]
    placed = [box_at(x_m, z_m)]
    assert unrejected(placed, [], standing) == (placed, [])
    assert unrejected(placed, [], walk)[0] == []
