"""Depth inside objects, against hand-computed answers and trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from video2anim.lab.synth.rooms import clearance_ok, make_furniture, penetration_m
from video2anim.lab.synth.rooms.clearance import SweepIndex
from video2anim.lab.synth.rooms.making import pose
from video2anim.lab.synth.rooms.placing import Boxes, overlap
from video2anim.lab.synth.rooms.primitives import lathe, merge, plain_box, tube
from video2anim.lab.synth.world import Material, Part, SceneObject

PLAIN = Material("plain", (0.5, 0.5, 0.5))


def _thing(*meshes, T=None) -> SceneObject:
    parts = tuple(Part(v, f, PLAIN) for v, f in meshes)
    return SceneObject(1, "box", parts, np.eye(4) if T is None else T)


def _reference_depth(solid: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """By trimesh: ray parity, and the closest point of every triangle."""
    depth = np.zeros(len(points))
    for k in np.flatnonzero(solid.contains(points)):
        closest = trimesh.triangles.closest_point(solid.triangles, np.broadcast_to(points[k], (len(solid.faces), 3)))
        depth[k] = np.linalg.norm(closest - points[k], axis=1).min()
    return depth


def test_depth_in_a_turned_box_is_exact():
    box = _thing(plain_box(2.0, 1.0, 0.4), T=pose(3.0, -1.0, 0.7))
    local = np.array([[0, 0.5, 0], [0.9, 0.5, 0], [0, 0.95, 0.1], [0, 0.5, 0.21], [0, 1.01, 0], [0, -0.01, 0]])
    points = local @ box.T_world_object[:3, :3].T + box.T_world_object[:3, 3]
    assert penetration_m([box], points) == pytest.approx([0.2, 0.1, 0.05, 0, 0, 0], abs=1e-9)
    assert clearance_ok([box], points[3:])
    assert not clearance_ok([box], points)


def test_hollow_ring_is_empty_in_the_middle():
    ring = _thing(lathe([(0.5, 0), (0.5, 1.0), (0.4, 1.0), (0.4, 0)], 256, closed=True))
    points = np.array([[0, 0.5, 0], [0.45, 0.5, 0], [0.49, 0.5, 0], [0.39, 0.5, 0.0]])
    assert penetration_m([ring], points) == pytest.approx([0, 0.05, 0.01, 0], abs=2e-4)


def test_depth_agrees_with_trimesh_in_bent_and_loose_solids():
    rng = np.random.default_rng(0)
    bent = tube(np.stack([np.linspace(0, 1, 9), np.linspace(0, 1, 9) ** 2, np.zeros(9)], 1), 0.15, 12)
    for mesh in (bent, merge([bent, plain_box(0.3, 0.3, 0.3, x=2.0)])):
        points = rng.uniform(mesh[0].min(0), mesh[0].max(0), (3000, 3))
        depth = penetration_m([_thing(mesh)], points)
        solid = trimesh.Trimesh(*mesh, process=False)
        assert np.abs(depth - _reference_depth(solid, points)).max() < 1e-6
        assert (depth > 0).sum() > 50


def test_depth_in_furniture_is_the_greatest_over_its_parts():
    rng = np.random.default_rng(1)
    objects = [make_furniture("chair", rng).moved(pose(k * 1.0, 0, 0.3 * k)) for k in range(3)]
    points = rng.uniform([-1, 0, -1], [3, 1, 1], (2500, 3))
    expected = np.zeros(len(points))
    for obj in objects:
        for part in obj.parts:
            vertices = part.vertices_m @ obj.T_world_object[:3, :3].T + obj.T_world_object[:3, 3]
            solid = trimesh.Trimesh(vertices, part.faces, process=False)
            near = ((points > vertices.min(0)) & (points < vertices.max(0))).all(1)
            if near.any():
                expected[near] = np.maximum(expected[near], _reference_depth(solid, points[near]))
    assert penetration_m(objects, points) == pytest.approx(expected, abs=1e-6)


def test_no_points_and_no_objects():
    assert penetration_m([], np.zeros((0, 3))).shape == (0,)
    assert penetration_m([_thing(plain_box(1, 1, 1))], np.zeros((0, 3))).shape == (0,)
    assert penetration_m([], np.zeros((4, 3))).tolist() == [0, 0, 0, 0]


def test_turned_boxes_overlap_only_where_they_meet():
    a = Boxes.of(_thing(plain_box(2, 1, 1)))
    b = _thing(plain_box(2, 1, 1))
    assert overlap(a, Boxes.of(b.moved(pose(1.9, 0, 0))))
    assert not overlap(a, Boxes.of(b.moved(pose(2.01, 0, 0))))
    assert overlap(a, Boxes.of(b.moved(pose(2.01, 0, 0))), 0.02)
    # a corner that only the boxes' axis-parallel hulls share
    assert not overlap(a, Boxes.of(b.moved(pose(1.75, 1.25, np.pi / 4))))
    assert overlap(a, Boxes.of(b.moved(pose(1.3, 0.8, np.pi / 4))))
    assert not overlap(a, Boxes.of(b.moved(pose(0, 0, 0, y=1.0))))


def test_sweep_index_finds_all_points_of_a_rectangle():
    rng = np.random.default_rng(2)
    points = rng.uniform([-3, 0, -2], [4, 1.8, 5], (20_000, 3))
    index = SweepIndex(points, grid_m=1e-6)
    low, high = np.array([-1.0, 0.3]), np.array([0.7, 2.0])
    found = index.near(low, high)
    inside = ((points[:, [0, 2]] >= low) & (points[:, [0, 2]] <= high)).all(1)
    found_inside = ((found[:, [0, 2]] >= low) & (found[:, [0, 2]] <= high)).all(1)
    assert found_inside.sum() == inside.sum() > 100
    assert len(index.near(np.array([9.0, 9.0]), np.array([10.0, 10.0]))) == 0
