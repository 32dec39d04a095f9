"""Landmarks at the times of frames, from pictures that were taken at other times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from video2anim.humans.observe import at_frame_times
from video2anim.types import PayloadFile, PersonTrack, SourceInfo, VideoClip

FRAME_S = np.arange(60) / 30


def track_of(taken_s: np.ndarray, valid: np.ndarray) -> PersonTrack:
    """A body that moves at constant speed, as seen at some times."""
    gap = np.where(valid, 0.0, np.nan)
    x = (taken_s + gap)[:, None, None]
    rows = len(valid)
    return PersonTrack(
        1, valid, gap, np.tile(gap[:, None], 4), x + np.arange(66.0).reshape(33, 2), 2 * x + np.zeros((33, 3)),
        np.tile(0.5 + gap[:, None], 33), np.zeros((rows, 64, 64), np.uint8), np.tile(gap[:, None, None], (2, 3)),
    )  # fmt: skip


def retimed(track: PersonTrack, taken_s: np.ndarray) -> PersonTrack:
    """The track in a clip whose frames show pictures taken at these times, after the first 5 s of the source."""
    source = SourceInfo("h264", "yuv420p", 64, 48, 0, 1.0, 30.0, 60, 60, 2.0, 0.0)
    clip = VideoClip(PayloadFile(Path("a.mp4")), 64, 48, 30.0, FRAME_S, 5 + taken_s, source, ((5.0, 7.0),), 0, ())
    return at_frame_times(track, clip)


def test_steady_motion_is_steady_at_any_frame_rate() -> None:
    every = np.ones(60, bool)
    for fps in (10.0, 12.5, 24.0, 25.0, 30.0):
        taken_s = np.floor(FRAME_S * fps + 1e-6) / fps
        found = retimed(track_of(taken_s, every), taken_s)
        until = taken_s[-1] >= FRAME_S
        np.testing.assert_allclose(found.landmarks_px[until, 0, 0], FRAME_S[until], atol=1e-9)
        np.testing.assert_allclose(found.landmarks_m[until, 5, 1], 2 * FRAME_S[until], atol=1e-9)
        np.testing.assert_allclose(found.landmarks_px[~until, 0, 0], taken_s[-1])
        assert found.valid.all()


def test_frames_without_the_person_stay_so() -> None:
    taken_s = np.floor(FRAME_S * 10 + 1e-6) / 10
    valid = ~np.isin(np.arange(60), range(21, 33))
    found = retimed(track_of(taken_s, valid), taken_s)
    assert np.isnan(found.landmarks_px[~valid]).all()
    np.testing.assert_allclose(found.landmarks_px[valid, 0, 0], np.minimum(FRAME_S, taken_s[-1])[valid], atol=1e-9)
    nobody = track_of(taken_s, np.zeros(60, bool))
    assert retimed(nobody, taken_s) is nobody
