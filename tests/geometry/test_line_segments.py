"""The camera that a room's straight edges give: boxes projected by hand, and a detector's edges of drawn pictures."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Float

from video2anim.geometry.line_segments import LineSegments, camera_with_edges, detect_line_segments
from video2anim.geometry.perspective_field import FieldCamera, up_of

ASPECT = 4 / 3
FIELD_SIGMA = np.array([0.25, 0.05, 0.05])
END_SIGMA = 0.001


def boxes(rng: np.random.Generator, count: int, heading_rad: float) -> Float[np.ndarray, "edges 2 3"]:
    """Edges of boxes in a room with y up, 2 to 6 m ahead of a camera at the origin."""
    found = []
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    pairs = [(a, b) for a, b in itertools.combinations(range(8), 2) if np.abs(corners[a] - corners[b]).sum() == 1]
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    for _ in range(count):
        center = np.array([rng.uniform(-1.5, 1.5), rng.uniform(-1.2, 0.6), rng.uniform(2.5, 6)])
        box = (corners * rng.uniform(0.4, 1.5, 3)) @ turn.T + center
        found += [(box[a], box[b]) for a, b in pairs]
    return np.array(found)


def seen(
    edges_m: Float[np.ndarray, "edges 2 3"], focal_ratio: float, pitch: float, roll: float, k1: float = 0.0
) -> Float[np.ndarray, "edges 4"]:
    """Ends in the picture of a camera turned from the level, those wholly in view."""
    up = up_of(pitch, roll)
    ahead = np.array([0.0, 0, 1]) - up * up[2]
    ahead /= np.linalg.norm(ahead)
    R_camera_room = np.stack([np.cross(up, ahead), up, ahead], 1)
    points = edges_m @ R_camera_room.T
    flat = points[..., :2] / points[..., 2:]
    picture = focal_ratio * flat * (1 + k1 * (flat**2).sum(-1, keepdims=True))
    inside = (points[..., 2] > 0.1) & (np.abs(picture) < [0.5 * ASPECT, 0.5]).all(-1)
    return picture[inside.all(1)].reshape(-1, 4)


def with_noise(ends: np.ndarray, rng: np.random.Generator, outliers: int = 0) -> LineSegments:
    wrong = rng.uniform([-0.5 * ASPECT, -0.5] * 2, [0.5 * ASPECT, 0.5] * 2, (outliers, 4))
    return LineSegments(np.concatenate([ends + END_SIGMA * rng.standard_normal(ends.shape), wrong]), END_SIGMA)


def field_camera(focal_ratio: float, pitch: float, roll: float) -> FieldCamera:
    return FieldCamera(focal_ratio, up_of(pitch, roll), np.diag(FIELD_SIGMA**2))


def gravity_off_deg(camera: FieldCamera, pitch: float, roll: float) -> float:
    return math.degrees(math.acos(float(np.clip(camera.up_camera @ up_of(pitch, roll), -1, 1))))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("focal_ratio", "heading_deg"), [(0.7, 30), (1.1, 65), (1.6, 20)])
def test_boxes_give_the_lens_and_gravity(focal_ratio: float, heading_deg: float, seed: int) -> None:
    """From a field a quarter off, two degrees wrong, among as many edges that run anywhere."""
    rng = np.random.default_rng(seed)
    pitch, roll = rng.uniform(-0.35, 0.1), rng.uniform(-0.1, 0.1)
    ends = seen(boxes(rng, 12, math.radians(heading_deg)), focal_ratio, pitch, roll)
    edges = with_noise(ends, rng, outliers=len(ends))
    wrong = field_camera(focal_ratio * math.exp(0.25 * rng.choice([-1, 1])), pitch + 0.03, roll - 0.03)
    found = camera_with_edges(wrong, [edges])
    assert found.focal_ratio == pytest.approx(focal_ratio, rel=0.05)
    assert gravity_off_deg(found, pitch, roll) < 1.0
    assert found.focal_log_sigma < 0.05
    assert abs(math.log(found.focal_ratio / focal_ratio)) < 3 * found.focal_log_sigma


def test_lens_distortion_is_seen_through() -> None:
    """A wide lens that bends lines would look longer or shorter by several percent."""
    rng = np.random.default_rng(5)
    ends = seen(boxes(rng, 25, 0.6), 0.7, -0.2, 0.03, k1=-0.08)
    found = camera_with_edges(field_camera(0.85, -0.17, 0.05), [with_noise(ends, rng)])
    assert found.focal_ratio == pytest.approx(0.7, rel=0.03)


def test_a_wall_from_straight_ahead_says_nothing_of_the_lens() -> None:
    rng = np.random.default_rng(6)
    wall = boxes(rng, 15, 0.0)
    wall[..., 2] = 4.0
    across = np.linalg.norm(wall[:, 0] - wall[:, 1], axis=-1) > 0.1
    field = field_camera(1.1, 0.0, 0.0)
    found = camera_with_edges(field, [with_noise(seen(wall[across], 0.8, 0.0, 0.0), rng)])
    assert found.focal_log_sigma > 0.5 * field.focal_log_sigma
    assert abs(math.log(found.focal_ratio / field.focal_ratio)) < field.focal_log_sigma
    assert gravity_off_deg(found, 0.0, 0.0) < 1.0


def test_edges_that_run_anywhere_change_little() -> None:
    rng = np.random.default_rng(7)
    field = field_camera(1.0, -0.2, 0.0)
    nothing = with_noise(np.zeros((0, 4)), rng, outliers=40)
    found = camera_with_edges(field, [nothing])
    assert abs(math.log(found.focal_ratio)) < 2 * field.focal_log_sigma
    assert found.focal_log_sigma > 0.1


def test_too_few_edges_leave_the_field() -> None:
    field = field_camera(1.0, -0.2, 0.0)
    few = LineSegments(np.array([[-0.2, 0.1, 0.3, 0.1], [0.0, -0.2, 0.0, 0.4]]), END_SIGMA)
    for edges in ([], [few], [replace(few, ends=np.zeros((0, 4)))]):
        assert camera_with_edges(field, edges) is field


def test_a_known_lens_stays_and_gravity_is_corrected() -> None:
    rng = np.random.default_rng(8)
    ends = seen(boxes(rng, 12, 0.5), 0.9, -0.25, 0.05)
    known = FieldCamera(0.9, up_of(-0.21, 0.02), np.diag([1e-6, 0.05**2, 0.05**2]))
    found = camera_with_edges(known, [with_noise(ends, rng)], focal_known=True)
    assert found.focal_ratio == 0.9
    assert gravity_off_deg(found, -0.25, 0.05) < 0.4 < gravity_off_deg(known, -0.25, 0.05)


def test_the_same_picture_twice_is_no_more_evidence() -> None:
    rng = np.random.default_rng(9)
    edges = with_noise(seen(boxes(rng, 8, 0.5), 0.9, -0.25, 0.05), rng)
    once, twice = (camera_with_edges(field_camera(1.1, -0.2, 0.0), [edges] * count) for count in (1, 2))
    assert twice.focal_ratio == pytest.approx(once.focal_ratio, rel=1e-6)
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-6)


@pytest.mark.parametrize(("width_px", "height_px"), [(320, 240), (270, 480), (2560, 1440)])
def test_edges_of_a_drawn_frame_lie_where_they_were_drawn(width_px: int, height_px: int) -> None:
    picture = np.full((height_px, width_px, 3), 200, np.uint8)
    x0, x1 = round(0.25 * width_px), round(0.7 * width_px)
    y0, y1 = round(0.2 * height_px), round(0.6 * height_px)
    cv2.rectangle(picture, (x0, y0), (x1 - 1, y1 - 1), (30, 60, 90), -1)
    edges = detect_line_segments(picture)
    wanted = np.array([[x0, y0, x1, y0], [x1, y0, x1, y1], [x1, y1, x0, y1], [x0, y1, x0, y0]], float)
    wanted = (wanted - np.array([width_px / 2, height_px / 2] * 2)) / height_px
    assert len(edges.ends) == 4
    # The detector ends an edge a few pixels before a corner; across the edge it is exact.
    for ends in wanted:
        along = (ends[2:] - ends[:2]) / np.linalg.norm(ends[2:] - ends[:2])
        normal = np.array([-along[1], along[0]])
        off = np.abs((edges.ends.reshape(-1, 2, 2) - ends[:2]) @ normal).max(1)
        assert off.min() < 2 * edges.end_sigma
    length = np.hypot(edges.ends[:, 2] - edges.ends[:, 0], edges.ends[:, 3] - edges.ends[:, 1])
    assert (np.diff(length) <= 0).all()


def test_a_blank_picture_has_no_edge() -> None:
    assert detect_line_segments(np.full((64, 64, 3), 90, np.uint8)).ends.shape == (0, 4)
