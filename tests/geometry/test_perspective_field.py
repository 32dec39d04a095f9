"""Perspective fields: their definition by brute force, and the camera that a field gives back."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from video2anim.geometry.perspective_field import (
    FieldCamera,
    PerspectiveField,
    field_of_camera,
    fit_camera,
    pitch_roll_of,
    up_of,
)

ROWS, SIGMA_RAD = 12, 0.03


def up_vector(pitch_deg: float, roll_deg: float) -> np.ndarray:
    """World up in camera axes, by turning the camera: first up by pitch, then clockwise about its axis."""
    pitch, roll = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
    # Columns: the camera's right, down and forward in a level frame of x right, y down, z forward.
    nod = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    return (nod @ turn).T @ np.array([0.0, -1.0, 0.0])


def perfect(focal_ratio: float, up: np.ndarray, aspect: float, sigma_rad: float = SIGMA_RAD) -> PerspectiveField:
    columns = max(4, round(ROWS * aspect))
    direction, latitude = field_of_camera(ROWS, columns, aspect, focal_ratio, up)
    sigma = np.full((ROWS, columns), sigma_rad)
    return PerspectiveField(direction, latitude, sigma, sigma)


def noisy(field: PerspectiveField, turned_rad: np.ndarray, latitude_rad: np.ndarray) -> PerspectiveField:
    """The same field with other directions and latitudes."""
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    x, y = field.up[..., 0], field.up[..., 1]
    up = np.stack([cos * x - sin * y, sin * x + cos * y], -1)
    return PerspectiveField(up, field.latitude_rad + latitude_rad, field.up_sigma_rad, field.latitude_sigma_rad)


def turned_rad(found: FieldCamera, up: np.ndarray) -> float:
    return float(np.arccos(np.clip(found.up_camera @ up, -1, 1)))


@pytest.mark.parametrize(
    ("aspect", "focal_ratio", "pitch_deg", "roll_deg"),
    [(4 / 3, 0.9, -20, 10), (9 / 16, 0.6, 25, -13), (1.0, 2.5, 0, 0)],
)
def test_field_is_what_projection_says(aspect: float, focal_ratio: float, pitch_deg: float, roll_deg: float) -> None:
    """A point on each cell's ray is raised a little and projected again; its ray's rise is its latitude."""
    up, rows, columns = up_vector(pitch_deg, roll_deg), 5, 7
    direction, latitude = field_of_camera(rows, columns, aspect, focal_ratio, up)
    assert direction.shape == (rows, columns, 2)
    assert latitude.shape == (rows, columns)
    height_px = 600.0
    width_px, focal_px = aspect * height_px, focal_ratio * height_px
    for row in range(rows):
        for column in range(columns):
            x_px = (column + 0.5) * width_px / columns - width_px / 2
            y_px = (row + 0.5) * height_px / rows - height_px / 2
            point = 3.0 * np.array([x_px / focal_px, y_px / focal_px, 1.0])
            raised = point + 1e-6 * up
            moved = focal_px * raised[:2] / raised[2] - np.array([x_px, y_px])
            np.testing.assert_allclose(direction[row, column], moved / np.linalg.norm(moved), atol=1e-5)
            rise_m = float(point @ up)
            level_m = float(np.linalg.norm(point - rise_m * up))
            assert latitude[row, column] == pytest.approx(math.atan2(rise_m, level_m), abs=1e-9)


def test_a_level_camera_by_hand() -> None:
    """Up is up everywhere; the picture's top row, half a cell inside, is at the angle of its ray."""
    direction, latitude = field_of_camera(4, 3, 1.5, 0.5, np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(direction, np.broadcast_to([0.0, -1.0], (4, 3, 2)), atol=1e-12)
    # Rows at -3/8, -1/8, 1/8, 3/8 of the height: over a focal length of a half, -0.75 ... 0.75.
    np.testing.assert_allclose(latitude[:, 1], np.arctan([0.75, 0.25, -0.25, -0.75]), atol=1e-12)
    # A column at x = 1/3 of the width = 0.5 heights from the middle: one focal length aside.
    np.testing.assert_allclose(latitude[0, 2], math.atan2(0.75, math.hypot(1.0, 1.0)), atol=1e-12)


@pytest.mark.parametrize("aspect", [16 / 9, 4 / 3, 1.0, 9 / 16])
@pytest.mark.parametrize("focal_ratio", [0.45, 0.8, 1.3, 2.4])
@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0, 0), (-40, 13), (30, -13), (-15, -4), (8, 90)])
def test_a_perfect_field_gives_its_camera_back(
    aspect: float, focal_ratio: float, pitch_deg: float, roll_deg: float
) -> None:
    up = up_vector(pitch_deg, roll_deg)
    found = fit_camera([perfect(focal_ratio, up, aspect)], aspect)
    assert found.focal_ratio == pytest.approx(focal_ratio, rel=1e-4)
    np.testing.assert_allclose(found.up_camera, up, atol=1e-4)
    assert found.fov_y_rad == pytest.approx(2 * math.atan(0.5 / focal_ratio), rel=1e-4)
    assert np.linalg.norm(found.up_camera) == pytest.approx(1.0, abs=1e-9)
    assert 0 < found.focal_log_sigma < math.inf
    assert 0 < found.up_sigma_rad < math.inf


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(-25, 8), (10, -13), (0, 0)])
def test_noise_of_single_cells_averages_out(pitch_deg: float, roll_deg: float) -> None:
    """192 cells, each 3 degrees off in both: the camera is off by far less than one of them."""
    rng, up = np.random.default_rng(5), up_vector(pitch_deg, roll_deg)
    field = perfect(0.9, up, 4 / 3, np.deg2rad(3))
    shape = field.latitude_rad.shape
    found = fit_camera([noisy(field, *(rng.normal(0, np.deg2rad(3), (2, *shape))))], 4 / 3)
    assert found.focal_ratio == pytest.approx(0.9, rel=0.05)
    assert turned_rad(found, up) < np.deg2rad(0.8)


