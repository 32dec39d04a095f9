"""Views that lose the person: the criterion, and one clip of the preset."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.lab.synth.compose import ComposeOptions, compose
from video2anim.lab.synth.hiding import HIDDEN_RATIO, _is_hidden_once, _seen_ratio
from video2anim.lab.synth.presets import Hiding, clip_specs, hiding_of

HIDING = Hiding("shelf", (1.0, 3.0), "passing")


def boxes(seen_share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of a square of 10 x 10 px, of which the left share is seen, per frame."""
    y, x = np.meshgrid(np.arange(11.0), np.arange(11.0), indexing="ij")
    pixel = np.tile(np.stack([x, y], -1).reshape(-1, 2), (len(seen_share), 1, 1))
    return pixel, pixel[..., 0] <= 10 * seen_share[:, None]


def test_ratio_of_boxes() -> None:
    pixel, seen = boxes(np.array([1.0, 0.5, -0.1]))
    np.testing.assert_allclose(_seen_ratio(pixel, seen), [1.0, 0.5, 0.0])


@pytest.mark.parametrize(
    ("first", "stop", "accepted"),
    [(40, 80, True), (40, 60, False), (20, 60, False), (40, 140, False), (100, 140, False)],
    ids=["as wanted", "too short", "too early", "too long", "too late"],
)
def test_one_stretch_of_the_length_wanted(first: int, stop: int, accepted: bool) -> None:
    share = np.ones(150)
    share[first:stop] = -0.1
    assert _is_hidden_once(*boxes(share), HIDING) == accepted


def test_two_hidden_intervals_or_a_partly_visible_person_are_rejected() -> None:
    share = np.ones(150)
    share[40:80] = share[90:92] = -0.1
    assert not _is_hidden_once(*boxes(share), HIDING)
    share = np.ones(150)
    share[40:80] = 0.5 * HIDDEN_RATIO
    assert not _is_hidden_once(*boxes(share), HIDING)


def test_only_the_hidden_preset_hides() -> None:
    assert [hiding_of(spec) is None for spec in clip_specs("bench", 2, 0)] == [True, True]
    hidden = clip_specs("hidden", None, 0)
    assert len(hidden) == 6
    assert all(hiding_of(spec) is not None for spec in hidden)


def test_a_clip_leaves_the_picture_and_comes_back() -> None:
    (spec,) = [spec for spec in clip_specs("hidden", None, 0) if spec.name.endswith("leave_and_return")]
    shot = compose(spec, ComposeOptions())
    motion = shot.actors[0].motion
    pixel = motion.joints_camera_m[..., :2] / motion.joints_camera_m[..., 2:]
    half = 0.5 * np.array([shot.intrinsics.width_px, shot.intrinsics.height_px]) / shot.intrinsics.fx_px
    inside = ((np.abs(pixel) < half).all(-1) & (motion.joints_camera_m[..., 2] > 0)).mean(1)
    assert inside[:15].mean() > 0.5
    assert inside[-15:].mean() > 0.5
    assert np.count_nonzero(inside == 0) >= 15
