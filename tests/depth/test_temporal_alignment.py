"""Lines that bring one depth map to another, and what is left of flicker, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.depth.temporal_alignment import fitted_line, flicker

EVERY = np.ones((20, 30), bool)


def ramp() -> np.ndarray:
    return np.linspace(0.5, 2.5, EVERY.size).reshape(EVERY.shape)


@pytest.mark.parametrize(("scale", "offset"), [(2.0, 1.0), (0.3, -4.0), (1.0, 0.0), (250.0, 7.0)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_exact_line_comes_back(scale: float, offset: float, dtype: type) -> None:
    value = ramp()
    line = fitted_line(value.astype(dtype), (scale * value + offset).astype(dtype), EVERY)
    assert line == pytest.approx((scale, offset), rel=1e-5, abs=1e-5)


def test_only_chosen_pixels_are_fitted() -> None:
    value = ramp()
    reference, chosen = 2 * value + 1, EVERY.copy()
    reference[:, 15:], chosen[:, 15:] = -50.0, False
    assert fitted_line(value, reference, chosen) == pytest.approx((2.0, 1.0), abs=1e-6)


def test_outliers_hardly_bend_the_line() -> None:
    """A tenth of the pixels, those with the largest values too, is off by up to the whole range, all to one side."""
    rng = np.random.default_rng(1)
    value = ramp()
    reference = 2 * value + 1 + rng.normal(0, 0.02, value.shape)
    wrong = rng.random(value.shape) < 0.1
    reference[wrong] += rng.uniform(1.0, 4.0, int(wrong.sum()))
    plain = np.polyfit(value.ravel(), reference.ravel(), 1)
    assert abs(plain[1] - 1.0) > 0.15, "least squares would be bent"
    scale, offset = fitted_line(value, reference, EVERY) or (0.0, 0.0)
    assert scale * value + offset == pytest.approx(2 * value + 1, abs=0.02)


def test_a_person_left_in_the_picture_is_ignored() -> None:
    """Exact elsewhere: 8 % of the pixels, one block, nearer by half of the range."""
    value = ramp()
    reference = 0.5 * value + 0.2
    reference[6:14, 10:16] += 1.0
    assert fitted_line(value, reference, EVERY) == pytest.approx((0.5, 0.2), abs=0.01)


@pytest.mark.parametrize(("count", "fits"), [(59, False), (60, True)])
def test_too_few_pixels_are_refused(count: int, fits: bool) -> None:
    value, chosen = ramp(), np.zeros(EVERY.shape, bool)
    chosen.flat[:count] = True
    assert (fitted_line(value, 2 * value + 1, chosen) is not None) is fits
    assert fitted_line(value, 2 * value + 1, np.zeros_like(EVERY)) is None


def test_a_falling_line_is_refused() -> None:
    assert fitted_line(ramp(), 3 - 2 * ramp(), EVERY) is None


def test_a_map_that_says_nothing_is_refused() -> None:
    assert fitted_line(np.full(EVERY.shape, 1.7), ramp(), EVERY) is None


def test_a_reference_that_says_nothing_is_refused() -> None:
    """The best scale is zero, which would flatten the map; rounding makes it no positive one."""
    rng = np.random.default_rng(0)
    lines = [fitted_line(rng.random(500), np.full(500, 3.3), np.ones(500, bool)) for _ in range(20)]
    assert lines == [None] * 20


def test_flicker_by_hand() -> None:
    """Two pictures 0.1 apart: a deviation of 0.05 everywhere, over values that span nearly 1.1."""
    first = np.linspace(0.0, 1.0, 600).reshape(EVERY.shape)
    both = np.concatenate([first.ravel(), first.ravel() + 0.1])
    low, high = np.percentile(both, [2, 98])
    assert flicker([first, first + 0.1], EVERY) == pytest.approx(0.05 / (high - low), rel=1e-6)
    assert 1.0 < high - low < 1.1
    assert flicker([first, first, first], EVERY) == 0.0


def test_flicker_is_of_still_pixels_and_free_of_units() -> None:
    """Someone walks through the left half; the right half flickers by little."""
    rng = np.random.default_rng(0)
    base = ramp()
    pictures = [base + rng.normal(0, 0.01, base.shape) for _ in range(6)]
    moving = [picture.copy() for picture in pictures]
    for number, picture in enumerate(moving):
        picture[:, :15] += number
    still = EVERY.copy()
    still[:, :15] = False
    assert flicker(moving, still) == pytest.approx(flicker(pictures, still), rel=1e-9)
    assert flicker(moving, EVERY) > 3 * flicker(moving, still)
    scaled = [7 * picture - 3 for picture in pictures]
    assert flicker(scaled, still) == pytest.approx(flicker(pictures, still), rel=1e-6)


def test_a_fitted_line_takes_flicker_away() -> None:
    """Pictures of one scene under their own scale and offset, brought to the first."""
    base = ramp()
    pictures = [scale * base + offset for scale, offset in ((1.0, 0.0), (1.3, -0.2), (0.8, 0.4))]
    lines = [fitted_line(picture, base, EVERY) or (0.0, 0.0) for picture in pictures]
    steady = [scale * picture + offset for picture, (scale, offset) in zip(pictures, lines, strict=True)]
    assert flicker(pictures, EVERY) > 0.05
    assert flicker(steady, EVERY) < 1e-6
