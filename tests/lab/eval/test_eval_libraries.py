"""Own geometry against libraries that others wrote: trimesh, scipy, evo."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree, procrustes
from scipy.spatial.transform import Rotation
from tiny_truth import BOXES, ROOM, TinyBox

from scenemi import metrics
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.lab.eval.boxes import OrientedBox, box_iou_3d, box_of, chamfer_m, surface_points
from video2anim.lab.eval.clip_rows import angle_rad, box_iou, match_boxes
from video2anim.lab.eval.true_scene import SPACING_M, connected_parts, read_glb, true_field, world_mesh
from video2anim.lab.eval.truth import read_truth
from video2anim.types import Mesh


def random_box(rng: np.random.Generator) -> OrientedBox:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.normal(scale=0.3, size=3)
    return OrientedBox(T, rng.uniform(0.2, 0.8, 3))


@pytest.mark.parametrize("seed", range(6))
def test_box_iou_against_counted_points(seed: int) -> None:
    """Share of random points of one box that lie in the other, by trimesh's transforms."""
    rng = np.random.default_rng(seed)
    a, b = random_box(rng), random_box(rng)
    points = trimesh.transform_points(rng.uniform(-a.half_m, a.half_m, (200_000, 3)), a.T_world_box)
    local = trimesh.transform_points(points, np.linalg.inv(b.T_world_box))
    shared_m3 = a.volume_m3 * (np.abs(local) <= b.half_m).all(1).mean()
    expected = shared_m3 / (a.volume_m3 + b.volume_m3 - shared_m3)
    assert box_iou_3d(a, b) == pytest.approx(expected, abs=0.004)
    assert box_iou_3d(a, b) == pytest.approx(box_iou_3d(b, a))


def test_box_iou_by_hand() -> None:
    unit = OrientedBox(np.eye(4), np.full(3, 0.5))
    T = np.eye(4)
    T[0, 3] = 0.5
    assert box_iou_3d(unit, unit) == pytest.approx(1)
    assert box_iou_3d(unit, OrientedBox(T, unit.half_m)) == pytest.approx(0.5 / 1.5)
    T[0, 3] = 1.0
    assert box_iou_3d(unit, OrientedBox(T, unit.half_m)) == pytest.approx(0, abs=1e-6)
    T[0, 3] = 5.0
    assert box_iou_3d(unit, OrientedBox(T, unit.half_m)) == 0
    assert box_iou_3d(unit, OrientedBox(np.eye(4), np.full(3, 0.25))) == pytest.approx(1 / 8)
    T = np.eye(4)
    T[:2, :2] = np.sqrt(0.5) * np.array([[1, -1], [1, 1]])
    # Two unit squares, one turned by 45 degrees, share a regular octagon of area 2 sqrt(2) - 2.
    octagon = 2 * np.sqrt(2) - 2
    assert box_iou_3d(unit, OrientedBox(T, unit.half_m)) == pytest.approx(octagon / (2 - octagon))


def test_box_of_a_flat_object_has_a_volume() -> None:
    flat = box_of(np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1.0]]), np.eye(4))
    assert flat.volume_m3 > 0
    assert box_iou_3d(flat, flat) == pytest.approx(1, abs=1e-3)


def as_mesh(solid: trimesh.Trimesh) -> Mesh:
    rgb = np.zeros((len(solid.vertices), 3), np.uint8)
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces, np.int64), rgb)


def test_chamfer_against_trimesh_and_kdtree() -> None:
    a, b = trimesh.creation.icosphere(4, 0.5), trimesh.creation.icosphere(4, 0.6)
    rng = np.random.default_rng(0)
    points_a, points_b = surface_points(as_mesh(a), rng, 3000), surface_points(as_mesh(b), rng, 3000)
    _, off_surface, _ = trimesh.proximity.closest_point_naive(a, points_a[:200])
    assert off_surface.max() < 1e-6
    expected = 0.5 * (cKDTree(points_b).query(points_a)[0].mean() + cKDTree(points_a).query(points_b)[0].mean())
    assert chamfer_m(points_a, points_b) == pytest.approx(expected)
    # Concentric spheres lie 10 cm apart; finite samples add a little.
    assert chamfer_m(points_a, points_b) == pytest.approx(0.1, abs=0.006)


