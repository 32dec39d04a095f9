"""Signed distances and the way out: boxes against brute force and numpy, grids against boxes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scenemi.scene.boxes import Boxes
from scenemi.scene.field import BoxField, GridField
from scenemi.scene.geometry import HalfSpace, SceneGeometry
from scenemi.scene.grid import canonical_grid
from scenemi.scene.rows import BoxRows, VolumeRows
from scenemi.scene.voxels import GridSpec, occupancy
from video2anim.geometry.sdf import SdfGrid

REACH_M = 0.6
"""An arm's length, at which the field ends."""
VOLUME_STEP_M = REACH_M / 127
SPACING_M = 0.05

STEP_M = 1e-3


def boxes_of(rows: torch.Tensor) -> Boxes:
    """By numpy; what stands on the floor goes on below it, for nobody leaves it through its bottom."""
    values = rows[rows[:, 3] > 0].double().numpy().copy()
    standing = values[:, 1] - values[:, 4] < 1e-3
    values[standing, 1] -= 2.0
    values[standing, 4] += 2.0
    return Boxes(values[:, :3], values[:, 3:6], values[:, 6])


def scenes(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Four windows (4, 5, 7) with 5, 2, 0 and 3 boxes, every other on the floor; the last is not shown its scene."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((4, 5, 7), np.float32)
    for window, count in enumerate((5, 2, 0, 3)):
        half = rng.uniform(0.05, 0.5, (count, 3))
        low = np.where(np.arange(count) % 2 == 0, 0.0, rng.uniform(0.2, 1.0, count))
        center = np.stack([rng.uniform(-1, 1, count), low + half[:, 1], rng.uniform(-1, 1, count)], -1)
        rows[window, :count] = np.concatenate([center, half, rng.uniform(-3, 3, (count, 1))], 1)
    return torch.from_numpy(rows), torch.tensor([1.0, 1.0, 1.0, 0.0])


def points(seed: int = 1, count: int = 800) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform([-1.5, -0.1, -1.5], [1.5, 2.0, 1.5], (4, count, 3)).astype(np.float32))


def expected_m(rows: torch.Tensor, points_m: torch.Tensor) -> np.ndarray:
    """Distance to boxes and floor, at most the reach."""
    where = points_m.double().numpy()
    return np.minimum(np.minimum(boxes_of(rows).signed_distance(where), where[:, 1]), REACH_M)


def test_distances_are_those_of_the_boxes_and_the_floor() -> None:
    rows, known = scenes()
    points_m = points()
    distance_m, _ = BoxField.of(rows, known).query(points_m)
    for window in range(3):
        np.testing.assert_allclose(distance_m[window].numpy(), expected_m(rows[window], points_m[window]), atol=1e-5)
    assert (distance_m[:2] < -0.02).any(), "some points are inside"
    assert (distance_m[0] == REACH_M).any(), "some are out of reach"


def test_the_distance_of_a_point_is_that_to_the_nearest_point_of_the_surface() -> None:
    """Against many points on the faces of one box that stands clear of the floor."""
    box = torch.tensor([[[0.3, 1.5, -0.2, 0.4, 0.2, 0.3, 0.7]]])
    rng = np.random.default_rng(0)
    points_m = torch.from_numpy(rng.uniform([-0.3, 1.2, -0.8], [0.9, 1.8, 0.4], (1, 60, 3)).astype(np.float32))
    distance_m, out = BoxField.of(box, torch.ones(1)).query(points_m)
    side = np.stack(np.meshgrid(np.linspace(-1, 1, 101), np.linspace(-1, 1, 101)), -1).reshape(-1, 2)
    faces = []
    for axis in range(3):
        for end in (-1.0, 1.0):
            face = np.insert(side, axis, end, axis=1) * [0.4, 0.2, 0.3]
            turned = np.stack([face[:, 0] * np.cos(0.7) + face[:, 2] * np.sin(0.7), face[:, 1],
                               face[:, 2] * np.cos(0.7) - face[:, 0] * np.sin(0.7)], -1)  # fmt: skip
            faces.append(turned + np.array([0.3, 1.5, -0.2]))
    surface_m = np.concatenate(faces)
    toward = surface_m[None] - points_m[0].numpy()[:, None]
    gap_m = np.linalg.norm(toward, axis=-1)
    nearest = gap_m.argmin(1)
    np.testing.assert_allclose(distance_m[0].abs().numpy(), gap_m.min(1), atol=0.005)
    # Outside the way leads away from that point, inside through it.
    way = toward[np.arange(len(nearest)), nearest] * np.where(distance_m[0] > 0, -1.0, 1.0)[:, None]
    clear = np.abs(distance_m[0].numpy()) > 0.05
    agree = (way / np.linalg.norm(way, axis=1, keepdims=True) * out[0].numpy()).sum(1)
    assert (agree[clear] > 0.99).mean() > 0.97
    assert (distance_m < -0.05).any()


