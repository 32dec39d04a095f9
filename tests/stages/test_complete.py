"""Hidden parts of outlines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scene_chain import run_chain
from synthetic_room import make_room

from stages.complete import CompleteConfig, complete_objects
from video2anim.networks.amodal import GRAY, amodal_mask, object_picture
from video2anim.pipeline.stage import StageContext
from video2anim.types import InstanceMasks, ObjectInstance


def _square() -> np.ndarray:
    mask = np.zeros((60, 80), dtype=bool)
    mask[10:50, 20:60] = True
    return mask


def test_hidden_notch_is_filled_and_open_one_is_not() -> None:
    notch = np.zeros((60, 80), dtype=bool)
    notch[10:30, 35:45] = True
    visible = _square() & ~notch
    assert np.array_equal(amodal_mask(visible, notch), _square())
    assert np.array_equal(amodal_mask(visible, np.zeros_like(notch)), visible)


def test_hidden_foot_reaches_the_floor() -> None:
    cut = np.zeros((60, 80), dtype=bool)
    cut[35:50, 20:40] = True
    assert np.array_equal(amodal_mask(_square() & ~cut, cut), _square())


def test_completed_pixels_get_the_objects_colors() -> None:
    image = np.full((60, 80, 3), 10, np.uint8)
    image[_square()] = (200, 40, 40)
    hidden = np.zeros((60, 80), dtype=bool)
    hidden[20:30, 30:40] = True
    image[hidden] = (0, 255, 0)
    crop, corner = object_picture(image, _square() & ~hidden, _square())
    assert corner == (20, 10)
    assert np.abs(crop.astype(int) - (200, 40, 40)).max() < 12


def test_outside_is_gray() -> None:
    mask = _square()
    mask[10:20, 20:30] = False
    crop, _ = object_picture(np.zeros((60, 80, 3), np.uint8), mask, mask)
    assert (crop[:10, :10] == GRAY).all()
    assert (crop[12:, 12:] == 0).all()


def test_stage_completes_behind_a_nearer_object() -> None:
    room = make_room()
    chain = run_chain(room)
    whole = chain.masks.instances[0].mask
    rows, columns = np.nonzero(whole)
    bite = np.zeros_like(whole)
    bite[rows.max() - 15 : rows.max() + 60, columns.min() : columns.min() + 25] = True
    front = ObjectInstance(2, "object", 1.0, np.zeros(4), bite)
    back = ObjectInstance(1, "object", 1.0, np.zeros(4), whole & ~bite)
    masks = InstanceMasks("test", (back, front), chain.masks.floor_mask)
    found = complete_objects(room.background, masks, chain.metric, CompleteConfig(), StageContext(Path()))
    completed = found.objects[0]
    assert completed.object_id == 1
    assert completed.completed_ratio > 0
    assert (completed.amodal_mask & whole).sum() > 0.9 * whole.sum()
    assert completed.image_rgb.shape[:2] == (np.ptp(np.nonzero(completed.amodal_mask)[0]) + 1,
                                             np.ptp(np.nonzero(completed.amodal_mask)[1]) + 1)  # fmt: skip