def test_surface_points_are_even() -> None:
    """A box of 1 x 2 x 3: each pair of sides gets its share of the area."""
    box = as_mesh(trimesh.creation.box(extents=(1, 2, 3)))
    points = surface_points(box, np.random.default_rng(1), 20_000)
    area = {0: 2 * 2 * 3, 1: 2 * 1 * 3, 2: 2 * 1 * 2}
    for axis, half in enumerate((0.5, 1.0, 1.5)):
        share = (np.abs(np.abs(points[:, axis]) - half) < 1e-9).mean()
        assert share == pytest.approx(area[axis] / 22, abs=0.01)
    assert np.abs(points.mean(0)).max() < 0.03


def test_true_field_against_trimesh(truth_dir: Path) -> None:
    """Sign by trimesh's `contains`, distance by its closest points, floor and walls by hand."""
    field = true_field(read_truth(truth_dir))
    rng = np.random.default_rng(2)
    points = rng.uniform([-1.4, 0.02, -3.0], [1.3, 1.5, -1.6], (3000, 3))
    expected = np.minimum(points[:, 1], points[:, 0] - ROOM[0])
    expected = np.minimum(expected, ROOM[1] - points[:, 0])
    expected = np.minimum(expected, np.minimum(points[:, 2] - ROOM[2], ROOM[3] - points[:, 2]))
    inside = np.zeros(len(points), bool)
    for box in BOXES:
        solid = trimesh.Trimesh(box.mesh().vertices_m, box.mesh().faces)
        solid.apply_transform(box.pose)
        _, distance, _ = trimesh.proximity.closest_point_naive(solid, points)
        within = solid.contains(points)
        inside |= within
        expected = np.minimum(expected, np.where(within, -distance, distance))
    found = field.sample(points)
    assert np.abs(found - expected).max() < SPACING_M
    assert np.abs(found - expected).mean() < 0.003
    deep = np.abs(expected) > 0.02
    assert ((found < 0) == inside)[deep].all()
    assert inside.sum() > 50


def test_parts_that_run_into_each_other_stay_solid(tmp_path: Path, truth_dir: Path) -> None:
    """Where two closed parts overlap, a count of crossings over both would call the inside free."""
    a, b = trimesh.creation.box(extents=(1, 1, 1)), trimesh.creation.box(extents=(1, 1, 1))
    b.apply_translation([0.5, 0, 0])
    trimesh.util.concatenate([a, b]).export(tmp_path / "both.glb")
    parts = connected_parts(read_glb(tmp_path / "both.glb"))
    assert sorted(len(part.faces) for part in parts) == [12, 12]
    assert all(trimesh.Trimesh(part.vertices_m, part.faces).is_watertight for part in parts)


def test_glb_comes_back_as_it_was(truth_dir: Path) -> None:
    truth = read_truth(truth_dir)
    item = next(item for item in truth.objects if item.object_id == BOXES[0].object_id)
    low, high = BOXES[0].bounds()
    found = world_mesh(item)
    np.testing.assert_allclose(found.vertices_m.min(0), low, atol=1e-6)
    np.testing.assert_allclose(found.vertices_m.max(0), high, atol=1e-6)
    assert trimesh.Trimesh(found.vertices_m, found.faces).is_watertight


def test_pa_mpjpe_against_scipy_procrustes() -> None:
    """scipy scales both shapes to unit size and may mirror; the error is scaled back to compare."""
    rng = np.random.default_rng(3)
    truth = rng.normal(size=(4, 22, 3))
    turn = Rotation.from_rotvec([0.4, 0.9, -0.2]).as_matrix()
    estimate = 0.8 * (truth + 0.05 * rng.normal(size=truth.shape)) @ turn.T + [1.0, 2.0, 3.0]
    errors = []
    for e, t in zip(estimate, truth, strict=True):
        t_unit, e_unit, _ = procrustes(t, e)
        size = np.linalg.norm(t - t.mean(0))
        errors.append(np.linalg.norm(t_unit - e_unit, axis=-1).mean() * size)
    assert metrics.pa_mpjpe(estimate, truth) == pytest.approx(np.mean(errors), rel=1e-6)


