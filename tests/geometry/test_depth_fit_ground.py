"""Scale and offset from the floor, where bodies cannot tell them apart; the room is known."""

from __future__ import annotations

import numpy as np
import pytest

from video2anim.geometry.depth_fit import (
    DepthFit,
    FrameEvidence,
    GroundEvidence,
    NoScaleError,
    evenly_far,
    fit_depth,
    ground_miss_m,
    metric_depth,
)

CAMERA_HEIGHT_M, PITCH_RAD = 1.5, np.deg2rad(-15)
KINDS = pytest.mark.parametrize(("kind", "scale", "offset"), [("depth", 0.2, -0.5), ("disparity", 0.4, 0.05)])


def coded(kind: str, depth_m: np.ndarray, scale: float, offset: float) -> np.ndarray:
    """What a network says of a depth, that scale and offset bring back."""
    return ((depth_m if kind == "depth" else 1 / depth_m) - offset) / scale


def floor(kind: str, scale: float, offset: float, *, wrong: float = 0.0, count: int = 300) -> GroundEvidence:
    """Floor pixels 2 to 6 m from a camera that looks down by 15 degrees; a share of them shows things before it."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.6, 0.6, count), rng.uniform(0.0, 0.5, count)
    ray_up = -y * np.cos(PITCH_RAD) + np.sin(PITCH_RAD)
    assert x.size == ray_up.size, "up has no part along x: a level camera"
    depth_m = -CAMERA_HEIGHT_M / ray_up
    shown_m = np.where(rng.random(count) < wrong, depth_m * rng.uniform(0.4, 0.9, count), depth_m)
    return GroundEvidence(ray_up, coded(kind, shown_m, scale, offset), CAMERA_HEIGHT_M)


def bodies(kind: str, scale: float, offset: float, middles_m: tuple[float, ...]) -> list[FrameEvidence]:
    """Curved bodies and what a network says of other points of the same surface."""
    rng, frames = np.random.default_rng(3), []
    for middle_m in middles_m:
        angle, up = rng.uniform(-1.3, 1.3, (2, 150)), rng.uniform(-0.9, 0.9, (2, 150))
        body, surface = np.stack([0.3 * np.sin(angle), up, middle_m - 0.3 * np.cos(angle)], -1)
        frames.append(FrameEvidence(body, surface / surface[:, 2:], coded(kind, surface[:, 2], scale, offset)))
    return frames


def fit(
    frames: list[FrameEvidence],
    kind: str,
    ground: GroundEvidence | None,
    *,
    with_offset: bool = True,
    resamples: int = 3,
) -> DepthFit:
    rng = np.random.default_rng(0)
    return fit_depth(frames, kind, with_offset=with_offset, rng=rng, resamples=resamples, ground=ground)


def test_far_floor_is_asked_as_often_as_near_floor() -> None:
    """A hundred times as many near pixels: all of the far ones are taken, and the rest is shared."""
    reach_m = np.concatenate([np.linspace(2.0, 2.4, 10_000), np.linspace(2.5, 8.0, 100)])
    pixels = np.arange(len(reach_m))
    chosen = evenly_far(pixels, reach_m, 600)
    assert 560 <= len(chosen) <= 600
    assert (np.diff(chosen) > 0).all()
    assert (chosen >= 10_000).sum() == 100
    np.testing.assert_array_equal(evenly_far(pixels[:50], reach_m, 600), pixels[:50])
    assert len(evenly_far(pixels, np.full(len(pixels), 3.0), 600)) == 600


def test_floor_depth_by_hand() -> None:
    """A ray that falls by 0.5 per metre meets the floor 1.5 m below after 3 m; one that rises never does."""
    ground = GroundEvidence(np.array([-0.5, -0.25, -1.0]), np.ones(3), 1.5)
    np.testing.assert_allclose(ground.depth_m, [3.0, 6.0, 1.5])
    assert GroundEvidence(np.array([0.1]), np.ones(1), 1.5).depth_m[0] > 1e5


def test_miss_of_the_floor_by_hand() -> None:
    """Depths 3.2, 6, and 1 m on rays that meet the floor at 3, 6 and 1.5 m: heights -0.1, 0 and 0.5 m."""
    ground = GroundEvidence(np.array([-0.5, -0.25, -1.0]), np.array([3.2, 6.0, 1.0]), 1.5)
    assert ground_miss_m(ground, "depth", 1.0, 0.0) == pytest.approx(0.1)
    inverse = GroundEvidence(ground.ray_up, 1 / ground.value, 1.5)
    assert ground_miss_m(inverse, "disparity", 1.0, 0.0) == pytest.approx(0.1)
    assert ground_miss_m(inverse, "disparity", 2.0, 0.0) == pytest.approx(0.75), "half of each depth"
    one_behind = GroundEvidence(ground.ray_up, np.array([3.2, -6.0, 1.0]), 1.5)
    assert ground_miss_m(one_behind, "depth", 1.0, 0.0) == pytest.approx(0.5), "one of three goes nowhere"
    assert ground_miss_m(one_behind, "depth", 1.0, -2.0) == np.inf, "most go nowhere"


@KINDS
def test_the_floor_alone_tells_scale_and_offset(kind: str, scale: float, offset: float) -> None:
    found = fit([], kind, floor(kind, scale, offset))
    assert found.scale == pytest.approx(scale, rel=0.005)
    assert found.offset == pytest.approx(offset, abs=0.005)
    assert found.ground_miss_m < 0.002
    assert found.scale_sigma < 0.01 * scale
    assert np.isfinite([found.scale_sigma, found.offset_sigma]).all()


@pytest.mark.parametrize("kind", ["depth", "disparity"])
def test_the_floor_alone_tells_the_scale_without_offset(kind: str) -> None:
    found = fit([], kind, floor(kind, 3.0, 0.0), with_offset=False)
    assert found.scale == pytest.approx(3.0, rel=0.002)
    assert found.offset == 0.0


@KINDS
def test_bodies_at_one_distance_need_the_floor(kind: str, scale: float, offset: float) -> None:
    """Without the floor, offset and scale trade against each other; with it, both are right and so is the body."""
    frames = bodies(kind, scale, offset, (3.0, 3.0))
    blind = fit(frames, kind, None, resamples=2)
    assert abs(blind.scale / scale - 1) > 0.03
    assert np.isnan(blind.ground_miss_m)
    found = fit(frames, kind, floor(kind, scale, offset), resamples=2)
    assert found.scale == pytest.approx(scale, rel=0.01)
    far_m = np.linspace(2.2, 5.5, 20)
    truth = coded(kind, far_m, scale, offset)
    assert metric_depth(kind, truth, found.scale, found.offset) == pytest.approx(far_m, rel=0.01)
    assert found.ground_miss_m < 0.01
    assert found.chamfer_after_m < 0.06, "the spacing of the body's points"


@KINDS
def test_things_taken_for_floor_hardly_count(kind: str, scale: float, offset: float) -> None:
    """15 % of the pixels are 10 to 60 % nearer than the floor. A plain line through all would be far off."""
    ground = floor(kind, scale, offset, wrong=0.15)
    far_m = np.linspace(2.2, 5.5, 20)
    truth = coded(kind, far_m, scale, offset)
    goal = ground.depth_m if kind == "depth" else 1 / ground.depth_m
    line = np.polyfit(ground.value, goal, 1)
    assert np.abs(metric_depth(kind, truth, *line) / far_m - 1).max() > 0.08
    found = fit([], kind, ground)
    assert metric_depth(kind, truth, found.scale, found.offset) == pytest.approx(far_m, rel=0.04)
    assert found.scale == pytest.approx(scale, rel=0.08)
    assert found.ground_miss_m < 0.05
    with_bodies = fit(bodies(kind, scale, offset, (3.0, 3.0)), kind, ground, resamples=2)
    assert metric_depth(kind, truth, with_bodies.scale, with_bodies.offset) == pytest.approx(far_m, rel=0.04)


def test_the_weight_decides_between_a_body_and_a_floor_that_contradict() -> None:
    """The floor is that of a camera twice as high: all of its depths are doubled, the body's are not."""
    frames = bodies("depth", 1.0, 0.0, (3.0,))
    far = floor("depth", 1.0, 0.0)
    scales = []
    for weight in (1e-6, 100.0):
        ground = GroundEvidence(far.ray_up, far.value, 2 * CAMERA_HEIGHT_M, weight)
        scales.append(fit(frames, "depth", ground, with_offset=False, resamples=2).scale)
    assert scales[0] == pytest.approx(1.0, abs=0.05)
    assert scales[1] == pytest.approx(2.0, abs=0.05)


