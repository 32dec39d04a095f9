"""What the body was in is no part of an object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from synthetic import planted_walk

from video2anim.body.anny_body import shaped_body
from video2anim.fitting.hollow import hollowed
from video2anim.fitting.touching import posed_vertices
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.types import BodyMotion, Mesh

MARGIN_M = 0.02


def block(x_m: float, z_m: float, size_m: tuple[float, float, float]) -> Mesh:
    T_world_object = np.eye(4)
    T_world_object[[0, 2], 3] = x_m, z_m
    return world_mesh(box_mesh(*size_m), T_world_object, 1.0)


def volume_m3(mesh: Mesh) -> float:
    return float(trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).volume)


@pytest.fixture(scope="module")
def walk() -> BodyMotion:
    return planted_walk(60)


@pytest.fixture(scope="module")
def still(walk: BodyMotion) -> BodyMotion:
    """Somebody who stands in the middle of a step."""
    root_m = np.repeat(walk.T_world_root[30:31, :3, 3], 60, axis=0)
    return walk.with_pose(translation_world_m=root_m, R_parent_joint=np.repeat(walk.R_parent_joint[30:31], 60, axis=0))


def test_no_skin_is_left_deep_inside(still: BodyMotion) -> None:
    """A block around somebody: deeper than the margin, and a node of the field, there is no skin any more."""
    x, _, z = still.T_world_root[0, :3, 3]
    solid = block(float(x), float(z), (1.2, 1.0, 1.2))
    left = hollowed(solid, [still], margin_m=MARGIN_M, most_faces=4000)
    assert left is not None
    assert 0.95 < left.left_ratio < 0.999, "shins and thighs, less the margin all around"
    assert volume_m3(left.mesh) == pytest.approx(left.left_ratio * volume_m3(solid), rel=0.08)
    assert len(left.mesh.faces) <= 4000
    body = shaped_body(still.shape)
    legs = np.flatnonzero(np.isin(body.vertex_part, [0, 1, 2, 4, 5]))[::20]
    skin_m = posed_vertices(still, body, legs, np.arange(1))
    bounds_m = np.stack([solid.vertices_m.min(0) - 0.1, solid.vertices_m.max(0) + 0.1]).astype(float)
    before, after = (build_sdf_grid([m], bounds_m, 0.04, floor_y_m=None).sample(skin_m) for m in (solid, left.mesh))
    assert before.min() < -0.2
    assert np.percentile(before, 5) < -0.15
    assert np.percentile(after, 5) > -MARGIN_M - 0.04
    assert np.isfinite(left.mesh.vertices_m).all()


def test_an_object_beside_the_path_keeps_its_volume(walk: BodyMotion) -> None:
    x, _, z = walk.T_world_root[30, :3, 3]
    solid = block(float(x) + 3.0, float(z) + 3.0, (1.0, 1.0, 1.0))
    left = hollowed(solid, [walk], margin_m=MARGIN_M, most_faces=4000)
    assert left is not None
    assert left.left_ratio == pytest.approx(1.0)
    assert volume_m3(left.mesh) == pytest.approx(1.0, rel=0.05)


def test_nothing_is_left_of_what_the_body_filled(still: BodyMotion) -> None:
    """A block of 6 cm inside the pelvis."""
    T_world_object = np.eye(4)
    T_world_object[:3, 3] = still.T_world_root[0, :3, 3] - [0, 0.03, 0]
    inside = world_mesh(box_mesh(0.06, 0.06, 0.06), T_world_object, 1.0)
    assert hollowed(inside, [still], margin_m=0.0, most_faces=400) is None


def test_a_single_look_is_not_believed(walk: BodyMotion) -> None:
    """Every second frame is looked at; of two frames that is one."""
    valid = np.zeros(60, bool)
    valid[30:32] = True
    short = replace(walk, valid=valid)
    x, _, z = walk.T_world_root[30, :3, 3]
    left = hollowed(block(float(x), float(z), (1.0, 1.0, 1.0)), [short], margin_m=MARGIN_M, most_faces=4000)
    assert left is not None
    assert left.left_ratio == pytest.approx(1.0)