def test_wrong_cells_are_outvoted() -> None:
    """A sixth of the cells points anywhere and looks anywhere; a mean over them would be ten degrees off."""
    rng, up = np.random.default_rng(2), up_vector(-15, 6)
    field = perfect(1.1, up, 4 / 3, np.deg2rad(1))
    shape = field.latitude_rad.shape
    wrong = rng.random(shape) < 1 / 6
    assert wrong.sum() > 25
    spoiled = noisy(field, np.where(wrong, rng.uniform(0.5, 2.0, shape), 0.0), np.where(wrong, 1.0, 0.0))
    assert (spoiled.latitude_rad - field.latitude_rad).mean() > np.deg2rad(8)
    found = fit_camera([spoiled], 4 / 3)
    assert found.focal_ratio == pytest.approx(1.1, rel=0.04)
    assert turned_rad(found, up) < np.deg2rad(1.0)


def test_cells_count_by_their_expected_errors() -> None:
    """The left half is 20 degrees off in latitude and says so; the fit follows the right half."""
    up = up_vector(-10, 3)
    field = perfect(0.9, up, 4 / 3, 0.01)
    rows, columns = field.latitude_rad.shape
    left = np.broadcast_to(np.arange(columns) < columns // 2, (rows, columns))
    off = np.where(left, np.deg2rad(20), 0.0)
    honest = PerspectiveField(
        field.up, field.latitude_rad + off, field.up_sigma_rad, np.where(left, 3.0, field.latitude_sigma_rad)
    )
    assert turned_rad(fit_camera([honest], 4 / 3), up) < np.deg2rad(0.3)
    boasting = PerspectiveField(field.up, field.latitude_rad + off, field.up_sigma_rad, field.latitude_sigma_rad)
    assert turned_rad(fit_camera([boasting], 4 / 3), up) > np.deg2rad(1.0)


def test_two_fields_meet_in_between_and_may_differ_in_size() -> None:
    """Pictures of one view that disagree by 4 degrees of pitch: the camera of both lies at their middle."""
    fields = [perfect(0.9, up_vector(pitch_deg, 0), 4 / 3, 0.1) for pitch_deg in (-12, -8)]
    found = fit_camera(fields, 4 / 3)
    assert np.rad2deg(np.arcsin(found.up_camera[2])) == pytest.approx(-10.0, abs=0.2)
    coarse = field_of_camera(6, 8, 4 / 3, 0.9, up_vector(-12, 0))
    sigma = np.full((6, 8), 0.1)
    found = fit_camera([fields[0], PerspectiveField(*coarse, sigma, sigma)], 4 / 3)
    assert found.focal_ratio == pytest.approx(0.9, rel=1e-4)
    np.testing.assert_allclose(found.up_camera, up_vector(-12, 0), atol=1e-4)


def test_a_sure_field_outweighs_an_unsure_one() -> None:
    sure, unsure = perfect(0.9, up_vector(-12, 0), 4 / 3, 0.02), perfect(0.9, up_vector(-2, 0), 4 / 3, 0.4)
    found = fit_camera([sure, unsure], 4 / 3)
    assert np.rad2deg(np.arcsin(found.up_camera[2])) == pytest.approx(-12.0, abs=0.4)


def test_uncertainty_grows_with_what_the_fields_expect() -> None:
    """Exact fields: twice the expected error is twice the uncertainty."""
    up = up_vector(-15, 5)
    found = [fit_camera([perfect(0.9, up, 4 / 3, sigma_rad)], 4 / 3) for sigma_rad in (0.02, 0.04, 0.08)]
    for one, two in itertools.pairwise(found):
        assert two.focal_log_sigma == pytest.approx(2 * one.focal_log_sigma, rel=0.02)
        assert two.up_sigma_rad == pytest.approx(2 * one.up_sigma_rad, rel=0.02)


def test_few_cells_count_not_their_number() -> None:
    """Neighbours err together: nine times the cells make the camera no surer."""
    up = up_vector(-15, 5)
    sure = []
    for rows, columns in ((8, 12), (24, 36)):
        sigma = np.full((rows, columns), 0.05)
        sure.append(fit_camera([PerspectiveField(*field_of_camera(rows, columns, 1.5, 0.9, up), sigma, sigma)], 1.5))
    assert sure[1].focal_log_sigma == pytest.approx(sure[0].focal_log_sigma, rel=0.1)
    assert sure[1].up_sigma_rad == pytest.approx(sure[0].up_sigma_rad, rel=0.1)
    # No surer of up than by the square root of two such cells, each 0.05 rad off.
    assert sure[0].up_sigma_rad > 0.05 / math.sqrt(4)


def test_uncertainty_grows_with_contradiction() -> None:
    """Fields that boast of 0.01 rad and are 0.1 rad off within themselves, or 10 degrees off each other."""
    rng, up = np.random.default_rng(0), up_vector(-15, 5)
    field = perfect(0.9, up, 4 / 3, 0.01)
    agreed = fit_camera([field, field], 4 / 3)
    shape = field.latitude_rad.shape
    scattered = fit_camera([noisy(field, *rng.normal(0, 0.1, (2, *shape)))], 4 / 3)
    apart = fit_camera([field, perfect(0.9, up_vector(-25, 5), 4 / 3, 0.01)], 4 / 3)
    for contradicted in (scattered, apart):
        assert contradicted.up_sigma_rad > 4 * agreed.up_sigma_rad
        assert contradicted.focal_log_sigma > 4 * agreed.focal_log_sigma
    # Each is off by 5 degrees from the middle of both: the uncertainty admits that.
    assert apart.up_sigma_rad > np.deg2rad(2.5)


def test_a_long_lens_is_less_sure_than_a_wide_one() -> None:
    """The lens is read off how the fields change over the picture, which a long one shows less."""
    up = up_vector(-15, 0)
    wide, long = (fit_camera([perfect(ratio, up, 4 / 3)], 4 / 3) for ratio in (0.6, 2.4))
    assert long.focal_log_sigma > 2 * wide.focal_log_sigma


@pytest.mark.parametrize("name", ["latitude_rad", "up", "none"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_nothing_to_fit_is_refused(name: str, value: float) -> None:
    field = perfect(0.9, up_vector(0, 0), 4 / 3)
    if name == "none":
        with pytest.raises(ValueError, match="at least one field"):
            fit_camera([], 4 / 3)
        return
    broken = getattr(field, name).copy()
    broken.flat[3] = value
    values = {"up": field.up, "latitude_rad": field.latitude_rad} | {name: broken}
    spoiled = PerspectiveField(values["up"], values["latitude_rad"], field.up_sigma_rad, field.latitude_sigma_rad)
    with pytest.raises(ValueError, match="finite"):
        fit_camera([field, spoiled], 4 / 3)


@pytest.mark.parametrize("name", ["up_sigma_rad", "latitude_sigma_rad"])
def test_expected_errors_that_are_no_numbers_are_refused(name: str) -> None:
    field = perfect(0.9, up_vector(0, 0), 4 / 3)
    broken = getattr(field, name).copy()
    broken.flat[3] = math.nan
    sigmas = {"up_sigma_rad": field.up_sigma_rad, "latitude_sigma_rad": field.latitude_sigma_rad} | {name: broken}
    with pytest.raises(ValueError):
        fit_camera([PerspectiveField(field.up, field.latitude_rad, **sigmas)], 4 / 3)


def test_the_horizon_of_a_network_that_does_not_know_the_lens_stays() -> None:
    """A telephoto lens seen as one of 1.0: the horizon is 0.29 image heights above the center in both."""
    field = FieldCamera(1.0, up_of(math.atan(-0.29), 0.03), np.diag([0.05**2, 0.02**2, 0.02**2]))
    found = field.with_focal(2.5)
    pitch, roll = pitch_roll_of(found.up_camera)
    assert found.focal_ratio == 2.5
    assert 2.5 * math.tan(pitch) == pytest.approx(-0.29, rel=0.02)
    assert roll == pytest.approx(0.03)
    assert found.focal_log_sigma < 0.01


def test_a_focal_length_within_the_error_of_the_field_leaves_its_pitch() -> None:
    """What the covariance says of both still counts: the pitch is surer once the focal length is known."""
    covariance = np.array([[0.2**2, 0.008, 0.0], [0.008, 0.05**2, 0.0], [0.0, 0.0, 0.02**2]])
    field = FieldCamera(1.0, up_of(-0.28, 0.03), covariance)
    found = field.with_focal(1.15)
    np.testing.assert_allclose(found.up_camera, field.up_camera, atol=1e-12)
    assert found.covariance[1, 1] == pytest.approx(0.05**2 - 0.008**2 / 0.2**2)
    assert found.covariance[2, 2] == pytest.approx(0.02**2)