def test_uncertainty_grows_with_a_floor_that_is_not_flat() -> None:
    """Resampled in blocks of neighbours: a floor that waves by 10 % leaves the scale less sure."""
    flat = floor("disparity", 0.4, 0.05, count=240)
    order = np.argsort(flat.ray_up)
    waves = 1 + 0.1 * np.sin(np.linspace(0, 6 * np.pi, 240))
    wavy = GroundEvidence(flat.ray_up[order], flat.value[order] * waves, CAMERA_HEIGHT_M)
    assert fit([], "disparity", wavy, resamples=6).scale_sigma > 0.005
    assert fit([], "disparity", flat, resamples=6).scale_sigma < 0.001


def test_pixels_are_drawn_again_in_blocks() -> None:
    """Pairs of ray and value stay together, neighbours stay together, and nothing else is changed."""
    ground = GroundEvidence(-np.linspace(0.1, 0.9, 240), np.arange(240.0), 1.4, 0.3)
    drawn = ground.resampled(np.random.default_rng(0))
    assert len(drawn.value) == len(drawn.ray_up) == 240
    np.testing.assert_array_equal(drawn.ray_up, ground.ray_up[drawn.value.astype(int)])
    assert (drawn.camera_height_m, drawn.weight) == (1.4, 0.3)
    assert 100 < len(np.unique(drawn.value)) < 240, "some twice, some never"
    assert (np.diff(drawn.value) == 1).mean() > 0.9
    assert len(GroundEvidence(-np.ones(5), np.ones(5), 1.4).resampled(np.random.default_rng(0)).value) == 5


