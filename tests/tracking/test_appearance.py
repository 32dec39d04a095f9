"""Telling people by their clothes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from video2anim.networks.blazepose import PoseEstimate
from video2anim.networks.roi import SquareRoi
from video2anim.tracking import person_detection
from video2anim.tracking.appearance import AppearanceDescriptor, clothing_histogram
from video2anim.tracking.tracker import Track, rejoined

RED, BLUE, GREEN, GREY = (180, 40, 40), (40, 60, 170), (50, 140, 60), (120, 120, 120)
CORNERS = {11: (40, -60), 12: (-40, -60), 23: (25, 20), 24: (-25, 20), 25: (25, 90), 26: (-25, 90)}


def landmarks(x_px: float, y_px: float) -> np.ndarray:
    points = np.zeros((33, 2))
    for index, corner in CORNERS.items():
        points[index] = corner
    return points + np.array([x_px, y_px])


def picture(
    x_px: float, y_px: float, top: tuple[int, ...], bottom: tuple[int, ...], *, light: float = 1.0, seed: int = 0
) -> np.ndarray:
    """Somebody in one color above and one below the hips, before a noisy wall."""
    rng = np.random.default_rng(seed)
    image = np.full((300, 400, 3), 90.0)
    x, y = round(x_px), round(y_px)
    image[y - 62 : y + 20, x - 50 : x + 50] = top
    image[y + 20 : y + 92, x - 40 : x + 40] = bottom
    return np.clip(light * image + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)


def looks(*pictures: np.ndarray, x_px: float = 150.0) -> AppearanceDescriptor:
    found = AppearanceDescriptor()
    for image in pictures:
        found.add(clothing_histogram(image, landmarks(x_px, 120), np.ones(33)))
    return found


def test_same_clothes_in_other_light_are_nearer_than_other_clothes() -> None:
    here = looks(picture(150, 120, RED, BLUE))
    darker = looks(picture(150, 120, RED, BLUE, light=0.85, seed=1))
    exchanged = looks(picture(150, 120, BLUE, RED, seed=2))
    other_trousers = looks(picture(150, 120, RED, GREEN, seed=3))
    assert here.distance(here) == pytest.approx(0.0, abs=1e-6)
    assert here.distance(darker) < 0.6 * here.distance(other_trousers)
    assert here.distance(other_trousers) < here.distance(exchanged)
    assert here.distance(exchanged) > 0.7


def test_parts_that_are_not_seen_say_nothing() -> None:
    visibility = np.ones(33)
    visibility[25] = 0.1
    half = AppearanceDescriptor(clothing_histogram(picture(150, 120, RED, GREEN), landmarks(150, 120), visibility))
    whole = looks(picture(150, 120, RED, GREEN))
    blue = looks(picture(150, 120, RED, BLUE, seed=1))
    assert half.distance(blue) < 0.5 * whole.distance(blue), "the trunk alone is compared"
    assert np.isnan(half.distance(AppearanceDescriptor()))
    outside = clothing_histogram(picture(150, 120, RED, GREEN), landmarks(-900, 120), np.ones(33))
    assert not outside.any()


def track(frames: range, clothing: AppearanceDescriptor | None) -> Track:
    roi = SquareRoi(150.0, 120.0, 300.0, 0.0)
    mask = np.zeros((64, 64), np.uint8)
    made = Track(looks=clothing)
    for frame in frames:
        made.put(
            frame, PoseEstimate(1.0, landmarks(150, 120), np.zeros((33, 3)), np.ones(33), mask, roi, roi, np.zeros(33))
        )
    return made


def spans(tracks: list[Track]) -> list[tuple[int, int, int]]:
    return sorted((min(one.estimates), one.last_frame, len(one.estimates)) for one in tracks)


def test_who_comes_back_in_the_same_clothes_is_the_same() -> None:
    red, red_later, red_last = (looks(picture(150, 120, RED, BLUE, seed=seed)) for seed in range(3))
    green = looks(picture(150, 120, GREEN, GREY, seed=7))
    tracks = [track(range(0, 50), red), track(range(0, 400), green), track(range(120, 200), red_later),
              track(range(300, 350), red_last)]  # fmt: skip
    assert spans(rejoined(tracks, 300)) == [(0, 349, 180), (0, 399, 400)]
    assert len(rejoined([track(range(0, 50), red), track(range(120, 200), red_later)], 60)) == 2, "gone for too long"
    assert len(rejoined([track(range(0, 50), red), track(range(120, 200), None)], 300)) == 2, "not seen well enough"


def test_a_team_in_the_same_clothes_is_not_mixed_up() -> None:
    red = [looks(picture(150, 120, RED, BLUE, seed=seed)) for seed in range(3)]
    tracks = [track(range(0, 50), red[0]), track(range(0, 400), red[1]), track(range(120, 200), red[2])]
    assert len(rejoined(tracks, 300)) == 3


def test_what_is_outside_the_picture_is_not_visible() -> None:
    """However sure of it the landmark model is; corners of the body lie from x = 110 to 190, y = 60 to 210."""
    seen = track(range(2), None)
    assert (seen.rows(1, 400, 300).visibility == 1).all()
    cut = seen.rows(1, 400, 200).visibility[0]
    assert cut[[25, 26]].tolist() == [0, 0]
    assert cut[[11, 12, 23, 24]].tolist() == [1, 1, 1, 1]
    assert seen.rows(1, 180, 300).visibility[0, [11, 12]].tolist() == [0, 1]


def test_landmarks_of_which_the_network_contradicts_itself_count_less() -> None:
    seen = track(range(1), None)
    apart = np.zeros(33)
    apart[[15, 27]] = [person_detection.MAX_DISAGREEMENT, 1.0]
    seen.put(0, replace(seen.last, disagreement=apart))
    visibility = seen.rows(1, 400, 300).visibility[0]
    assert visibility[[11, 15]].tolist() == [1.0, 0.5]
    assert visibility[27] < 0.001
