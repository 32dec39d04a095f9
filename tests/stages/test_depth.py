"""Views in gravity's axes, layers of columns, and the uncertainty of a depth network."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_room import camera_pose

from video2anim.depth.hue_jitter import jittered_disparity, reliable
from video2anim.geometry.column_layers import background_distance
from video2anim.geometry.gravity_view import GravityView
from video2anim.types import Intrinsics, View


@pytest.mark.parametrize("roll_deg", [0.0, 25.0])
def test_cylinder_round_trip(roll_deg: float) -> None:
    T_world_camera = camera_pose(1.5, 20.0, roll_deg)
    intrinsics = Intrinsics.centered(100.0, 120, 80)
    view = GravityView.of(View(T_world_camera, intrinsics))
    grid = view.grid_of_pixels()
    nodes, seen = view.pixels_of_grid()
    column, row = (round(float(c)) for c in grid[40, 60])
    assert seen[row, column]
    # The nearest node lies within half a step, which is about half a pixel, on each axis.
    assert np.abs(nodes[row, column] - [60, 40]).max() < 1.5


def test_layers_bridge_near_runs_and_keep_slanted_walls() -> None:
    azimuth = np.linspace(-0.6, 0.6, 121)
    wall = 5.0 / np.cos(azimuth)
    seen = wall.copy()
    seen[40:60] = 2.5
    background, hidden = background_distance(seen, azimuth)
    assert np.allclose(background, wall, rtol=0.01)
    assert hidden[42:58].all()
    assert not hidden[:39].any()
    slanted = np.linspace(6.0, 2.0, 121)
    kept, none_hidden = background_distance(slanted, azimuth)
    assert np.array_equal(kept, slanted)
    assert not none_hidden.any()


def test_hue_jitter_measures_color_dependence_only() -> None:
    image = np.zeros((20, 30, 3), np.uint8)
    image[..., 0], image[..., 1], image[..., 2] = 200, 60, 30
    image[:, :25] = 90
    ramp = np.linspace(1, 3, 20)[:, None] * np.ones((1, 30))

    def colorblind(picture: np.ndarray) -> np.ndarray:
        return ramp

    def fooled(picture: np.ndarray) -> np.ndarray:
        return ramp + 0.003 * (picture[..., 0].astype(float) - picture[..., 1])

    _, steady = jittered_disparity(colorblind, image, (-0.5, 0.5))
    value, shaky = jittered_disparity(fooled, image, (-1.5, -0.5, 0.5, 1.5))
    assert steady.max() < 1e-9
    assert shaky[:, 26:].mean() > 3 * shaky[:, :24].mean()
    assert reliable(value, shaky, 0.04)[:, :24].mean() > reliable(value, shaky, 0.04)[:, 26:].mean()
