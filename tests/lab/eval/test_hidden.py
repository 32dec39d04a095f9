"""Frames in which the truth hides the person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_truth import FRAMES, Tiny, write_truth

from video2anim.lab.eval.hidden import HIDDEN_RATIO, hidden_frames, hidden_stretches
from video2anim.lab.eval.truth import Truth, read_truth


@pytest.fixture
def truth(tmp_path_factory: pytest.TempPathFactory, tiny: Tiny) -> Truth:
    return read_truth(write_truth(tmp_path_factory.mktemp("hidden") / "clip", tiny))


def with_boxes(truth: Truth, box_px: np.ndarray) -> Truth:
    return replace(truth, person_box_px=box_px)


def whole_boxes(truth: Truth) -> np.ndarray:
    """Of the joints, a little smaller than the body."""
    from video2anim.geometry.projection import project

    pixel = project(truth.main.joints_camera_m, truth.intrinsics)
    return np.concatenate([pixel.min(1), pixel.max(1)], -1)[None]


def test_a_visible_person_is_not_hidden_and_an_invisible_one_is(truth: Truth) -> None:
    box_px = whole_boxes(truth)
    assert not hidden_frames(with_boxes(truth, box_px)).any()
    box_px[:, 2:4] = np.nan
    assert np.flatnonzero(hidden_frames(with_boxes(truth, box_px))).tolist() == [2, 3]


def test_a_sliver_is_hidden_and_a_half_is_not(truth: Truth) -> None:
    box_px = whole_boxes(truth)
    wide = box_px[..., 2] - box_px[..., 0]
    half, sliver = box_px.copy(), box_px.copy()
    half[..., 2] = half[..., 0] + 0.5 * wide
    sliver[..., 2] = sliver[..., 0] + 0.5 * HIDDEN_RATIO * wide
    assert not hidden_frames(with_boxes(truth, half)).any()
    assert hidden_frames(with_boxes(truth, sliver)).all()
    assert len(hidden_frames(truth)) == FRAMES


def test_stretches_have_sight_on_both_sides_and_last() -> None:
    hidden = np.zeros(120, bool)
    hidden[:12] = hidden[20:25] = hidden[30:39] = hidden[50:90] = hidden[115:] = True
    assert hidden_stretches(hidden, 30.0) == [(30, 38), (50, 89)]
    assert hidden_stretches(hidden, 15.0) == [(20, 24), (30, 38), (50, 89)]
