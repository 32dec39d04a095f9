"""Keyframe selection and windows: laws over many lengths."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from scenemi.windows import plan_windows, select_keyframes, split_long_gaps

WINDOW_FRAMES, OVERLAP_FRAMES = 121, 60
"""Of the paper, section 4 and supplement 8.2."""


@pytest.mark.parametrize(("frames", "interval"), [(1, 15), (2, 15), (16, 15), (17, 15), (121, 15), (122, 60), (690, 7)])
def test_keyframes_are_regular_and_include_both_ends(frames: int, interval: int) -> None:
    keys = select_keyframes(frames, interval)
    assert keys[0] == 0
    assert keys[-1] == frames - 1
    assert set(range(0, frames, interval)) <= set(keys)
    assert len(keys) <= len(range(0, frames, interval)) + 1


def test_unusable_frames_are_spanned_from_edge_to_edge() -> None:
    usable = np.ones(60, dtype=bool)
    usable[[0, 1]] = False
    usable[28:47] = False
    np.testing.assert_array_equal(select_keyframes(60, 15, usable=usable), [2, 15, 27, 47, 59])


def test_no_usable_frame_is_refused() -> None:
    with pytest.raises(ValueError, match="no usable frame"):
        select_keyframes(10, 5, usable=np.zeros(10, dtype=bool))


@pytest.mark.parametrize("frames", [1, 2, 60, 120, 121, 122, 150, 181, 182, 241, 690])
@pytest.mark.parametrize("interval", [1, 5, 15, 60])
def test_windows_cover_the_motion_end_on_keyframes_and_overlap(frames: int, interval: int) -> None:
    keys = select_keyframes(frames, interval)
    spans = plan_windows(keys)
    assert spans[0].start == 0
    assert spans[-1].stop == frames
    assert all(span.frame_count <= WINDOW_FRAMES and span.stop - 1 in keys for span in spans)
    assert all(span.frame_count == min(frames, WINDOW_FRAMES) for span in spans)
    for before, after in pairwise(spans):
        assert after.seed_stop == before.stop
        assert after.stop > before.stop
        assert before.stop - after.start >= OVERLAP_FRAMES


def test_regular_windows_of_the_paper() -> None:
    spans = plan_windows(select_keyframes(241, 15))
    assert [(s.start, s.stop, s.seed_stop) for s in spans] == [(0, 121, 0), (60, 181, 121), (120, 241, 181)]


def test_sparse_keyframes_get_a_smaller_overlap() -> None:
    spans = plan_windows(np.array([0, 100, 200, 300]))
    assert [(s.start, s.stop) for s in spans] == [(0, 101), (80, 201), (180, 301)]


def test_gaps_longer_than_a_window_must_be_bridged() -> None:
    keys = np.array([0, 10, 400])
    with pytest.raises(ValueError, match="390 frames apart"):
        plan_windows(keys)
    bridges = split_long_gaps(keys)
    assert np.diff(np.union1d(keys, bridges)).max() <= WINDOW_FRAMES - 1
    assert plan_windows(np.union1d(keys, bridges))[-1].stop == 401
    assert len(split_long_gaps(np.array([0, 120]))) == 0
