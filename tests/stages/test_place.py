"""Pose and scale of objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scene_chain import Chain, T_room_world, run_chain
from synthetic_room import BOX_CENTER_M, camera_pose, make_room

from stages.place import PlaceConfig, place_objects
from video2anim.geometry.line_of_sight import visible_vertices
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.objects.placement import place
from video2anim.pipeline.stage import StageContext
from video2anim.types import Intrinsics, ObjectMesh, ObjectMeshes, PlacedObject, View


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(14.0, 0.0), (22.0, 12.0)])
def test_box_is_placed(pitch_deg: float, roll_deg: float) -> None:
    room = make_room(pitch_deg=pitch_deg, roll_deg=roll_deg)
    chain = run_chain(room)
    placed = chain.placed.objects[0]
    assert placed.trusted, placed.reason
    offset = (T_room_world(room, chain) @ placed.T_world_object)[:3, 3] - BOX_CENTER_M
    assert np.hypot(offset[0], offset[2]) < 0.25
    assert placed.T_world_object[1, 3] == pytest.approx(0, abs=0.005)
    assert np.allclose(placed.T_world_object[:3, 1], [0, 1, 0])
    assert placed.chamfer_after_m < 0.05
    assert placed.scale == 1
    assert placed.position_sigma_m > 0.01


@pytest.mark.parametrize("fitted", [True, False])
@pytest.mark.parametrize("min_points", [30, 10**6])
def test_a_raised_object_keeps_its_height(min_points: int, fitted: bool) -> None:
    """A fitted form, a mesh of the user, or one at its first guess for want of points; nothing is under it on which it
    could be put down."""
    chain, found = box_of_the_chain()
    raised = found.T_world_object.copy()
    raised[1, 3] = 0.7
    (placed,) = place_again(
        chain, replace(found, T_world_object=raised, chamfer_m=found.chamfer_m if fitted else None),
        PlaceConfig(min_points=min_points),
    )  # fmt: skip
    assert placed.T_world_object[1, 3] == 0.7


def box_of_the_chain() -> tuple[Chain, ObjectMesh]:
    chain = run_chain(make_room(pitch_deg=14.0, roll_deg=0.0))
    (found,) = chain.meshes.objects
    return chain, found


def place_again(chain: Chain, found: ObjectMesh, config: PlaceConfig | None = None) -> tuple[PlacedObject, ...]:
    meshes = ObjectMeshes((found,))
    return place_objects(meshes, chain.masks, chain.metric, config or PlaceConfig(), StageContext(Path())).objects


def test_a_fitted_form_stays_and_another_mesh_is_fitted() -> None:
    """Put 0.4 m aside, a form is where its fit says; a mesh without a fit goes back to its depth points."""
    chain, found = box_of_the_chain()
    aside = found.T_world_object.copy()
    aside[0, 3] += 0.4
    (kept,) = place_again(chain, replace(found, T_world_object=aside))
    np.testing.assert_array_equal(kept.T_world_object, aside)
    assert kept.chamfer_before_m is None
    assert (kept.chamfer_after_m, kept.position_sigma_m, kept.yaw_sigma_rad, kept.scale_sigma) == (
        found.chamfer_m, found.position_sigma_m, found.yaw_sigma_rad, found.size_sigma
    )  # fmt: skip
    assert kept.parts == found.parts
    (fitted,) = place_again(chain, replace(found, T_world_object=aside, chamfer_m=None))
    assert abs(fitted.T_world_object[0, 3] - found.T_world_object[0, 3]) < 0.2
    assert fitted.chamfer_after_m < fitted.chamfer_before_m
    assert 0.8 < fitted.scale < 1.25


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"chamfer_m": 0.3}, "form and depth stay 0.30 m apart"),
        ({"outline_iou": 0.4}, "form and outline overlap by 40% only"),
        ({"chamfer_m": 0.2, "outline_iou": 0.6}, None),
    ],
)
def test_forms_far_from_depth_or_outline_are_not_trusted(changed: dict, told: str | None) -> None:
    chain, found = box_of_the_chain()
    (placed,) = place_again(chain, replace(found, **changed))
    assert placed.trusted == (told is None)
    assert told is None or told in placed.reason


@pytest.mark.parametrize(("base_m", "pitch_deg"), [(0.0, 18.0), (0.7, 8.0)])
def test_known_mesh_is_brought_to_its_points(base_m: float, pitch_deg: float) -> None:
    """An L-shaped solid, seen from one side, starting off in position, yaw and size. The height it rests on stays."""
    parts = [trimesh.creation.box((0.8, 0.4, 0.6)), trimesh.creation.box((0.8, 0.6, 0.1))]
    parts[0].apply_translation([0, 0.2, 0])
    parts[1].apply_translation([0, 0.6, -0.25])
    mesh = trimesh.util.concatenate(parts).subdivide_to_size(0.06)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    yaw = 0.4
    truth = np.array(
        [[np.cos(yaw), 0, np.sin(yaw), 0.5], [0, 1, 0, base_m], [-np.sin(yaw), 0, np.cos(yaw), -3.5], [0, 0, 0, 1]]
    )
    intrinsics = Intrinsics.centered(600.0, 640, 360)
    T_world_camera = camera_pose(1.6, pitch_deg)
    world_m = transform_points(truth, 1.2 * vertices)
    seen = visible_vertices(transform_points(invert_rigid(T_world_camera), world_m), faces, intrinsics)
    start = np.eye(4)
    start[:3, 3] = (0.7, base_m, -3.3)
    found = place(
        vertices, faces, start, world_m[seen], View(T_world_camera, intrinsics),
        yaw_starts_rad=(-1.0, 0.6, 2.0), rng=np.random.default_rng(0),
    )  # fmt: skip
    assert found.T_world_object[1, 3] == base_m
    assert np.abs(found.T_world_object[:3, 3] - truth[:3, 3]).max() < 0.08
    found_yaw = np.arctan2(found.T_world_object[0, 2], found.T_world_object[2, 2])
    assert found_yaw == pytest.approx(yaw, abs=0.12)
    assert found.scale == pytest.approx(1.2, rel=0.08)
    assert found.chamfer_after_m < 0.5 * found.chamfer_before_m