def test_directions_are_the_gradient_away_from_edges() -> None:
    rows, known = scenes()
    field, points_m = BoxField.of(rows, known), points()
    distance_m, out = field.query(points_m)
    steps = STEP_M * torch.eye(3)
    slopes = []
    for axis in range(3):
        ends = [field.query(points_m + sign * steps[axis])[0] for sign in (1, -1)]
        slopes.append((ends[0] - ends[1]) / (2 * STEP_M))
    gradient = torch.stack(slopes, -1)
    reached = (distance_m < REACH_M - STEP_M) & known[:, None].bool()
    smooth = reached & ((gradient.norm(dim=-1) - 1).abs() < 0.01)
    assert smooth.float().sum() > 0.9 * reached.float().sum()
    torch.testing.assert_close(out[smooth], gradient[smooth], atol=0.02, rtol=0)
    torch.testing.assert_close(out[reached].norm(dim=-1), torch.ones(int(reached.sum())), atol=1e-4, rtol=0)


def test_windows_without_a_scene_and_points_out_of_reach_know_nothing() -> None:
    rows, known = scenes()
    field, points_m = BoxField.of(rows, known), points()
    distance_m, out = field.query(points_m)
    assert (distance_m[3] == REACH_M).all()
    assert not out[3].any()
    assert not out[:3][distance_m[:3] >= REACH_M].any()
    floor_m = points_m[2, :, 1].clamp(max=REACH_M)
    torch.testing.assert_close(distance_m[2], floor_m, atol=0, rtol=0), "no box, but a floor"
    nothing = BoxField.of(rows, torch.zeros(4))
    distance_m, out = nothing.query(points_m)
    assert (distance_m == REACH_M).all()
    assert not out.any()
    assert nothing.distance_m(points_m).shape == (0, points_m.shape[1])


def test_no_window_hears_of_the_scene_of_another() -> None:
    """Whatever the order of the windows by their number of boxes."""
    rows, known = scenes()
    points_m = points()
    together = BoxField.of(rows, known).query(points_m)
    for window in range(4):
        one = slice(window, window + 1)
        alone = BoxField.of(rows[one], known[one]).query(points_m[one])
        for both, single in zip(together, alone, strict=True):
            torch.testing.assert_close(both[one], single, atol=0, rtol=0)


def test_differentiable_distances_are_the_same_and_fall_into_solids() -> None:
    rows, known = scenes()
    field = BoxField.of(rows, known)
    points_m = points().requires_grad_(True)
    distance_m, out = (value.detach() for value in field.query(points_m))
    made_m = field.distance_m(points_m)
    torch.testing.assert_close(made_m, distance_m[field.rows], atol=2e-6, rtol=0)
    (gradient,) = torch.autograd.grad(made_m.sum(), points_m)
    assert torch.isfinite(gradient).all()
    assert not gradient[3].any()
    # On the inside two faces may be equally far; there is no such tie among random points.
    clear = (distance_m.abs() > 1e-3) & (distance_m < REACH_M)
    torch.testing.assert_close(gradient[clear], out[clear], atol=1e-3, rtol=0)


