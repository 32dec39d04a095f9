"""Front and back of tracked people."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.networks.landmarks import MIRROR_LANDMARK
from video2anim.tracking.sides import without_reversals
from video2anim.types import PersonTrack

FRAMES, FPS = 40, 30.0


def walker(heading_rad: np.ndarray) -> PersonTrack:
    """A body whose landmarks are at fixed places in its own axes, seen from afar, at a heading in every frame."""
    rng = np.random.default_rng(0)
    own = rng.uniform(-0.2, 0.2, (33, 3))
    own[:, 1] = np.linspace(-0.8, 0.8, 33)
    half = np.arange(33)
    own[:, 0] = np.where(half < MIRROR_LANDMARK, 0.2, np.where(half > MIRROR_LANDMARK, -0.2, 0.0))
    own[[11, 12], 1], own[[23, 24], 1] = -0.5, 0.0
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    turned = np.stack(
        [own[:, 0] * c[:, None] + own[:, 2] * s[:, None], np.tile(own[:, 1], (FRAMES, 1)),
         own[:, 2] * c[:, None] - own[:, 0] * s[:, None]], -1,
    )  # fmt: skip
    return PersonTrack(
        1, np.ones(FRAMES, bool), np.ones(FRAMES), np.tile([0.0, 0, 100, 200], (FRAMES, 1)),
        100 + 100 * turned[..., :2], turned, np.tile(np.linspace(0.5, 1, 33), (FRAMES, 1)),
        np.zeros((FRAMES, 64, 64), np.uint8), np.tile(np.eye(2, 3), (FRAMES, 1, 1)), 0,
    )  # fmt: skip


def facing_away(track: PersonTrack, frames: slice, part: slice = slice(None)) -> PersonTrack:
    """What the landmark network says of some frames if it takes the front for the back."""
    for values, sign in ((track.landmarks_px, 1.0), (track.landmarks_m, np.array([1.0, 1, -1])), (track.visibility, 1)):
        values[frames, part] = (values[frames][:, MIRROR_LANDMARK] * sign)[:, part]
    return track


@pytest.mark.parametrize("part", [slice(None), slice(0, 23), slice(23, 33)], ids=["whole", "upper", "lower"])
@pytest.mark.parametrize("frames", [slice(10, 11), slice(10, 15), slice(3, 8)])
def test_short_reversals_are_turned_back(frames: slice, part: slice) -> None:
    true = walker(np.full(FRAMES, 0.3))
    found = without_reversals(facing_away(walker(np.full(FRAMES, 0.3)), frames, part), FPS)
    np.testing.assert_allclose(found.landmarks_px, true.landmarks_px)
    np.testing.assert_allclose(found.landmarks_m, true.landmarks_m)
    np.testing.assert_allclose(found.visibility, true.visibility)


@pytest.mark.parametrize(
    "track",
    [
        walker(np.linspace(0, 2 * np.pi, FRAMES)),
        facing_away(walker(np.full(FRAMES, 0.3)), slice(10, 18)),
        facing_away(walker(np.full(FRAMES, 0.3)), slice(20, FRAMES)),
    ],
    ids=["a turn", "a long time", "to the end"],
)
def test_what_may_be_a_turn_stays(track: PersonTrack) -> None:
    """A body that turns is seen from the side in between; nobody knows which of two long views is right."""
    assert without_reversals(track, FPS) is track


def test_missing_frames_are_no_turn() -> None:
    track = facing_away(walker(np.full(FRAMES, 0.3)), slice(10, 13))
    track.valid[[9, 13]] = False
    track.landmarks_px[[9, 13]] = np.nan
    assert without_reversals(track, FPS) is track
