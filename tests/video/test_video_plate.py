"""Masked median, painting of holes, figure and ground."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.background.background_image import (
    inpaint_unobserved,
    masked_median,
    median_background,
    updated_background,
)
from video2anim.background.person_segmentation import Raster, lab_difference, person_probability, refine_mask
from video2anim.geometry.masks import dilated
from video2anim.types import PersonTrack


@pytest.mark.parametrize("count", [1, 2, 7, 12])
def test_masked_median_is_the_lower_median(count: int) -> None:
    rng = np.random.default_rng(count)
    samples = rng.integers(0, 256, (count, 9, 8, 3), dtype=np.uint8)
    usable = rng.random((count, 9, 8)) < 0.6
    median = masked_median(samples, usable)
    for y in range(9):
        for x in range(8):
            kept = samples[usable[:, y, x], y, x]
            want = np.sort(kept, axis=0)[(len(kept) - 1) // 2] if len(kept) else np.zeros(3)
            assert median[y, x].tolist() == want.tolist()


def test_extreme_values_survive() -> None:
    for value in (0, 255):
        samples = np.full((5, 2, 2, 3), value, np.uint8)
        assert np.all(masked_median(samples, np.ones((5, 2, 2), bool)) == value)


def test_updated_plate_equals_a_new_one() -> None:
    rng = np.random.default_rng(0)
    samples = rng.integers(0, 256, (9, 50, 70, 3), dtype=np.uint8)
    before, after = rng.random((2, 9, 25, 35)) < 0.3
    after[:, :20] = before[:, :20]
    background = updated_background(median_background(samples, before), samples, before, after)
    assert np.array_equal(background, median_background(samples, after))


def test_too_many_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="255"):
        median_background(np.zeros((256, 2, 2, 3), np.uint8), np.zeros((256, 2, 2), bool))


def test_holes_are_painted_from_their_rim() -> None:
    background = np.full((90, 120, 3), (200, 100, 50), np.uint8)
    unseen = np.zeros((45, 60), bool)
    unseen[15:30, 20:40] = True
    holed = background.copy()
    holed[30:60, 40:80] = 0
    painted = inpaint_unobserved(holed, unseen)
    assert np.abs(painted.astype(int) - background).max() <= 6
    assert inpaint_unobserved(holed, np.zeros_like(unseen)) is holed


def track_with(mask: np.ndarray, T_image_crop: np.ndarray, box_px: tuple[float, ...]) -> PersonTrack:
    """One frame of a person, then one without."""
    empty = np.zeros_like(mask)
    return PersonTrack(
        person_id=1,
        valid=np.array([True, False]),
        score=np.array([1.0, np.nan]),
        box_px=np.array([box_px, [np.nan] * 4]),
        landmarks_px=np.zeros((2, 33, 2)),
        landmarks_m=np.zeros((2, 33, 3)),
        visibility=np.zeros((2, 33)),
        mask_crop=np.stack([mask, empty]),
        T_image_crop=np.stack([T_image_crop, np.full((2, 3), np.nan)]),
    )


def test_mask_lands_where_the_crop_lies() -> None:
    mask = np.zeros((64, 64), np.uint8)
    mask[16:48, 24:40] = 255
    # Crop corner at (100, 50), 320 px a side: the mask covers x 220 to 300, y 130 to 290 (edges of pixels).
    T_image_crop = np.array([[320.0, 0, 99.5], [0, 320.0, 49.5]])
    track = track_with(mask, T_image_crop, (220, 130, 300, 290))
    raster = Raster.of_clip(800, 600, 400)
    probability = person_probability(track, 0, raster)
    inside = np.zeros((300, 400), bool)
    inside[65:145, 110:150] = True
    assert np.mean((probability > 0.5) != inside) < 0.002
    rows, columns = np.nonzero(probability > 0.5)
    assert abs(rows.mean() - 104.5) < 0.6
    assert abs(columns.mean() - 129.5) < 0.6
    assert not person_probability(track, 1, raster).any()


def test_an_empty_mask_becomes_an_undecided_box() -> None:
    track = track_with(np.zeros((64, 64), np.uint8), np.array([[320.0, 0, 100], [0, 320.0, 50]]), (220, 130, 300, 290))
    probability = person_probability(track, 0, Raster.of_clip(800, 600, 400))
    assert probability[100, 130] == 0.5
    assert probability[100, 90] == 0.0


def test_difference_sharpens_a_blurred_mask() -> None:
    rng = np.random.default_rng(1)
    background = np.clip(rng.normal(120, 25, (216, 384, 3)), 0, 255).astype(np.uint8)
    truth = np.zeros((216, 384), bool)
    truth[60:160, 150:190] = True
    picture = np.where(truth[..., None], np.uint8([200, 60, 40]), background)
    picture = np.clip(picture + rng.normal(0, 3, picture.shape), 0, 255).astype(np.uint8)
    # A mask that misses the upper fifth nearly and spills over the sides.
    probability = np.zeros((216, 384), np.float32)
    probability[50:170, 140:200] = 0.3
    probability[80:160, 145:195] = 0.6
    known = np.ones_like(truth)
    found = refine_mask(probability, lab_difference(picture, background), known)
    assert (found & truth).sum() / (found | truth).sum() > 0.9
    alone = refine_mask(probability, lab_difference(picture, background), ~known)
    assert np.array_equal(alone, probability > 0.5)
    assert not refine_mask(np.zeros_like(probability), lab_difference(picture, background), known).any()


def test_dilation_is_a_disc() -> None:
    mask = np.zeros((21, 21), bool)
    mask[10, 10] = True
    grown = dilated(mask, 3)
    assert grown[10, 13]
    assert grown[13, 10]
    assert not grown[13, 13]
    assert dilated(mask, 0) is mask