def test_gradients_are_finite_on_surfaces_and_at_centers() -> None:
    rows = torch.tensor([[[0.0, 1.0, 0.0, 0.2, 0.2, 0.2, 0.0]]])
    special = torch.tensor([[[0.2, 1.0, 0.0], [0.2, 1.2, 0.2], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]], requires_grad=True)
    field = BoxField.of(rows, torch.ones(1))
    field.distance_m(special).sum().backward()
    assert special.grad is not None
    assert torch.isfinite(special.grad).all()
    assert all(torch.isfinite(value).all() for value in field.query(special.detach()))


def apart() -> torch.Tensor:
    """Three boxes (1, 3, 7) that touch neither each other nor the floor."""
    return torch.tensor([[
        [0.6, 0.9, 0.3, 0.3, 0.5, 0.2, 0.4], [-0.6, 0.7, -0.4, 0.2, 0.25, 0.4, -0.9],
        [-0.5, 1.5, 0.7, 0.5, 0.2, 0.3, 2.0],
    ]])  # fmt: skip


def from_grid(rows: torch.Tensor, points_m: torch.Tensor, yaw: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """What a grid of boxes and floor tells; with a yaw, of a scene in the world that stands in another frame."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    T[:3, 3] = (2.0 * yaw, 0.0, -yaw)
    scene = SceneGeometry.of(boxes_of(rows[0]), HalfSpace(0.0)).transformed(T)
    return GridField((canonical_grid(scene, points_m[0].numpy(), T),)).query(points_m)


@pytest.mark.parametrize("yaw", [0.0, 1.1])
def test_a_grid_tells_what_the_boxes_tell(yaw: float) -> None:
    """The same scene in the world, seen from a frame that is turned and shifted."""
    rows, points_m = apart(), points()[:1].double()
    distance_m, out = from_grid(rows, points_m, yaw)
    true_m, true_out = BoxField.of(rows.double(), torch.ones(1)).query(points_m)
    off_m = (distance_m - true_m).abs()
    assert off_m[true_m > SPACING_M].max() < 0.5 * SPACING_M
    assert off_m.max() < 1.5 * SPACING_M, "inside to half a spacing, and trilinear over edges"
    assert (true_m < -2 * SPACING_M).any()
    agree = (out * true_out).sum(-1)[true_m.abs() < REACH_M - SPACING_M]
    assert (agree > 0.9).double().mean() > 0.9
    assert not out[distance_m >= REACH_M].any()


def test_inside_a_standing_box_the_way_out_does_not_lead_through_the_floor() -> None:
    """Most training solids stand on the floor: a foot in a cabinet leaves it sideways. Grids know no bottom face."""
    rows = torch.tensor([[[0.0, 0.4, 0.0, 0.3, 0.4, 0.5, 0.0]]])
    foot_m = torch.tensor([[[0.1, 0.06, 0.0]]], dtype=torch.float64)
    grid_m, grid_out = from_grid(rows, foot_m)
    assert float(grid_m) == pytest.approx(-0.2, abs=SPACING_M)
    assert float(grid_out[0, 0, 0]) > 0.9
    distance_m, out = BoxField.of(rows.double(), torch.ones(1)).query(foot_m)
    assert float(out[0, 0, 1]) > -0.1
    assert float(distance_m) == pytest.approx(-0.2, abs=1e-6)


def test_grids_answer_each_window_by_its_own_and_none_where_there_is_none() -> None:
    walls = [SdfGrid(np.tile((x - 0.1 * np.arange(31))[:, None, None], (1, 31, 31)), np.zeros(3), 0.1) for x in (1, 2)]
    points_m = torch.tensor([[[0.7, 1.0, 1.0], [1.3, 1.0, 1.0]]]).expand(3, -1, -1)
    distance_m, out = GridField((walls[0], None, walls[1])).query(points_m)
    torch.testing.assert_close(distance_m[0], torch.tensor([0.3, -0.3]), atol=1e-5, rtol=0)
    torch.testing.assert_close(distance_m[1], torch.full((2,), REACH_M))
    torch.testing.assert_close(distance_m[2], torch.tensor([REACH_M, REACH_M]), atol=1e-5, rtol=0)
    torch.testing.assert_close(out[0], torch.tensor([[-1.0, 0, 0]]).expand(2, -1), atol=1e-5, rtol=0)
    assert not out[1].any()


LOW_M, HIGH_M = np.array([-1.6, -0.2, -1.6]), np.array([1.6, 2.1, 1.6])
NODES = (65, 47, 49)


def stored(rows: torch.Tensor) -> VolumeRows:
    """Boxes (1, K, 7) as distances at nodes that differ in number and step along each axis."""
    step_m = (HIGH_M - LOW_M) / (np.array(NODES) - 1)
    nodes_m = np.stack(np.meshgrid(*(np.arange(n) for n in NODES), indexing="ij"), -1) * step_m + LOW_M
    distance_m = np.clip(boxes_of(rows[0]).signed_distance(nodes_m), -REACH_M, REACH_M)
    values = np.rint(distance_m / VOLUME_STEP_M).astype(np.int8)
    return VolumeRows(torch.from_numpy(values)[None], torch.from_numpy(np.concatenate([LOW_M, step_m]))[None].float())


def test_a_volume_tells_what_the_boxes_tell() -> None:
    rows, points_m = apart(), points()[:1]
    field = stored(rows).field(torch.ones(1))
    distance_m, out = field.query(points_m)
    true_m, true_out = BoxField.of(rows, torch.ones(1)).query(points_m)
    off_m = (distance_m - true_m).abs()
    assert off_m[true_m > SPACING_M].max() < 0.03
    assert off_m.max() < 0.06, "trilinear over edges"
    agree = (out * true_out).sum(-1)[true_m.abs() < REACH_M - 0.1]
    assert (agree > 0.9).float().mean() > 0.9
    assert not out[distance_m >= REACH_M].any()
    free = points_m.clone().requires_grad_(True)
    made_m = field.distance_m(free)
    torch.testing.assert_close(made_m, distance_m, atol=1e-5, rtol=0)
    (gradient,) = torch.autograd.grad(made_m.sum(), free)
    assert torch.isfinite(gradient).all()
    assert ((gradient * out).sum(-1)[distance_m < 0.4] > 0.5).float().mean() > 0.9


def test_a_mirrored_volume_tells_the_same_of_mirrored_points() -> None:
    scene, points_m = stored(apart()), points()[:1]
    every = torch.ones(1)
    distance_m, out = scene.field(every).query(points_m)
    across = scene.mirrored(torch.tensor([True]))
    flip = torch.tensor([-1.0, 1.0, 1.0])
    found_m, found_out = across.field(every).query(points_m * flip)
    torch.testing.assert_close(found_m, distance_m, atol=1e-5, rtol=0)
    clear = distance_m < REACH_M - 1e-3
    torch.testing.assert_close((found_out * flip)[clear], out[clear], atol=1e-3, rtol=0)
    assert (scene.mirrored(torch.tensor([False])).field(every).query(points_m)[0] == distance_m).all()
    back = across.mirrored(torch.tensor([True]))
    assert torch.equal(back.values, scene.values)
    torch.testing.assert_close(back.place, scene.place)


def test_stored_scenes_show_voxels_with_their_floor_and_offsets() -> None:
    """Both kinds alike, as `SceneReader` shows a scene to the prior."""
    rows = apart()
    grid = GridSpec((48, 24, 48), 0.1)
    true = occupancy(SceneGeometry.of(boxes_of(rows[0]), HalfSpace(0.0)), np.eye(4), grid)
    assert true[:, 0].all()
    where_m = points()[0, :100].double().numpy()
    where_m[:, 1] = np.abs(where_m[:, 1])
    nearest_m = SceneGeometry.of(boxes_of(rows[0]), HalfSpace(0.0)).nearest(where_m) - where_m
    for kind in (BoxRows(rows), stored(rows)):
        assert kind.filled.tolist() == [True]
        exact = isinstance(kind, BoxRows)
        inside = true[10:38, :20, 10:38]  # the stored volume ends there
        found = kind.occupancy(0, grid)[10:38, :20, 10:38]
        assert (found != inside).mean() < (1e-9 if exact else 0.02)
        close = np.linalg.norm(nearest_m, axis=1) < REACH_M - 0.1
        off_m = np.linalg.norm(kind.offsets(0, where_m) - nearest_m, axis=1)[close]
        assert np.quantile(off_m, 0.9) < (1e-6 if exact else 0.06)