def test_nothing_to_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="no floor"):
        fit([], "depth", None)
    with pytest.raises(NoScaleError, match="positive scale"):
        fit([], "disparity", GroundEvidence(np.full(50, -0.5), np.full(50, -1.0), 1.5))


@pytest.mark.parametrize("with_bodies", [False, True], ids=["floor", "floor and bodies"])
@pytest.mark.parametrize(
    ("kind", "offset"),
    [("disparity", 0.05), ("disparity", 0.25), ("disparity", 0.36), ("disparity", 0.42), ("depth", 4.0)],
)
def test_the_zero_of_the_values_is_free(kind: str, offset: float, with_bodies: bool) -> None:
    """Up to scale and offset: the same exact floor and body, told as values about any zero, are the same room.

    The room network's disparity is about zero in the middle of each picture, so a person's may be zero or less.
    """
    scale = 1.0 if kind == "depth" else 0.1
    ground = floor(kind, scale, offset)
    found = fit(bodies(kind, scale, offset, (3.0, 3.0)) if with_bodies else [], kind, ground, resamples=2)
    far_m = np.linspace(2.2, 5.5, 20)
    truth = coded(kind, far_m, scale, offset)
    assert metric_depth(kind, truth, found.scale, found.offset) == pytest.approx(far_m, rel=0.02)
    assert found.ground_miss_m < 0.02
