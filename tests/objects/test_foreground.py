"""Which pixels of a mask show the object, in rooms of boxes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from seen_boxes import FLOOR, LENS, Block, Shot, looking, shoot, table

from video2anim.objects.foreground import foreground_mask, inverse_background
from video2anim.types import View

CAMERA = looking((0.0, 1.6, 0.0), (0.0, 0.6, -3.0))
WALL = Block((0.0, 1.5, -5.05), (14.0, 3.0, 0.1), np.deg2rad(8.0))
ALL = np.ones((LENS.height_px, LENS.width_px), bool)


def blob(mask: np.ndarray) -> np.ndarray:
    """The convex outline, as a network would draw it."""
    points = np.argwhere(mask)[:, ::-1].astype(np.int32)
    filled = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return filled.astype(bool)


def behind(shot: Shot, *masks: np.ndarray) -> np.ndarray | None:
    return inverse_background(shot.depth_m, ALL, np.any(masks, axis=0), shot.mask(FLOOR))


def shown(shot: Shot, own: np.ndarray, known: np.ndarray = ALL, depth_m: np.ndarray | None = None) -> np.ndarray:
    depth_m = shot.depth_m if depth_m is None else depth_m
    return foreground_mask(own, known, depth_m, View(shot.T_world_camera, LENS), behind(shot, own))


def test_wall_goes_on_behind_things() -> None:
    """A slanted wall: inverse depth is linear in the picture, so what hides it costs nothing."""
    empty, full = shoot([WALL], CAMERA), shoot([WALL, Block((0.3, 0.8, -2.5), (1.0, 1.6, 0.5))], CAMERA)
    found = behind(full, full.mask(1))
    assert found is not None
    hidden = full.mask(1) & empty.mask(0)
    assert hidden.sum() > 2000
    assert np.median(np.abs(found * empty.depth_m - 1)[hidden]) < 0.02
    assert np.abs(found * empty.depth_m - 1)[hidden].max() < 0.08


def test_no_background_where_things_and_floor_are_all_that_is_seen() -> None:
    shot = shoot([WALL], CAMERA)
    assert inverse_background(shot.depth_m, ALL, shot.mask(0), shot.mask(FLOOR)) is None
    assert inverse_background(shot.depth_m, ~ALL, ~ALL, ~ALL) is None


@pytest.mark.parametrize("away_m", [0.0, 0.8])
def test_between_the_legs_of_a_table_there_is_no_table(away_m: float) -> None:
    blocks = [*table(1.0, 0.75, 0.6, (0.2, -2.6 - away_m), 0.4), WALL]
    shot = shoot(blocks, CAMERA)
    true, own = shot.mask(0, 1, 2, 3, 4), blob(shot.mask(0, 1, 2, 3, 4))
    found = shown(shot, own)
    assert (own & ~true).sum() > 0.3 * true.sum(), "the blob is a bad mask"
    assert not found[~own].any()
    assert found[true].mean() > 0.85
    assert found[own & ~true].mean() < 0.1


def test_mask_over_the_outline_of_a_cabinet_takes_nothing_of_the_wall() -> None:
    shot = shoot([Block((0.0, 0.6, -3.0), (1.0, 1.2, 0.4)), WALL], CAMERA)
    true = shot.mask(0)
    own = cv2.dilate(true.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    found = shown(shot, own)
    assert found[own & shot.mask(1)].mean() < 0.02
    assert found[true].mean() > 0.95


def test_cabinet_at_the_wall_is_kept_whole() -> None:
    wall = Block((0.0, 1.5, -3.25), (14.0, 3.0, 0.1))
    shot = shoot([Block((0.0, 0.6, -3.1), (1.0, 1.2, 0.2)), wall], CAMERA)
    assert shown(shot, shot.mask(0))[shot.mask(0)].mean() > 0.95


def test_low_step_is_no_floor() -> None:
    shot = shoot([Block((0.0, 0.06, -2.5), (0.8, 0.12, 0.8)), WALL], CAMERA)
    assert shown(shot, shot.mask(0))[shot.mask(0)].mean() > 0.85


def test_smear_between_thing_and_wall_is_left_out() -> None:
    """Networks turn the step at an outline into a ramp."""
    shot = shoot([Block((0.0, 0.6, -2.6), (1.0, 1.2, 0.4)), WALL], CAMERA)
    smeared_m = 1 / cv2.GaussianBlur(1 / shot.depth_m, (0, 0), 3.0)
    own = cv2.dilate(shot.mask(0).astype(np.uint8), np.ones((13, 13), np.uint8)).astype(bool)
    before = own & (shot.world_m[..., 1] > 0.2)
    found = shown(shot, own, depth_m=smeared_m)
    farthest_m = smeared_m[found & before].max()
    assert farthest_m < smeared_m[before].max() - 0.5
    assert found[shot.mask(0)].mean() > 0.8


def test_pixels_without_depth_never_count_and_hardly_any_left_means_all() -> None:
    shot = shoot([Block((0.0, 0.6, -3.0), (1.0, 1.2, 0.4)), WALL], CAMERA)
    own = shot.mask(0)
    unknown = np.zeros_like(own)
    unknown[:, : own.shape[1] // 2] = True
    holes_m = np.where(unknown, np.nan, shot.depth_m)
    found = foreground_mask(own, ~unknown, holes_m, View(shot.T_world_camera, LENS), behind(shot, own))
    assert not found[unknown].any()
    assert found[own & ~unknown].mean() > 0.9
    patch = np.zeros_like(own)
    patch[tuple(np.argwhere(own)[:20].T)] = True
    np.testing.assert_array_equal(shown(shot, patch), patch)
    floor = shot.mask(FLOOR) & (np.arange(own.shape[0]) > 200)[:, None]
    np.testing.assert_array_equal(shown(shot, floor), floor)
