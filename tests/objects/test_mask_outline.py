"""Masks that are a little wrong, of objects whose colors tell where they end."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.objects.outline import cut_by_color

ROWS, COLUMNS = 120, 160
NOTHING = np.zeros((ROWS, COLUMNS), bool)
WALL_RGB, CRATE_RGB = (90, 120, 80), (150, 70, 60)


def box(top: int, bottom: int, left: int, right: int) -> np.ndarray:
    mask = NOTHING.copy()
    mask[top:bottom, left:right] = True
    return mask


def picture(*crates: np.ndarray) -> np.ndarray:
    """Crates before a wall, both with grain."""
    image = np.full((ROWS, COLUMNS, 3), WALL_RGB, float)
    for crate in crates:
        image[crate] = CRATE_RGB
    return np.clip(image + np.random.default_rng(0).normal(0, 12, image.shape), 0, 255).astype(np.uint8)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


CRATE = box(40, 90, 50, 120)
WRONG = (CRATE | box(37, 40, 70, 100)) & ~box(40, 90, 117, 120) & ~box(60, 70, 50, 54)
"""With a bump on its top, without its right edge, and a hole in the left."""


def test_the_outline_goes_to_where_the_color_changes() -> None:
    assert iou(WRONG, CRATE) < 0.93
    found = cut_by_color(WRONG, picture(CRATE), NOTHING)
    assert iou(found, CRATE) > 0.99
    np.testing.assert_array_equal(found, cut_by_color(WRONG, picture(CRATE), NOTHING))


def test_a_neighbor_of_the_same_color_is_left_to_its_own_mask() -> None:
    neighbor = box(40, 90, 120, 150)
    found = cut_by_color(WRONG, picture(CRATE, neighbor), neighbor)
    assert not (found & neighbor).any()
    assert iou(found, CRATE) > 0.97


def test_what_has_the_color_of_the_wall_keeps_its_mask_about() -> None:
    assert iou(cut_by_color(WRONG, picture(), NOTHING), WRONG) >= 0.5


def test_specks_are_left_out() -> None:
    speck = box(34, 36, 60, 62)
    found = cut_by_color(CRATE | speck, picture(CRATE, speck), NOTHING)
    assert not (found & speck).any()
    assert iou(found, CRATE) > 0.99


@pytest.mark.parametrize("mask", [NOTHING, ~NOTHING, box(0, 1, 0, 1), box(60, 62, 20, 140), box(0, ROWS, 0, 80)],
                         ids=["nothing", "everything", "a pixel", "a line", "a half"])  # fmt: skip
def test_any_mask_is_cut_or_kept(mask: np.ndarray) -> None:
    found = cut_by_color(mask, picture(CRATE), NOTHING)
    assert found.shape == mask.shape
    assert found.dtype == bool
    assert found.any() == mask.any()
