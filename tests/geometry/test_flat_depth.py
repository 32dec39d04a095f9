"""Fits that lose the scene's depth."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.geometry.depth_fit import DepthFit, FrameEvidence, fit_depth
from video2anim.geometry.flat_depth import USUAL_OFFSET, fit_at_usual_offset, is_flat

BACKGROUND = np.linspace(0.1, 3.0, 100).reshape(10, 10)
NETWORK = "room-depth"


def fit(scale: float, offset: float) -> DepthFit:
    return DepthFit(scale, offset, 0.01, 0.01, 0.1, 0.1)


@pytest.mark.parametrize(("offset", "flat"), [(0.0, False), (0.2, False), (0.5, False), (0.9, True)])
def test_an_offset_far_above_what_disparity_scales_to_is_flat(offset: float, flat: bool) -> None:
    assert is_flat(fit(0.1, offset), "disparity", BACKGROUND) == flat


def test_depth_is_never_flat() -> None:
    assert not is_flat(fit(0.1, 5.0), "depth", BACKGROUND)


def frames_at(distance_m: float, scale: float, noise: float) -> list[FrameEvidence]:
    """A curved body that stays at one distance; disparity of true scale, its offset the usual one."""
    rng = np.random.default_rng(0)
    offset = scale * USUAL_OFFSET[NETWORK] * float(np.median(BACKGROUND))
    frames = []
    for _ in range(8):
        angle, up = rng.uniform(-1.3, 1.3, 250), rng.uniform(-0.9, 0.9, 250)
        body_m = np.stack([0.25 * np.sin(angle), up, distance_m - 0.15 * np.cos(angle)], -1)
        ray = body_m / body_m[:, 2:]
        error = noise * rng.normal(size=250) + 2 * noise * rng.normal()
        frames.append(FrameEvidence(body_m, ray, (1 / body_m[:, 2] - offset) / scale + error))
    return frames


def test_a_body_at_one_distance_flattens_the_scene_and_the_usual_offset_does_not() -> None:
    scale = 0.1
    frames = frames_at(4.0, scale, 0.15)
    free = fit_depth(frames, "disparity", with_offset=True, rng=np.random.default_rng(0))
    usual = fit_at_usual_offset(frames, BACKGROUND, NETWORK, rng=np.random.default_rng(0))
    assert free.scale < 0.6 * scale, "errors of disparity make its scale small"
    assert usual is not None
    assert usual.scale == pytest.approx(scale, rel=0.1)
    assert usual.offset / usual.scale == pytest.approx(USUAL_OFFSET[NETWORK] * np.median(BACKGROUND))
    assert not is_flat(usual, "disparity", BACKGROUND)


def test_an_unknown_network_has_no_usual_offset() -> None:
    frames = frames_at(4.0, 0.1, 0.0)
    assert fit_at_usual_offset(frames, BACKGROUND, "of-the-user", rng=np.random.default_rng(0)) is None
