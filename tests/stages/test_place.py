"""Pose and scale of objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scene_chain import T_room_world, run_chain
from synthetic_room import BOX_CENTER_M, camera_pose, make_room

from stages.place import PlaceConfig, place_objects
from video2anim.geometry.placement import place
from video2anim.geometry.projection import invert_rigid, transform_points
from video2anim.geometry.visible import visible_vertices
from video2anim.pipeline.stage import StageContext
from video2anim.types import Intrinsics, ObjectMeshes


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(14.0, 0.0), (22.0, 12.0)])
def test_box_is_placed(pitch_deg: float, roll_deg: float) -> None:
    room = make_room(pitch_deg=pitch_deg, roll_deg=roll_deg)
    chain = run_chain(room)
    placed = chain.placed.objects[0]
    assert placed.trusted, placed.reason
    offset = (T_room_world(room, chain) @ placed.T_world_object)[:3, 3] - BOX_CENTER_M
    assert np.hypot(offset[0], offset[2]) < 0.25
    assert placed.T_world_object[1, 3] == 0
    assert np.allclose(placed.T_world_object[:3, 1], [0, 1, 0])
    assert placed.chamfer_after_m <= placed.chamfer_before_m
    assert 0.8 < placed.scale < 1.25


@pytest.mark.parametrize("least_points", [30, 10**6])
def test_a_raised_object_keeps_its_height(least_points: int) -> None:
    """Fitted, or left at its first guess for want of points; nothing is under it on which it could be put down."""
    room = make_room(pitch_deg=14.0, roll_deg=0.0)
    chain = run_chain(room)
    (found,) = chain.meshes.objects
    raised = found.T_world_object.copy()
    raised[1, 3] = 0.7
    meshes = ObjectMeshes((replace(found, T_world_object=raised),))
    config, ctx = PlaceConfig(least_points=least_points), StageContext(Path())
    (placed,) = place_objects(meshes, chain.masks, chain.metric, config, ctx).objects
    assert placed.T_world_object[1, 3] == 0.7


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
        vertices, faces, start, world_m[seen], T_world_camera, intrinsics,
        yaw_starts_rad=(-1.0, 0.6, 2.0), rng=np.random.default_rng(0),
    )  # fmt: skip
    assert found.T_world_object[1, 3] == base_m
    assert np.abs(found.T_world_object[:3, 3] - truth[:3, 3]).max() < 0.08
    found_yaw = np.arctan2(found.T_world_object[0, 2], found.T_world_object[2, 2])
    assert found_yaw == pytest.approx(yaw, abs=0.12)
    assert found.scale == pytest.approx(1.2, rel=0.08)
    assert found.chamfer_after_m < 0.5 * found.chamfer_before_m
