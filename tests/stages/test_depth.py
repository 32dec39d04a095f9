"""Depth from gravity, floor and feet, against a rendered room; and the network's uncertainty."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_chain import all_finite, depth_of
from synthetic_room import BOX, FLOOR, WALL, Room, camera_pose, make_room

from stages.depth import DepthConfig, estimate_depth
from video2anim.depth.hue_jitter import jittered_disparity, reliable
from video2anim.errors import StageError
from video2anim.geometry.column_layers import background_distance, ground_contact_distance
from video2anim.geometry.gravity_view import GravityView
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyTracks, Intrinsics, View


def _scale_free_error(room: Room, surface: int) -> float:
    """Mean relative error of background image depth on a surface, after one scale for the whole picture."""
    depth = depth_of(room, StageContext(Path()))
    good = depth.background_valid
    scale = np.median(room.depth_m[good] / depth.background_value[good])
    chosen = good & (room.surface == surface)
    assert chosen.sum() > 0.8 * (room.surface == surface).sum()
    return float(np.mean(np.abs(scale * depth.background_value[chosen] / room.depth_m[chosen] - 1)))


@pytest.mark.parametrize(("pitch_deg", "roll_deg", "height_m"), [(14.0, 0.0, 1.6), (22.0, 12.0, 1.6), (35.0, 0.0, 2.4)])
def test_room_depth_up_to_scale(pitch_deg: float, roll_deg: float, height_m: float) -> None:
    room = make_room(pitch_deg=pitch_deg, roll_deg=roll_deg, height_m=height_m)
    # Bands: the floor is exact but for pixels near its edges; one row at the wall's foot is 3 % of its distance.
    assert _scale_free_error(room, FLOOR) < 0.02
    assert _scale_free_error(room, WALL) < 0.06
    assert _scale_free_error(room, BOX) < 0.06


def test_person_is_a_figure_at_the_foot_contact() -> None:
    room = make_room()
    depth = depth_of(room, StageContext(Path()))
    body = room.bodies.people[0]
    scale = np.median((room.depth_m / depth.background_value)[depth.background_valid & (room.surface == FLOOR)])
    for sample, frame in enumerate(depth.frame_index):
        mask = room.background.selected_mask[sample]
        assert depth.valid[sample][mask].all()
        found = scale * np.median(depth.value[sample][mask])
        assert found == pytest.approx(np.median(body.joints_camera_m[frame, :, 2]), abs=0.3)


def test_airborne_person_is_invalid_and_sigma_is_positive() -> None:
    room = make_room()
    body = room.bodies.people[0]
    contact = body.contact.copy()
    contact[20:] = 0.0
    jumping = replace(room, bodies=BodyTracks((replace(body, contact=contact),)))
    depth = depth_of(jumping, StageContext(Path()))
    on_person = np.array(
        [(depth.valid & room.background.selected_mask)[s].any() for s in range(len(depth.frame_index))]
    )
    assert (on_person == (depth.frame_index < 20)).all()
    assert (depth.sigma > 0).all()


def test_no_floor_in_the_picture_is_unknown_not_invented() -> None:
    room = make_room(pitch_deg=-20.0)
    ctx = StageContext(Path())
    depth = depth_of(room, ctx)
    assert not depth.background_valid.any()
    assert not depth.valid.any()
    assert any("no foot stands" in text for text in ctx.warnings)
    assert all_finite(depth)


def test_no_body_is_an_error() -> None:
    room = make_room()
    config = DepthConfig(provider="geometric")
    with pytest.raises(StageError, match="want a fitted body with at least one valid frame"):
        estimate_depth(None, room.background, BodyTracks((), ()), room.camera, config, StageContext(Path()))  # type: ignore[arg-type]


@pytest.mark.parametrize("roll_deg", [0.0, 25.0])
def test_cylinder_round_trip_and_floor_rows(roll_deg: float) -> None:
    T_world_camera = camera_pose(1.5, 20.0, roll_deg)
    intrinsics = Intrinsics.centered(100.0, 120, 80)
    view = GravityView.of(View(T_world_camera, intrinsics))
    grid = view.grid_of_pixels()
    nodes, seen = view.pixels_of_grid()
    column, row = (round(float(c)) for c in grid[40, 60])
    assert seen[row, column]
    # The nearest node lies within half a step, which is about half a pixel, on each axis.
    assert np.abs(nodes[row, column] - [60, 40]).max() < 1.5
    spot = np.array([[0.4, 0.0, -3.0]])
    distance = view.floor_distance_m(view.locate(spot)[:, 1])
    assert distance[0] == pytest.approx(np.hypot(0.4, 3.0), rel=1e-6)
    assert view.floor_row(distance)[0] == pytest.approx(view.locate(spot)[0, 1], abs=1e-6)


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


def test_straight_foot_line_ignores_outliers() -> None:
    azimuth = np.linspace(-0.3, 0.3, 61)
    truth = 4.0 / np.cos(azimuth - 0.2)
    seen = truth.copy()
    seen[::9] *= 0.85
    assert np.allclose(ground_contact_distance(seen, azimuth, azimuth), truth, rtol=0.02)


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
