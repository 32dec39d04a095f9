"""Signed-distance grids against analytic shapes and brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.interpolate import RegularGridInterpolator

from video2anim.geometry.sdf import SdfGrid, build_sdf_grid, sample_sdf
from video2anim.types import Mesh

BOUNDS_M = np.array([[-1.0, -0.5, -1.0], [1.0, 1.5, 1.0]])
SPACING_M = 0.05


def as_mesh(shape: trimesh.Trimesh, *, faces: slice = slice(None)) -> Mesh:
    return Mesh(
        np.asarray(shape.vertices, dtype=np.float64),
        np.asarray(shape.faces)[faces],
        np.zeros((len(shape.vertices), 3), dtype=np.uint8),
    )


def box(
    extents: tuple[float, float, float], center: tuple[float, float, float], turn_rad: float = 0.0
) -> trimesh.Trimesh:
    shape = trimesh.creation.box(extents)
    shape.apply_transform(trimesh.transformations.rotation_matrix(turn_rad, [0, 1, 0]))
    shape.apply_translation(center)
    return shape


def nodes_m(grid: SdfGrid) -> np.ndarray:
    axes = [grid.origin_m[a] + grid.spacing_m * np.arange(grid.sdf_m.shape[a]) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def box_distance_m(points_m: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    q = np.abs(points_m) - half_m
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


@pytest.mark.parametrize("turn_rad", [0.0, 0.4])
def test_box_is_exact_at_every_node(turn_rad: float) -> None:
    # Faces of the unturned box run through nodes.
    grid = build_sdf_grid([as_mesh(box((0.8, 0.4, 0.6), (0, 0.2, 0), turn_rad))], BOUNDS_M, SPACING_M, floor_y_m=None)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    R_world_box = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    truth_m = box_distance_m((nodes_m(grid) - [0, 0.2, 0]) @ R_world_box, np.array([0.4, 0.2, 0.3]))
    np.testing.assert_allclose(grid.sdf_m, truth_m, atol=2e-6)


def test_sphere_is_as_exact_as_its_facets() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    sphere.apply_translation([0.1, 0.6, -0.2])
    grid = build_sdf_grid([as_mesh(sphere)], BOUNDS_M, SPACING_M, floor_y_m=None)
    truth_m = np.linalg.norm(nodes_m(grid) - [0.1, 0.6, -0.2], axis=-1) - 0.5
    # Facets of this sphere lie up to 0.6 mm inside it.
    np.testing.assert_allclose(grid.sdf_m, truth_m, atol=7e-4)


def test_union_with_the_floor_and_a_second_solid() -> None:
    solids = [box((0.4, 0.4, 0.4), (0.5, 0.2, 0)), box((0.4, 0.4, 0.4), (-0.5, 0.2, 0))]
    grid = build_sdf_grid([as_mesh(s) for s in solids], BOUNDS_M, SPACING_M)
    points_m = np.array([[0.0, 0.1, 0.0], [0.0, -0.2, 0.0], [0.5, 0.3, 0.0], [-0.5, 0.3, 0.0], [0.0, 0.3, 0.0]])
    np.testing.assert_allclose(grid.sample(points_m), [0.1, -0.2, -0.1, -0.1, 0.3], atol=1e-5)


def test_a_hole_in_a_mesh_does_not_turn_it_inside_out() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
    grid = build_sdf_grid([as_mesh(sphere, faces=slice(6, None))], BOUNDS_M, SPACING_M, floor_y_m=None)
    truth_m = np.linalg.norm(nodes_m(grid), axis=-1) - 0.4
    clear = np.abs(truth_m) > 0.06
    assert (np.sign(grid.sdf_m) == np.sign(truth_m))[clear].mean() > 0.999


def test_meshes_without_faces_are_skipped_and_nothing_at_all_is_refused() -> None:
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.uint8))
    grid = build_sdf_grid([empty], BOUNDS_M, 0.25)
    np.testing.assert_allclose(grid.sdf_m[0, :, 0], -0.5 + 0.25 * np.arange(9))
    with pytest.raises(ValueError, match="neither a solid"):
        build_sdf_grid([empty], BOUNDS_M, 0.25, floor_y_m=None)
    with pytest.raises(ValueError, match="low < high"):
        build_sdf_grid([], BOUNDS_M[::-1], 0.25)


def test_what_is_out_of_reach_gets_the_reach() -> None:
    solid = [as_mesh(box((0.4, 0.4, 0.4), (0.2, 0.3, 0)))]
    exact = build_sdf_grid(solid, BOUNDS_M, SPACING_M, floor_y_m=None)
    near = build_sdf_grid(solid, BOUNDS_M, SPACING_M, floor_y_m=None, reach_m=0.15)
    np.testing.assert_allclose(near.sdf_m, np.clip(exact.sdf_m, -0.15, 0.15), atol=1e-6)
    # What lies between nodes is that far from all surface samples, not from the surface.
    assert (exact.sdf_m > 0.15).any()
    assert (exact.sdf_m < -0.15).any()


@pytest.mark.parametrize("reach_m", [0.11, 0.4, np.inf])  # nodes above the box are 0.1 m off, up to rounding
def test_points_within_reach_are_found(reach_m: float) -> None:
    grid = build_sdf_grid([as_mesh(box((0.4, 0.3, 0.5), (0.6, 0.3, 0), 0.4))], BOUNDS_M, SPACING_M, floor_y_m=None)
    points_m = np.random.default_rng(6).uniform(-2, 2, (20_000, 3))
    found = grid.within(points_m, reach_m)
    distance_m = grid.sample(points_m)
    assert np.isin(np.flatnonzero(distance_m < reach_m), found).all()
    assert distance_m[found].max() < 3 * reach_m
    assert len(grid.within(points_m, -1.0)) == 0


def random_grid() -> SdfGrid:
    values = np.random.default_rng(2).normal(size=(5, 4, 6)).astype(np.float32)
    return SdfGrid(values, np.array([-1.0, 0.5, 2.0]), 0.3)


def test_sampling_is_trilinear() -> None:
    grid = random_grid()
    axes = [grid.origin_m[a] + 0.3 * np.arange(grid.sdf_m.shape[a]) for a in range(3)]
    points_m = np.random.default_rng(3).uniform(grid.origin_m, [a[-1] for a in axes], (200, 3))
    truth_m = RegularGridInterpolator(axes, grid.sdf_m)(points_m)
    np.testing.assert_allclose(grid.sample(points_m), truth_m, atol=1e-6)
    np.testing.assert_allclose(grid.sample(nodes_m(grid)), grid.sdf_m, atol=1e-6)


@pytest.mark.parametrize("lead", [(), (5,), (2, 3)])
def test_numpy_and_torch_agree_on_any_leading_axes(lead: tuple[int, ...]) -> None:
    grid = random_grid()
    points_m = np.random.default_rng(4).uniform(-3, 4, (*lead, 3))
    torch_m = grid.sample(torch.as_tensor(points_m))
    assert torch_m.shape == lead
    np.testing.assert_allclose(torch_m.numpy(), grid.sample(points_m), atol=1e-6)


def test_gradient_is_that_of_finite_differences() -> None:
    grid = random_grid()
    points = torch.as_tensor(np.random.default_rng(5).uniform(-2, 4, (20, 3)), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(grid.sample, (points,), eps=1e-6, atol=1e-5)


def test_outside_the_grid_free_space_grows_and_solid_deepens() -> None:
    grid = build_sdf_grid([], BOUNDS_M, 0.25)
    points_m = np.array([[0, 3.0, 0], [0, -2.0, 0], [4.0, 1.0, 0]])
    np.testing.assert_allclose(grid.sample(points_m), [3.0, -2.0, 4.0], atol=1e-5)
    below = torch.tensor([[0.0, -2.0, 0.0]], requires_grad=True)
    sample_sdf(grid.sdf_m, grid.origin_m, grid.spacing_m, below).sum().backward()
    assert below.grad is not None
    assert below.grad[0, 1] > 0.9
