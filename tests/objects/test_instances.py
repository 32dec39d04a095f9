"""What a detector found, with masks that do not end where its boxes do."""

from __future__ import annotations

import numpy as np

from video2anim.objects.instances import beyond_boxes
from video2anim.objects.merge import Detection

SHAPE = (120, 200)


def block(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    mask[top:bottom, left:right] = True
    return mask


def test_half_a_sofa_becomes_the_whole_instance() -> None:
    sofa = block(20, 40, 160, 90)
    half = Detection("chair", 0.4, sofa & block(20, 40, 90, 90))
    (found,) = beyond_boxes([(half, np.array([18.0, 38.0, 90.0, 92.0]))], [sofa])
    np.testing.assert_array_equal(found.mask, sofa)
    assert (found.label, found.score) == ("chair", 0.4)


def test_a_chair_that_ends_within_its_box_stays_apart_from_the_table_behind_it() -> None:
    both = block(20, 40, 160, 90)
    chair = Detection("chair", 0.6, block(30, 40, 70, 90))
    (found,) = beyond_boxes([(chair, np.array([22.0, 32.0, 78.0, 98.0]))], [both])
    np.testing.assert_array_equal(found.mask, chair.mask)


def test_a_whole_instance_leaves_an_object_of_its_own_alone() -> None:
    sofa = block(20, 40, 160, 90)
    half = Detection("chair", 0.4, block(20, 40, 90, 90))
    cushion = Detection("box", 0.5, block(120, 45, 140, 65))
    boxes = [np.array([18.0, 38.0, 90.0, 92.0]), np.array([112.0, 37.0, 148.0, 73.0])]
    whole, own = beyond_boxes([(half, boxes[0]), (cushion, boxes[1])], [sofa])
    np.testing.assert_array_equal(own.mask, cushion.mask)
    np.testing.assert_array_equal(whole.mask, sofa & ~cushion.mask)


def test_a_detection_that_lies_in_no_instance_is_kept() -> None:
    box = Detection("box", 0.5, block(120, 45, 140, 65))
    (found,) = beyond_boxes([(box, np.array([120.0, 45.0, 140.0, 65.0]))], [block(20, 40, 60, 90)])
    assert found is box


def test_without_detections_there_are_none() -> None:
    assert beyond_boxes([], [block(20, 40, 60, 90)]) == []
