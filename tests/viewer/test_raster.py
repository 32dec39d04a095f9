"""Laws of the software renderer: coverage, depth, order, clipping, framing."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.geometry.projection import pixel_rays, project
from video2anim.types import Intrinsics
from video2anim.viewer.clipping import clip_segments_near, clip_triangles_near
from video2anim.viewer.raster import Canvas, draw_lines, draw_mesh
from video2anim.viewer.viewpoint import fit_viewpoint, looking

NEAR_M = 0.05

LENS = Intrinsics.centered(100.0, 80, 60)


def colors(count: int, rgb: tuple[int, int, int]) -> np.ndarray:
    return np.tile(np.array(rgb, np.uint8), (count, 1))


def test_depth_of_a_slanted_plane_is_exact() -> None:
    """z = 4 + 0.5 x fills the picture; each pixel's depth is where its ray meets the plane."""
    x, y = np.array([-9.0, 5, 5, -9]) * 0.8, np.array([-9.0, -9, 9, 9])
    vertices = np.stack([x, y, 4 + 0.5 * x], -1)
    canvas = Canvas.blank(80, 60)
    draw_mesh(canvas, vertices, np.array([[0, 1, 2], [0, 2, 3]]), colors(4, (9, 8, 7)), LENS, light="none")
    rays = pixel_rays(LENS)
    np.testing.assert_allclose(canvas.depth_m, 4 / (1 - 0.5 * rays[..., 0]), rtol=1e-4)
    assert (canvas.rgb == [9, 8, 7]).all()


def test_covered_pixels_are_those_whose_centers_lie_inside() -> None:
    corners_px = np.array([[10.3, 5.2], [60.7, 20.1], [25.4, 50.6]])
    vertices = np.concatenate([(corners_px - [LENS.cx_px, LENS.cy_px]) / 100.0 * 2.0, np.full((3, 1), 2.0)], 1)
    canvas = Canvas.blank(80, 60)
    draw_mesh(canvas, vertices, np.array([[0, 1, 2]]), colors(3, (1, 2, 3)), LENS, light="none")
    u, v = np.meshgrid(np.arange(80), np.arange(60))
    inside = np.ones((60, 80), bool)
    for a, b in zip(corners_px, np.roll(corners_px, -1, 0), strict=True):
        inside &= (b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0]) >= 0
    np.testing.assert_array_equal(np.isfinite(canvas.depth_m), inside)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_nearer_surface_wins_in_any_order(order: tuple[int, int]) -> None:
    def square(z: float) -> np.ndarray:
        return np.array([[-1.0, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]])

    faces, canvas = np.array([[0, 1, 2], [0, 2, 3]]), Canvas.blank(80, 60)
    parts = [(square(2.0), (200, 0, 0)), (square(3.0), (0, 200, 0))]
    for index in order:
        draw_mesh(canvas, parts[index][0], faces, colors(4, parts[index][1]), LENS, light="none")
    assert canvas.rgb[30, 40].tolist() == [200, 0, 0]
    assert canvas.depth_m[30, 40] == pytest.approx(2.0)


def test_closed_surfaces_hide_their_back_faces() -> None:
    triangle = np.array([[-1.0, -1, 2], [1, -1, 2], [0, 1, 2]])
    for faces, seen in ((np.array([[0, 1, 2]]), False), (np.array([[0, 2, 1]]), True)):
        canvas = Canvas.blank(80, 60)
        draw_mesh(canvas, triangle, faces, colors(3, (1, 1, 1)), LENS, closed=True)
        assert np.isfinite(canvas.depth_m).any() == seen


def test_tiles_of_a_large_triangle_leave_no_seam() -> None:
    lens = Intrinsics.centered(400.0, 700, 600)
    vertices = np.array([[-9.0, -9, 3], [9, -9, 3], [9, 9, 3], [-9, 9, 3]])
    canvas = Canvas.blank(700, 600)
    draw_mesh(canvas, vertices, np.array([[0, 1, 2], [0, 2, 3]]), colors(4, (5, 5, 5)), lens, light="none")
    assert (canvas.rgb == 5).all()


def test_floor_that_passes_under_the_camera_is_clipped() -> None:
    vertices = np.array([[-50.0, 1, -50], [50, 1, -50], [50, 1, 50], [-50, 1, 50]])
    canvas = Canvas.blank(80, 60)
    draw_mesh(canvas, vertices, np.array([[0, 1, 2], [0, 2, 3]]), colors(4, (7, 7, 7)), LENS, light="none")
    assert np.isfinite(canvas.depth_m[35:]).all()
    assert np.isinf(canvas.depth_m[:29]).all()
    np.testing.assert_allclose(canvas.depth_m[50], 100.0 / (50 - LENS.cy_px), rtol=1e-3)


def test_clipping_keeps_the_area_in_front() -> None:
    rng = np.random.default_rng(0)
    triangles = rng.normal([0, 0, 0.3], 1, (200, 3, 3))
    clipped, values = clip_triangles_near(triangles, triangles.copy())
    assert (clipped[..., 2] >= NEAR_M - 1e-9).all()
    np.testing.assert_allclose(clipped[..., :2], values[..., :2], atol=1e-9)

    def area(t: np.ndarray) -> np.ndarray:
        return 0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)

    flipped, _ = clip_triangles_near(triangles * [1, 1, -1] + [0, 0, 2 * NEAR_M], triangles)
    assert area(clipped).sum() + area(flipped).sum() == pytest.approx(area(triangles).sum())
    starts, ends = clip_segments_near(triangles[:, 0], triangles[:, 1])
    assert (np.minimum(starts[:, 2], ends[:, 2]) >= NEAR_M - 1e-9).all()


def test_lines_are_hidden_behind_surfaces() -> None:
    wall = np.array([[-9.0, -9, 2], [0, -9, 2], [0, 9, 2], [-9, 9, 2]])
    canvas = Canvas.blank(80, 60, (255, 255, 255))
    draw_mesh(canvas, wall, np.array([[0, 1, 2], [0, 2, 3]]), colors(4, (0, 0, 0)), LENS, light="none")
    draw_lines(canvas, np.array([[-1.0, 0, 3]]), np.array([[1.0, 0, 3]]), (250, 0, 0), LENS)
    red = (canvas.rgb == [250, 0, 0]).all(-1)
    assert not red[:, :39].any()
    assert red[:, 41:70].any(0).all()


@pytest.mark.parametrize("elevation_rad", [0.0, 0.3, 1.2])
def test_fitted_viewpoint_sees_all_points_and_wastes_little(elevation_rad: float) -> None:
    rng = np.random.default_rng(1)
    points_m = rng.uniform([-3, 0, -1], [2, 1.8, 1.5], (300, 3))
    viewpoint = fit_viewpoint(points_m, looking(np.array([1.0, 0.2, 0.4]), elevation_rad), width_px=320, height_px=240)
    camera_m = viewpoint.to_camera(points_m)
    assert (camera_m[:, 2] > 0).all()
    pixels = project(camera_m, viewpoint.intrinsics)
    assert (pixels >= 0).all()
    assert (pixels <= [319, 239]).all()
    offset = np.abs(pixels - [159.5, 119.5]) / [160, 120]
    assert offset.max() == pytest.approx(0.9, abs=0.01)
