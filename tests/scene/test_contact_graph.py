"""Who touches what: bodies that sit, stand and reach beside boxes of known place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from synthetic import FPS, planted_walk, rotation

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import posed_vertices
from video2anim.geometry.scene_mesh import box_mesh, empty_mesh
from video2anim.scene.contact_graph import contact_graph, scene_contacts
from video2anim.types import (
    BodyMotion,
    Contact,
    Hold,
    Mesh,
    ObjectPart,
    ObjectPath,
    PlacedObject,
    RoomPiece,
    SceneModel,
)
from video2anim.types.skeleton import JOINT_INDEX

FRAMES = 60
SITTING = {"left_hip": -1.5, "right_hip": -1.5, "left_knee": 1.5, "right_knee": 1.5}
KNEELING = {"left_knee": 1.57, "right_knee": 1.57}
PELVIS_M = 0.6
SKIN_M = 0.006
"""A part of the skin is looked at: the lowest point of a hand may be missed by 5 mm."""


def still(turned_rad: Mapping[str, float], *, pelvis_m: float | np.ndarray = PELVIS_M) -> BodyMotion:
    """A T-pose with some joints turned about x, nothing in contact, the pelvis at a height or at one per frame."""
    R_parent_joint = np.tile(np.eye(3), (FRAMES, 22, 1, 1))
    for name, angle_rad in turned_rad.items():
        R_parent_joint[:, JOINT_INDEX[name]] = rotation("x", np.full(FRAMES, angle_rad))
    root_m = np.zeros((FRAMES, 3))
    root_m[:, 1] = pelvis_m
    posed = planted_walk(FRAMES).with_pose(translation_world_m=root_m, R_parent_joint=R_parent_joint)
    return replace(posed, contact=np.zeros((FRAMES, 22)))


def touching(motion: BodyMotion, joint: str, frames: slice | np.ndarray = slice(None)) -> BodyMotion:
    contact = motion.contact.copy()
    contact[frames, JOINT_INDEX[joint]] = 1.0
    return replace(motion, contact=contact)


def skin_m(motion: BodyMotion, joint: str) -> np.ndarray:
    body = shaped_body(motion.shape)
    index = np.flatnonzero(body.vertex_part == JOINT_INDEX[joint])
    return posed_vertices(motion, body, index, np.array([0]))[0]


def placed(object_id: int, label: str, mesh: Mesh, at_m: Sequence[float], **more: object) -> PlacedObject:
    T_world_object = np.eye(4)
    T_world_object[:3, 3] = at_m
    return PlacedObject(object_id, label, mesh, 1.0, T_world_object, None, None, True, "", **more)


def scene_of(*objects: PlacedObject) -> SceneModel:
    return SceneModel(objects, RoomPiece("floor", empty_mesh()), (), np.ones((2, 2, 2)), np.zeros(3), 1.0)


def joined(*boxes: tuple[str, Mesh, Sequence[float]]) -> tuple[Mesh, tuple[ObjectPart, ...]]:
    """One mesh of boxes at places, a part each."""
    vertices, faces, parts = [], [], []
    for name, mesh, at_m in boxes:
        parts.append(ObjectPart(name, sum(map(len, faces)), len(mesh.faces)))
        faces.append(mesh.faces + sum(map(len, vertices)))
        vertices.append(mesh.vertices_m + np.asarray(at_m))
    rgb = np.zeros((sum(map(len, vertices)), 3), np.uint8)
    return Mesh(np.concatenate(vertices), np.concatenate(faces), rgb), tuple(parts)


def told(contacts: Sequence[Contact]) -> set[tuple[str, int | None, str]]:
    return {(one.body_part, one.object_id, one.surface) for one in contacts}


def sitting() -> tuple[BodyMotion, float]:
    """Somebody who sits, and the height of the lowest skin of seat and thighs."""
    motion = touching(still(SITTING), "pelvis")
    return motion, min(skin_m(motion, joint)[:, 1].min() for joint in ("pelvis", "left_hip", "right_hip"))


def test_somebody_who_sits_on_a_box_touches_its_top_with_seat_and_thighs() -> None:
    motion, low_m = sitting()
    box = placed(4, "box", box_mesh(0.6, low_m + 0.01, 0.6), [0.0, 0.0, 0.1])
    contacts = contact_graph(motion, scene_of(box))
    assert told(contacts) == {(part, 4, "top") for part in ("seat", "left thigh", "right thigh")}
    for contact in contacts:
        assert (contact.label, contact.person_id) == ("box", 1)
        assert (contact.start_s, contact.end_s) == pytest.approx((0.0, (FRAMES - 1) / FPS))
    deepest_m = skin_m(motion, "pelvis")[:, 1].min() - (low_m + 0.01)
    seat = next(one for one in contacts if one.body_part == "seat")
    assert seat.mean_distance_m == pytest.approx(deepest_m, abs=SKIN_M)
    assert seat.largest_distance_m == pytest.approx(seat.mean_distance_m)


def test_parts_of_an_object_are_told_by_name() -> None:
    motion, low_m = sitting()
    motion = touching(motion, "spine3")
    behind_m = skin_m(motion, "spine3")[:, 2].min()
    mesh, parts = joined(
        ("seat", box_mesh(0.5, 0.08, 0.6), [0.0, low_m - 0.07, 0.1]),
        ("back", box_mesh(0.5, 0.9, 0.05), [0.0, low_m, behind_m - 0.02]),
        ("leg", box_mesh(0.1, low_m - 0.08, 0.1), [0.0, 0.0, 0.1]),
    )
    contacts = contact_graph(motion, scene_of(placed(2, "chair", mesh, [0.0, 0.0, 0.0], parts=parts)))
    assert told(contacts) == {
        ("seat", 2, "seat"), ("left thigh", 2, "seat"), ("right thigh", 2, "seat"), ("back", 2, "back"),
    }  # fmt: skip


def test_a_face_that_is_not_the_usual_one_of_its_part_is_told_too() -> None:
    motion = touching(still({}, pelvis_m=0.95), "left_wrist")
    hand_m = skin_m(motion, "left_wrist")
    at_m = [hand_m[:, 0].max() + 0.1, hand_m[:, 1].mean() - 0.2, hand_m[:, 2].mean()]
    mesh, parts = joined(("arm", box_mesh(0.2, 0.4, 0.4), [0.0, 0.0, 0.0]))
    scene = scene_of(placed(1, "sofa", mesh, at_m, parts=parts))
    assert told(contact_graph(motion, scene)) == {("left hand", 1, "arm side")}


def hand_over_table(height_m: np.ndarray, likely: np.ndarray) -> tuple[Contact, ...]:
    """A hand so high over a table top in each frame; the motion says in which frames it touches."""
    motion = touching(still({}, pelvis_m=0.95), "left_wrist", likely)
    hand_m = skin_m(motion, "left_wrist")
    table = placed(7, "table", box_mesh(0.3, hand_m[:, 1].min(), 0.6), [hand_m[:, 0].mean(), 0.0, 0.0])
    root_m = motion.T_world_root[:, :3, 3] + np.outer(height_m, [0.0, 1.0, 0.0])
    moved = motion.with_pose(translation_world_m=root_m, R_parent_joint=motion.R_parent_joint)
    return contact_graph(moved, scene_of(table))


def test_a_hand_touches_a_table_between_two_times() -> None:
    frame = np.arange(FRAMES)
    lies = (frame >= 20) & (frame < 41)
    (contact,) = hand_over_table(np.where(lies, 0.01, 0.2), np.ones(FRAMES, bool))
    assert told([contact]) == {("left hand", 7, "top")}
    assert (contact.start_s, contact.end_s) == pytest.approx((20 / FPS, 40 / FPS))
    assert contact.mean_distance_m == pytest.approx(0.01, abs=SKIN_M)


def test_what_hovers_touches_nothing() -> None:
    assert hand_over_table(np.full(FRAMES, 0.1), np.ones(FRAMES, bool)) == ()
    motion, low_m = sitting()
    assert contact_graph(motion, scene_of(placed(4, "box", box_mesh(0.6, low_m - 0.1, 0.6), [0.0, 0.0, 0.1]))) == ()


def test_a_hand_that_the_motion_does_not_say_to_touch_does_not() -> None:
    assert hand_over_table(np.zeros(FRAMES), np.zeros(FRAMES, bool)) == ()


def test_flickers_are_closed_or_dropped() -> None:
    likely = np.zeros(FRAMES, bool)
    likely[10:40] = True
    likely[[15, 16, 30, 31, 32]] = False  # 0.07 s, closed; 0.1 s, a gap
    likely[50:52] = True  # 0.07 s, dropped
    found = hand_over_table(np.zeros(FRAMES), likely)
    assert [(round(one.start_s * FPS), round(one.end_s * FPS)) for one in found] == [(10, 29), (33, 39)]


def test_between_touches_a_hand_may_leave_by_less_than_5_cm() -> None:
    height_m = np.zeros(FRAMES)
    height_m[20:30], height_m[40:50] = 0.04, 0.06
    found = hand_over_table(height_m, np.ones(FRAMES, bool))
    assert [(round(one.start_s * FPS), round(one.end_s * FPS)) for one in found] == [(0, 39), (50, 59)]
    assert found[0].largest_distance_m == pytest.approx(0.04, abs=SKIN_M)


def test_feet_stand_on_the_floor_and_not_at_the_side_of_what_is_near() -> None:
    feet = ("left_ankle", "left_foot")
    motion = still({})
    sole_m = min(skin_m(motion, joint)[:, 1].min() for joint in feet)
    motion = still({}, pelvis_m=PELVIS_M - sole_m + 0.005)
    for joint in feet:
        motion = touching(motion, joint)
    left_m = max(skin_m(motion, joint)[:, 0].max() for joint in feet)
    beside = placed(3, "box", box_mesh(0.2, 0.4, 0.6), [left_m + 0.1, 0.0, 0.0])
    assert told(contact_graph(motion, scene_of(beside))) == {("left foot", None, "floor")}
    # A foot that hovers a little does not hold on to the box either.
    hovers = motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + [0.0, 0.035, 0.0], R_parent_joint=motion.R_parent_joint
    )
    assert contact_graph(hovers, scene_of(beside)) == ()
    # Without a floor under it the side is what it touches.
    higher = motion.with_pose(
        translation_world_m=motion.T_world_root[:, :3, 3] + [0.0, 0.2, 0.0], R_parent_joint=motion.R_parent_joint
    )
    assert told(contact_graph(higher, scene_of(beside))) == {("left foot", 3, "side")}


def test_who_kneels_has_the_shins_on_the_floor_and_who_hurries_not() -> None:
    motion = still(KNEELING)
    low_m = min(skin_m(motion, f"{side}_knee")[:, 1].min() for side in ("left", "right"))
    motion = still(KNEELING, pelvis_m=PELVIS_M - low_m)
    assert told(contact_graph(motion, scene_of())) == {("left shin", None, "floor"), ("right shin", None, "floor")}
    root_m = motion.T_world_root[:, :3, 3] + np.outer(np.arange(FRAMES) / FPS, [0.0, 0.0, 1.0])
    slides = motion.with_pose(translation_world_m=root_m, R_parent_joint=motion.R_parent_joint)
    assert contact_graph(slides, scene_of()) == ()


def test_turned_scaled_objects_and_further_people() -> None:
    motion, low_m = sitting()
    box = placed(4, "box", box_mesh(0.6, 0.5 * low_m + 0.005, 0.6), [0.0, 0.0, 0.1])
    T_world_object = box.T_world_object.copy()
    T_world_object[:3, :3] = rotation("y", np.array(0.3))
    box = replace(box, T_world_object=T_world_object, scale=2.0)
    other = replace(motion, person_id=9)
    contacts = scene_contacts((motion, other), scene_of(box))
    assert [one.person_id for one in contacts] == [1] * 3 + [9] * 3
    assert told(contacts) == {(part, 4, "top") for part in ("seat", "left thigh", "right thigh")}


def moved(item: PlacedObject, way_m: np.ndarray, *holds: Hold) -> PlacedObject:
    """An object that is so far from its place in each frame."""
    T_world_object = np.tile(item.T_world_object, (len(way_m), 1, 1))
    T_world_object[:, :3, 3] += way_m
    return replace(item, T_world_object=T_world_object[0], path=(ObjectPath(T_world_object, holds),))


def test_who_sits_on_a_stool_that_was_pulled_there_touches_it_from_then_on() -> None:
    motion, low_m = sitting()
    box = placed(4, "stool", box_mesh(0.6, low_m + 0.01, 0.6), [0.0, 0.0, 0.1])
    way_m = np.zeros((FRAMES, 3))
    way_m[:, 0] = np.clip(1.0 - np.arange(FRAMES) / 30.0, 0.0, None)
    contacts = contact_graph(motion, scene_of(moved(box, way_m)))
    assert told(contacts) == {(part, 4, "top") for part in ("seat", "left thigh", "right thigh")}
    for contact in contacts:
        assert 10 / FPS < contact.start_s < 30 / FPS, "it touches before the stool is all the way there"
        assert contact.end_s == pytest.approx((FRAMES - 1) / FPS)


def test_a_hand_touches_what_it_carries_all_the_way_and_nothing_else() -> None:
    """A hand goes forward with a board under it, over a table that is as high as the board's top."""
    motion = still({}, pelvis_m=0.95)
    hand_m = skin_m(motion, "left_wrist")
    way_m = np.outer(np.clip(np.arange(FRAMES) - 10, 0, 30) / 30.0, [0.0, 0.0, 1.0])
    root_m = motion.T_world_root[:, :3, 3] + way_m
    motion = motion.with_pose(translation_world_m=root_m, R_parent_joint=motion.R_parent_joint)
    at_m = [hand_m[:, 0].mean(), hand_m[:, 1].min() - 0.02, hand_m[:, 2].mean()]
    board = placed(6, "board", box_mesh(0.3, 0.02, 0.3), at_m)
    table = placed(7, "table", box_mesh(0.3, hand_m[:, 1].min(), 3.0), [at_m[0], 0.0, 0.0])
    hold = Hold(motion.person_id, "left hand", 5, 45)
    (contact,) = contact_graph(motion, scene_of(table, moved(board, way_m, hold)))
    assert told([contact]) == {("left hand", 6, "top")}
    assert (contact.start_s, contact.end_s) == pytest.approx((5 / FPS, 45 / FPS))
    assert contact.largest_distance_m == pytest.approx(0.0, abs=SKIN_M)
    both = Hold(motion.person_id, "both hands", 5, 45)
    assert told(contact_graph(motion, scene_of(table, moved(board, way_m, both)))) == told([contact])
    somebody = Hold(motion.person_id + 1, "left hand", 5, 45)
    assert contact_graph(motion, scene_of(table, moved(board, way_m, somebody))) == ()
    # Where the board does not come along, the hand leaves it.
    (left,) = contact_graph(motion, scene_of(moved(board, 0 * way_m, hold)))
    assert left.end_s < 20 / FPS
