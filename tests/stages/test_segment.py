"""Objects and floor in the background image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scene_chain import masks_of, run_chain
from synthetic_room import BOX, FLOOR, make_room

from stages.segment import SegmentConfig
from video2anim.objects.depth_regions import RegionLimits, find_regions
from video2anim.pipeline.stage import StageContext


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize(("pitch_deg", "roll_deg", "height_m"), [(14.0, 0.0, 1.6), (22.0, 12.0, 1.6), (35.0, 0.0, 2.4)])
def test_box_and_floor_are_found(pitch_deg: float, roll_deg: float, height_m: float) -> None:
    room = make_room(pitch_deg=pitch_deg, roll_deg=roll_deg, height_m=height_m)
    masks = run_chain(room).masks
    assert len(masks.instances) == 1
    box = masks.instances[0]
    assert _iou(box.mask, room.surface_full == BOX) > 0.8
    assert _iou(masks.floor_mask, room.surface_full == FLOOR) > 0.95
    assert not (box.mask & masks.floor_mask).any()
    rows, columns = np.nonzero(box.mask)
    assert box.box_px.tolist() == [columns.min(), rows.min(), columns.max(), rows.max()]
    assert 0 < box.score <= 1


def test_empty_room_has_no_objects() -> None:
    masks = run_chain(make_room(with_box=False)).masks
    assert masks.instances == ()
    assert masks.floor_mask.any()


def test_true_depth_of_any_provider_segments_as_well() -> None:
    room = make_room()
    height, width = room.depth_m.shape
    regions = find_regions(
        room.depth_m,
        np.ones(room.depth_m.shape, dtype=bool),
        room.bodies.main_view.resized(width, height),
        RegionLimits(min_ratio=0.004, min_m=0.15, max_m=4.0, max_objects=12),
    )
    assert len(regions.objects) == 1
    assert _iou(regions.objects[0].mask, room.surface == BOX) > 0.8
    assert regions.objects[0].height_m == pytest.approx(0.9, abs=0.1)


def test_size_limits_are_obeyed() -> None:
    room = make_room()
    chain = run_chain(room)
    config = SegmentConfig(provider="geometric", finder="none", max_m=0.5)
    masks = masks_of(room, chain.depth, config, StageContext(Path()))
    assert masks.instances == ()