def test_rte_against_evo() -> None:
    """evo's absolute pose error after its own rigid alignment, over the path length it measures."""
    evo_metrics: Any = pytest.importorskip("evo.core.metrics")
    trajectory: Any = pytest.importorskip("evo.core.trajectory")
    rng = np.random.default_rng(4)
    truth = np.cumsum(rng.normal(scale=0.05, size=(80, 3)), axis=0)
    turn = Rotation.from_rotvec([0.0, 1.2, 0.1]).as_matrix()
    estimate = (truth + rng.normal(scale=0.03, size=truth.shape)) @ turn.T + [3.0, 0.2, -1.0]
    upright, stamps = np.tile([1.0, 0, 0, 0], (80, 1)), np.arange(80) / 30

    def path(xyz: np.ndarray) -> Any:
        return trajectory.PoseTrajectory3D(xyz, upright, stamps)

    reference, moved = path(truth), path(estimate.copy())
    moved.align(reference, correct_scale=False)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((reference, moved))
    mean_m = ape.get_statistic(evo_metrics.StatisticsType.mean)
    assert metrics.rte(estimate, truth) == pytest.approx(mean_m / reference.path_length, rel=1e-9)


@pytest.mark.parametrize("with_scale", [False, True])
def test_alignment_against_evo(with_scale: bool) -> None:
    geometry: Any = pytest.importorskip("evo.core.geometry")
    rng = np.random.default_rng(5)
    source, target = rng.normal(size=(2, 60, 3))
    R, t, scale = geometry.umeyama_alignment(source.T, target.T, with_scale)
    found = metrics.align_similarity(source, target, with_scale=with_scale)
    np.testing.assert_allclose(found.R_to_from, R, atol=1e-9)
    np.testing.assert_allclose(found.offset_m, t, atol=1e-9)
    assert found.scale == pytest.approx(scale)


def test_angle_against_scipy() -> None:
    rng = np.random.default_rng(6)
    axis = np.cross([0, 1.0, 0], rng.normal(size=3))
    axis /= np.linalg.norm(axis)
    for angle in (1e-9, 0.02, 1.0, 3.0):
        turned = Rotation.from_rotvec(angle * axis).apply([0, 1.0, 0])
        assert angle_rad(np.array([0, 1.0, 0]), turned) == pytest.approx(angle, rel=1e-6)


def test_box_overlap_by_hand() -> None:
    a = np.array([[0, 0, 10, 10.0]])
    b = np.array([[5, 0, 15, 10.0], [20, 20, 30, 30], [0, 0, 10, 10], [2, 2, 4, 4]])
    np.testing.assert_allclose(box_iou(a, b), [[50 / 150, 0, 1, 4 / 100]])


def test_tracks_hold_on_to_their_person() -> None:
    """Two boxes overlap the person at times; the one of before is kept although the other fits better."""
    nan = np.full(4, np.nan)
    person = np.tile([0, 0, 10, 10.0], (1, 4, 1))
    tracks = np.array([[[1, 0, 11, 10.0]] * 4, [nan, [0, 0, 10, 10], [0, 0, 10, 10], nan]])
    found = match_boxes(person, tracks)
    assert found.track.tolist() == [[0, 0, 0, 0]]
    assert found.switches == 0
    assert found.false_boxes == 2
    gone = tracks.copy()
    gone[0, 2:] = nan
    gone[1, 3] = [0, 0, 10, 10]
    found = match_boxes(person, gone)
    assert found.track.tolist() == [[0, 0, 1, 1]]
    assert found.switches == 1


def test_unseen_persons_are_not_missed() -> None:
    person = np.full((1, 3, 4), np.nan)
    person[0, 0] = [0, 0, 10, 10]
    found = match_boxes(person, np.full((1, 3, 4), np.nan))
    assert found.recall() == 0
    assert found.track.tolist() == [[-1, -2, -2]]
    assert np.isnan(match_boxes(person[:, 1:], np.full((0, 2, 4), np.nan)).recall())


def test_tiny_boxes_stand_on_the_floor() -> None:
    for box in BOXES:
        assert isinstance(box, TinyBox)
        assert box.bounds()[0][1] == 0


def test_a_limited_reach_changes_far_nodes_only() -> None:
    bounds = np.array([[-2.0, -0.2, -2.0], [2.0, 1.8, 2.0]])
    solid = as_mesh(trimesh.creation.icosphere(3, 0.5).apply_translation([0, 1.0, 0]))
    whole = build_sdf_grid([solid], bounds, 0.1).sdf_m
    limited = build_sdf_grid([solid], bounds, 0.1, reach_m=0.3).sdf_m
    near = np.abs(whole) < 0.29
    np.testing.assert_allclose(limited[near], whole[near], atol=1e-6)
    assert (limited[whole > 0.31] > 0.3).all()
    assert (limited[whole < -0.31] == np.float32(-0.3)).all()
    assert (whole < -0.31).any()
