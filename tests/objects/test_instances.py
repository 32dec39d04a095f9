"""Which detections are floor: mats that people stood on, in rooms of boxes."""

from __future__ import annotations

import numpy as np
import pytest
from seen_boxes import LENS, Block, Shot, looking, shoot

from video2anim.geometry.projection import world_points
from video2anim.objects.instances import without_floor
from video2anim.objects.merge import Detection
from video2anim.types import View

FROM = looking((0.0, 1.6, 0.0), (0.0, 0.4, -3.0))
VIEW = View(FROM, LENS)
MAT = Block((0.0, 0.02, -3.0), (1.6, 0.04, 1.2))
STOOD_M = np.array([[-0.3, 0.0, -3.0], [0.3, 0.0, -2.9], [0.1, 0.0, -3.2]])
"""In the world."""


def left(
    block: Block,
    soles_m: np.ndarray = STOOD_M,
    *,
    on_floor: bool = True,
    is_seen: bool = True,
    nearer: float = 1.0,
) -> tuple[list[Detection], np.ndarray, Shot]:
    """What is left of one detection whose depth is `nearer` times its own; `is_seen`: feet are."""
    shot = shoot([block], FROM)
    mask = shot.mask(0)
    depth_m = np.where(mask, nearer, 1.0) * shot.depth_m
    kept, floor = without_floor(
        [Detection("table", 0.5, mask)], (soles_m - FROM[:3, 3]) @ FROM[:3, :3], np.full(len(soles_m), on_floor),
        np.full(mask.shape, is_seen), world_points(depth_m, VIEW)[..., 1], VIEW,
    )  # fmt: skip
    return kept, floor, shot


@pytest.mark.parametrize("nearer", [1.0, 0.8])
def test_a_mat_that_people_stood_on_is_floor(nearer: float) -> None:
    """Also where its depth makes it a low table."""
    kept, floor, shot = left(MAT, nearer=nearer)
    assert not kept
    np.testing.assert_array_equal(floor, shot.mask(0))


def test_what_people_stood_on_higher_up_is_an_object() -> None:
    step = Block((0.0, 0.1, -3.0), (1.6, 0.2, 1.2))
    kept, floor, _ = left(step, STOOD_M + np.array([0.0, 0.2, 0.0]), on_floor=False)
    assert len(kept) == 1
    assert not floor.any()


def test_feet_behind_a_table_are_no_evidence() -> None:
    """A low table hides them: the person was never seen there."""
    table = Block((0.0, 0.3, -2.4), (2.0, 0.4, 0.3))
    kept, _, _ = left(table, is_seen=False)
    assert len(kept) == 1


def test_a_mask_that_holds_floor_before_a_bench_stays_one() -> None:
    """Most of it is far above the soles."""
    bench = Block((0.0, 0.45, -3.4), (1.6, 0.9, 0.4))
    kept, _, _ = left(bench, np.array([[-0.3, 0.02, -3.2], [0.3, 0.02, -3.2]]))
    assert len(kept) == 1


def test_few_soles_and_soles_out_of_the_picture_are_no_evidence() -> None:
    assert len(left(MAT, STOOD_M[:1])[0]) == 1
    assert len(left(MAT, STOOD_M + np.array([0.0, 0.0, 9.0]))[0]) == 1
    assert len(left(MAT, np.zeros((0, 3)))[0]) == 1
