"""Laws of the pinhole camera and of rigid transforms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from video2anim.geometry.projection import backproject, invert_rigid, pixel_rays, project, transform_points
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types import Intrinsics

LENS = Intrinsics(500.0, 520.0, 310.0, 190.0, 64, 48)
LAWS = settings(max_examples=60, deadline=None, derandomize=True)


def rigid(seed: int, shape: tuple[int, ...] = ()) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (*shape, 1, 1))
    T[..., :3, :3] = matrix_from_axis_angle(rng.uniform(-1.7, 1.7, (*shape, 3)))
    T[..., :3, 3] = rng.normal(size=(*shape, 3))
    return T


@LAWS
@given(st.floats(50, 5000), st.integers(8, 60), st.integers(8, 60), st.floats(0.1, 100))
def test_backprojection_undoes_projection(focal_px: float, width: int, height: int, depth: float) -> None:
    lens = Intrinsics.centered(focal_px, width, height)
    depth_m = depth * (1 + np.random.default_rng(width).random((height, width)))
    points = backproject(depth_m, lens)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    np.testing.assert_allclose(project(points, lens), np.stack([u, v], -1), atol=1e-6)
    np.testing.assert_allclose(points[..., 2], depth_m)


def test_axis_meets_the_principal_point_and_signs_are_opencv() -> None:
    np.testing.assert_allclose(project(np.array([0, 0, 2.0]), LENS), [310.0, 190.0])
    np.testing.assert_allclose(project(np.array([1.0, 1.0, 2.0]), LENS), [560.0, 450.0])


def test_middle_of_the_picture_by_the_pixel_convention() -> None:
    """Pixel (0, 0) is the center of the top-left pixel: the middle of 4 pixels is at 1.5."""
    lens = Intrinsics.centered(100.0, 4, 6)
    assert (lens.cx_px, lens.cy_px) == (1.5, 2.5)
    np.testing.assert_allclose(lens.matrix() @ [0, 0, 1], [1.5, 2.5, 1])


@LAWS
@given(st.integers(1, 500), st.integers(1, 500))
def test_resizing_moves_pixels_with_the_picture(width: int, height: int) -> None:
    """A point on the picture's border stays there: corners are at -0.5 and size - 0.5."""
    small = LENS.resized(width, height)
    point = np.array([(-0.5 - LENS.cx_px) / LENS.fx_px, (47.5 - LENS.cy_px) / LENS.fy_px, 1.0])
    np.testing.assert_allclose(project(point, small), [-0.5, height - 0.5], atol=1e-6)
    back = small.resized(LENS.width_px, LENS.height_px)
    np.testing.assert_allclose(back.matrix(), LENS.matrix(), rtol=1e-9)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_leading_axes_torch_and_scale(shape: tuple[int, ...]) -> None:
    points = np.random.default_rng(0).uniform(1, 3, (*shape, 3))
    pixels = project(points, LENS)
    assert pixels.shape == (*shape, 2)
    np.testing.assert_allclose(project(7 * points, LENS), pixels, err_msg="depth alone moves no pixel")
    np.testing.assert_allclose(project(torch.from_numpy(points), LENS).numpy(), pixels)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_rigid_transforms_form_a_group(shape: tuple[int, ...]) -> None:
    T_a_b, T_b_c = rigid(1, shape), rigid(2, shape)
    np.testing.assert_allclose(T_a_b @ invert_rigid(T_a_b), np.tile(np.eye(4), (*shape, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(invert_rigid(T_a_b @ T_b_c), invert_rigid(T_b_c) @ invert_rigid(T_a_b), atol=1e-12)
    points_c = np.random.default_rng(3).normal(size=(*shape, 7, 3))
    chained = transform_points(T_a_b, transform_points(T_b_c, points_c))
    np.testing.assert_allclose(transform_points(T_a_b @ T_b_c, points_c), chained, atol=1e-12)
    tensors = transform_points(torch.from_numpy(T_a_b), torch.from_numpy(points_c)).numpy()
    np.testing.assert_allclose(tensors, transform_points(T_a_b, points_c), atol=1e-12)


def test_transform_maps_the_origin_of_b_to_its_place_in_a() -> None:
    T_a_b = rigid(4)
    np.testing.assert_allclose(transform_points(T_a_b, np.zeros((1, 3)))[0], T_a_b[:3, 3])


def test_rays_have_unit_depth_and_wrong_sizes_are_refused() -> None:
    rays = pixel_rays(LENS)
    assert rays.shape == (48, 64, 3)
    assert (rays[..., 2] == 1).all()
    with pytest.raises(ValueError, match=r"\(48, 64\)"):
        backproject(np.ones((64, 48)), LENS)
