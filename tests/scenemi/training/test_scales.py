"""Sizes measured before training are those of errors made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_run import CONFIG, consistent, exact

from scenemi.data.windows import MotionSet
from scenemi.features import BODY_ROTATIONS, JOINTS, LEVEL_X, LEVEL_Z, ROOT_ROTATION, TRANSLATION, Statistics
from scenemi.model.base import join_keyframes
from scenemi.model.conditions import Conditions, since_and_until
from scenemi.model.denoiser import SCALES, Denoiser
from scenemi.training.batches import PoolBatches
from scenemi.training.pool import Shard
from scenemi.training.scales import correlation, measure_scales, residual_size

KINDS = (TRANSLATION, ROOT_ROTATION, BODY_ROTATIONS, JOINTS)


def facing(angle: float) -> torch.Tensor:
    """A curve (1, 121, 201) whose root faces this way all the time."""
    curve = torch.zeros(1, 121, 201)
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    curve[..., ROOT_ROTATION] = torch.tensor([cos, 0, -sin, 0, 1, 0])
    return curve


def ends() -> torch.Tensor:
    mask = torch.zeros(1, 121)
    mask[0, [0, 120]] = 1
    return mask


def test_residuals_are_told_by_distance_from_the_nearest_keyframe() -> None:
    """An error that grows by a centimeter a frame in every column."""
    curve, mask = facing(0.0), ends()
    distance = since_and_until(mask).amin(-1).float()
    size = residual_size([(curve + 0.01 * distance[..., None], curve, mask)])
    assert size.shape == (61, 201)
    assert not size[0].any(), "exact keyframes have no error"
    expected = 0.01 * torch.arange(2, 60).float()
    torch.testing.assert_close(size[2:-1], expected[:, None].expand(-1, 201), atol=1e-5, rtol=0)


def test_residuals_are_measured_in_the_heading_of_the_curve() -> None:
    """Somebody who faces +x and is off along +x is off along the own z."""
    curve, mask = facing(np.pi / 2), ends()
    truth = curve.clone()
    truth[..., [0, *LEVEL_X[3:]]] += 0.1
    size = residual_size([(truth, curve, mask)])[30]
    along, aside = size[[2, *LEVEL_Z[3:]]], size[[0, *LEVEL_X[3:]]]
    assert (along[0] > 1.5 * aside[0]).all()
    assert (along > 1.2 * aside).all()


def test_what_hardly_moved_may_move_as_others_of_its_kind_do() -> None:
    """Half of each square is shared by a kind, so the mean square stays."""
    curve, mask = facing(0.0), ends()
    truth = curve.clone()
    truth[..., 9] += 0.2
    size = residual_size([(truth, curve, mask)])[30]
    rotations = size[BODY_ROTATIONS]
    assert rotations[1:].min() > 0
    assert float(rotations[0]) == pytest.approx(0.2 * np.sqrt(0.5 + 0.5 / 126), rel=1e-4)
    assert float(rotations.square().sum()) == pytest.approx(0.04, rel=1e-4)
    for kind in (TRANSLATION, JOINTS):
        assert not size[kind].any()


def test_the_residuals_correlation_over_time_is_found() -> None:
    """Of a process whose correlation is known, turned by a heading of 0."""
    lag = (torch.arange(121)[:, None] - torch.arange(121)).abs()
    known = torch.exp(-0.5 * (lag / 6.0) ** 2)
    values, vectors = torch.linalg.eigh(known + 1e-4 * torch.eye(121))
    process = (vectors * values.clamp(min=0).sqrt()) @ torch.randn(
        40, 121, 201, generator=torch.Generator().manual_seed(0)
    )
    curve, mask = facing(0.0).expand(40, -1, -1), ends().expand(40, -1)
    made = correlation([(curve + 0.1 * process, curve, mask)], torch.ones(201))
    torch.testing.assert_close(made, made.T, atol=0.05, rtol=0)
    found = made @ made.T
    torch.testing.assert_close(found.diagonal(), torch.ones(121))
    torch.testing.assert_close(found[40:80, 40:80], known[40:80, 40:80], atol=0.08, rtol=0)


def test_noise_of_a_degree_and_of_a_centimeter(motions: MotionSet, data: PoolBatches, statistics: Statistics) -> None:
    drawn = [data[step] for step in range(4)]
    found = measure_scales(drawn, statistics, torch.from_numpy(motions.rest_joints_m))
    assert {name: tuple(value.shape) for name, value in found.items()} == SCALES
    std = torch.from_numpy(statistics.std)
    turned, shifted = found["noise_std"] * std
    assert turned[TRANSLATION].max() < 1e-3
    torch.testing.assert_close(shifted[TRANSLATION], torch.full((3,), 0.01), rtol=0.15, atol=0)
    torch.testing.assert_close(shifted[JOINTS], torch.full((66,), 0.01), rtol=0.2, atol=1e-3)
    assert shifted[BODY_ROTATIONS].max() < 1e-3
    # A 6D entry turned by a degree about each axis: two of the three axes move a unit vector.
    assert turned[BODY_ROTATIONS].square().mean().sqrt() == pytest.approx(np.pi / 180 * np.sqrt(2 / 3), rel=0.1)
    np.testing.assert_array_equal(found["feature_std"].numpy(), statistics.std)
    np.testing.assert_array_equal(found["feature_mean"].numpy(), statistics.mean)
    assert found["view_std"].min() >= 0.1 - 1e-6


def test_measured_scales_are_the_errors_of_joined_keyframes(
    motions: MotionSet, shards: list[Shard], statistics: Statistics
) -> None:
    """What the denoiser takes for usual is what the windows of other steps show."""
    config = replace(CONFIG, batch=32, noisy_share=0.0)
    data = PoolBatches(shards, config)
    drawn = [consistent(exact(data[step]), motions) for step in range(6)]
    denoiser = Denoiser(CONFIG.model)  # type: ignore[arg-type]
    denoiser.set_scales(measure_scales(drawn[:4], statistics, torch.from_numpy(motions.rest_joints_m)))
    ratios = []
    for batch in drawn[4:]:
        x0 = (batch.features - torch.from_numpy(statistics.mean)) / torch.from_numpy(statistics.std)
        base = join_keyframes(x0, batch.mask)
        given = Conditions(batch.mask, batch.mask, base, batch.noise, torch.zeros(32, 7))
        between = since_and_until(batch.mask).amin(-1) > 5
        ratios.append(((x0 - base) / denoiser.scales(given))[between].square().mean().sqrt())
    assert 0.5 < float(torch.stack(ratios).mean()) < 1.6
