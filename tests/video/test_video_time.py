"""Time stamps to a constant rate; tags."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.video.cfr import constant_rate_index, max_gap_s
from video2anim.video.metadata import focal_35mm_of


def test_same_rate_is_the_identity() -> None:
    assert constant_rate_index(np.arange(90) / 30, 30).tolist() == list(range(90))


@pytest.mark.parametrize("rounding_s", [0.0, 0.001])
def test_double_rate_takes_every_second_picture(rounding_s: float) -> None:
    time_s = 7.0 + np.arange(100) / 60
    if rounding_s:
        time_s = np.round(time_s / rounding_s) * rounding_s
    assert constant_rate_index(time_s, 30).tolist() == list(range(0, 100, 2))


def test_low_rate_holds() -> None:
    index = constant_rate_index(np.arange(5) / 5, 30)
    assert len(index) == 30
    assert np.bincount(index).tolist() == [6] * 5


def test_film_rate_is_never_more_than_half_a_picture_away() -> None:
    time_s = np.arange(48) / 24
    index = constant_rate_index(time_s, 30)
    assert len(index) == 60
    assert np.all(np.diff(index) >= 0)
    assert np.abs(time_s[index] - np.arange(60) / 30).max() <= 0.5 / 24 + 1e-9


def test_a_hole_holds_the_last_picture() -> None:
    time_s = np.r_[np.arange(10), np.arange(22, 30)] / 30
    index = constant_rate_index(time_s, 30)
    assert len(index) == 30
    assert index[9:22].tolist() == [9] * 13
    assert index[22] == 10
    assert max_gap_s(time_s) == pytest.approx(13 / 30)


def test_jitter_keeps_pictures_apart() -> None:
    rng = np.random.default_rng(3)
    time_s = np.arange(200) / 30 + rng.uniform(-0.008, 0.008, 200)
    index = constant_rate_index(time_s, 30)
    assert np.abs(time_s[index] - (time_s[0] + np.arange(len(index)) / 30)).max() < 0.02
    assert len(np.unique(index)) > 195


def test_one_picture_is_one_frame() -> None:
    assert constant_rate_index(np.array([4.2]), 30).tolist() == [0]


@pytest.mark.parametrize("time_s", [[], [0.0, 0.0], [0.1, 0.0], [0.0, np.nan]])
def test_stamps_that_do_not_increase_are_refused(time_s: list[float]) -> None:
    with pytest.raises(ValueError, match="time stamp"):
        constant_rate_index(np.array(time_s), 30)


@pytest.mark.parametrize(
    ("metadata", "focal_mm"),
    [
        ({"com.apple.quicktime.camera.focal_length.35mm_equivalent": "26"}, 26.0),
        ({"FocalLengthIn35mmFilm": "24.5 mm"}, 24.5),
        ({"major_brand": "isom", "Focal Length In 35mm Format": "77"}, 77.0),
        ({"focal_length": "4.2"}, 0.0),
        ({"com.apple.quicktime.camera.focal_length.35mm_equivalent": "unknown"}, 0.0),
        ({"com.apple.quicktime.camera.focal_length.35mm_equivalent": "0"}, 0.0),
        ({}, 0.0),
    ],
)
def test_focal_length_tags(metadata: dict[str, str], focal_mm: float) -> None:
    assert focal_35mm_of(metadata) == focal_mm
