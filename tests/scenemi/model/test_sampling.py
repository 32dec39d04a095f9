"""Samplers against data whose best denoiser is known in closed form: a Gaussian process over the frames."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from scenemi.model.conditions import Conditions, Descriptors
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.sampling import Method, SamplerConfig, guided, posterior, sample, time_steps
from scenemi.scene.field import BoxField

FRAMES, FEATURES = 12, 2
sampler = functools.partial(SamplerConfig, temperature=1.0)
SCHEDULE = CosineSchedule()
KEYS = torch.tensor([0, 5, 11])


def covariance() -> Tensor:
    index = torch.arange(FRAMES, dtype=torch.float64)
    return torch.exp(-0.5 * ((index[:, None] - index[None]) / 3.0) ** 2) + 1e-3 * torch.eye(FRAMES, dtype=torch.float64)


MEAN = torch.linspace(-1.0, 1.0, FRAMES, dtype=torch.float64)[:, None].expand(FRAMES, FEATURES)


def conditions(batch: int, keys: bool) -> Conditions:
    mask = torch.zeros(batch, FRAMES)
    if keys:
        mask[:, KEYS] = 1
    return Conditions(
        mask, mask, torch.zeros(batch, FRAMES, FEATURES), torch.zeros(batch, FRAMES, 2), torch.zeros(batch, 7)
    )


class Fake:
    """A denoiser by a function of x_t, t, the conditions and the last estimate."""

    def __init__(self, answer: Callable[..., Tensor]) -> None:
        self.answer = answer
        self.prepared: list[Conditions] = []

    def center(self, given: Conditions) -> Tensor:
        return torch.zeros_like(given.base)

    def noise(self, white: Tensor, prepared: int) -> Tensor:
        return white

    def prepare(self, given: Conditions) -> int:
        self.prepared.append(given)
        return len(self.prepared)

    def __call__(self, x: Tensor, t: Tensor, given: Conditions, estimate: Tensor | None, prepared: Any, /) -> Tensor:
        return self.answer(x, t, given, estimate, prepared)


@functools.cache
def gain(t: int, keys: bool) -> tuple[Tensor, Tensor]:
    """E[x_0 | x_t] - MEAN = gain (x_t - signal MEAN); keyframe rows are seen without noise."""
    alpha_bar = float(SCHEDULE.alpha_bar[t])
    exact = torch.zeros(FRAMES, dtype=torch.bool)
    exact[KEYS] = keys
    signal = torch.where(exact, 1.0, math.sqrt(alpha_bar)).double()
    noise = torch.where(exact, 1e-10, 1 - alpha_bar).double()
    S = covariance()
    seen = signal[:, None] * S * signal[None] + torch.diag(noise)
    return torch.linalg.solve(seen, signal[:, None] * S).T, signal


def best(x: Tensor, t: Tensor, given: Conditions, *_: object) -> Tensor:
    matrix, signal = gain(int(t[0]), bool(given.mask.any()))
    return (MEAN + matrix @ (x.double() - signal[:, None] * MEAN)).float()


oracle = Fake(best)
"""The best denoiser."""


def generators(count: int, seed: int = 0) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(1000 * seed + i) for i in range(count)]


def truth(keys: bool, values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (N, F) and covariance (N, N) of the data, given its keyframes or not."""
    S = covariance()
    if not keys:
        return MEAN, S
    gain = torch.linalg.solve(S[KEYS][:, KEYS], S[KEYS]).T
    return MEAN + gain @ (values[KEYS] - MEAN[KEYS]), S - gain @ S[KEYS]


METHODS: list[tuple[Method, int]] = [("ddpm", 1000), ("ddpm", 250), ("ddim", 250), ("dpm-solver++", 50)]


@pytest.mark.parametrize("keys", [False, True])
@pytest.mark.parametrize(("method", "steps"), METHODS)
def test_samples_have_the_mean_and_covariance_of_the_data(method: Method, steps: int, keys: bool) -> None:
    count = 400 if steps == 1000 else 1500
    values = MEAN + torch.linalg.cholesky(covariance()) @ torch.randn(
        FRAMES, FEATURES, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    x_keys = values.float().expand(count, -1, -1)
    config = sampler(method, steps, guidance_weight=1.0)
    made = sample(oracle, SCHEDULE, x_keys, conditions(count, keys), config, generators(count)).double()
    mean, spread = truth(keys, values)
    centered = made - mean
    # Three and a half standard errors, and the 6 % of variance that large steps of first order lose.
    assert (made.mean(0) - mean).abs().max() < 3.5 / math.sqrt(count)
    found = torch.einsum("bif,bjf->ij", centered, centered) / (count * FEATURES)
    assert (found - spread).abs().max() < 3.5 * math.sqrt(2 / (count * FEATURES)) + 0.06
    assert found.trace() == pytest.approx(float(spread.trace()), rel=0.1)
    if keys:
        assert (made[:, KEYS] - values[KEYS]).abs().max() < 1e-3


@pytest.mark.parametrize("method", ["ddim", "dpm-solver++"])
def test_twenty_steps_are_close_to_a_thousand_from_the_same_noise(method: Method) -> None:
    x_keys = MEAN.float().expand(64, -1, -1)
    given = conditions(64, True)
    runs = [
        sample(
            oracle,
            SCHEDULE,
            x_keys,
            given,
            sampler(method, steps, guidance_weight=1.0, hard_keyframes=False),
            generators(64),
        )
        for steps in (20, 1000)
    ]
    error = (runs[0] - runs[1]).square().mean().sqrt()
    # DDIM is of first order, DPM-Solver++ 2M of second; the data's deviation is about 0.5 between these keyframes.
    assert error < (0.03 if method == "ddim" else 0.02)


def test_second_order_is_nearer_the_limit_than_first_order() -> None:
    x_keys, given = MEAN.float().expand(64, -1, -1), conditions(64, False)

    def run(method: Method, steps: int) -> Tensor:
        config = sampler(method, steps, guidance_weight=1.0)
        return sample(oracle, SCHEDULE, x_keys, given, config, generators(64))

    limit = run("ddim", 1000)
    assert (run("dpm-solver++", 20) - limit).abs().mean() < 0.6 * (run("ddim", 20) - limit).abs().mean()


@pytest.mark.parametrize("method", ["ddpm", "ddim", "dpm-solver++"])
def test_temperature_shrinks_the_spread_and_keeps_the_mean(method: Method) -> None:
    """For Gaussian data the samples' deviation is the temperature times the data's."""
    count, steps = 800, 200 if method == "ddpm" else 20

    def run(temperature: float) -> Tensor:
        config = SamplerConfig(method, steps, guidance_weight=1.0, temperature=temperature)
        x_keys = MEAN.float().expand(count, -1, -1)
        return sample(oracle, SCHEDULE, x_keys, conditions(count, False), config, generators(count)).double()

    half, full = run(0.5), run(1.0)
    assert half.std(0).mean() == pytest.approx(0.5 * float(full.std(0).mean()), rel=0.06)
    assert (half.mean(0) - MEAN).abs().max() < 0.08
    assert run(0.0).std(0).max() < 1e-5


def test_deterministic_methods_repeat_and_ancestral_noise_follows_the_seed() -> None:
    x_keys, given = MEAN.float().expand(2, -1, -1), conditions(2, False)
    methods: tuple[Method, ...] = ("ddim", "dpm-solver++", "ddpm")
    for method in methods:
        config = sampler(method, 10, guidance_weight=1.0)
        first, again, other = (sample(oracle, SCHEDULE, x_keys, given, config, generators(2, s)) for s in (0, 0, 1))
        torch.testing.assert_close(first, again, rtol=0, atol=0)
        assert (first - other).abs().max() > 0.1


def test_a_window_does_not_depend_on_its_neighbors() -> None:
    config = sampler("ddpm", 10, guidance_weight=1.0)
    x_keys = MEAN.float().expand(3, -1, -1)
    three = sample(oracle, SCHEDULE, x_keys, conditions(3, True), config, generators(3))
    last = sample(oracle, SCHEDULE, x_keys[:1], conditions(1, True), config, generators(3)[2:])
    torch.testing.assert_close(three[2:], last, rtol=0, atol=1e-6)


def test_ddpm_step_is_the_posterior_of_the_schedule() -> None:
    """With s = t - 1: mean (Ho et al. 2020, eq. 7) and the variance beta~ of the paper's Table 5."""
    for t in (2, 20, 500, 999, 1000):
        ab, ab_before, beta = SCHEDULE.alpha_bar[t], SCHEDULE.alpha_bar[t - 1], SCHEDULE.beta[t]
        of_clean, of_noisy, deviation = posterior(float(ab), float(ab_before), 1.0)
        assert of_clean == pytest.approx(math.sqrt(ab_before) * beta / (1 - ab), rel=1e-9)
        assert of_noisy == pytest.approx(math.sqrt(1 - beta) * (1 - ab_before) / (1 - ab), rel=1e-9)
        assert deviation**2 == pytest.approx((1 - ab_before) / (1 - ab) * beta, rel=1e-9)


def test_a_ddim_step_keeps_the_noise_level() -> None:
    for eta in (0.0, 0.3, 1.0):
        of_clean, of_noisy, deviation = posterior(0.2, 0.6, eta)
        # x_t = sqrt(0.2) x_0 + sqrt(0.8) noise gives x_s = sqrt(0.6) x_0 + sqrt(0.4) noise.
        assert of_clean + of_noisy * math.sqrt(0.2) == pytest.approx(math.sqrt(0.6))
        assert of_noisy**2 * 0.8 + deviation**2 == pytest.approx(0.4)


@pytest.mark.parametrize("stop", [0, 10, 20, 60])
@pytest.mark.parametrize("steps", [1, 2, 5, 10, 20, 50, 999, 1000])
@pytest.mark.parametrize("spacing", [1.0, 2.0])
def test_steps_fall_from_T_to_0_and_meet_the_end_of_imputation(stop: int, steps: int, spacing: float) -> None:
    grid = time_steps(1000, steps, stop_step=stop, spacing=spacing)
    assert grid[0] == 1000
    assert grid[-1] == 0
    assert len(grid) == steps + 1
    assert (np.diff(grid) < 0).all()
    if stop and steps > 1:
        assert stop in grid
        assert (grid[:-1] <= stop).sum() >= (2 if steps > 4 else 1)


def test_keyframes_are_imputed_above_the_stop_step_only() -> None:
    seen: list[tuple[int, float, float]] = []

    def spy(x: Tensor, t: Tensor, given: Conditions, *_: object) -> Tensor:
        seen.append((int(t[0]), float((x[:, KEYS] - 7.0).abs().max()), float(given.imputed.sum())))
        return torch.zeros_like(x)

    x_keys = torch.full((2, FRAMES, FEATURES), 7.0)
    config = sampler("ddim", 20, guidance_weight=1.0)
    sample(Fake(spy), SCHEDULE, x_keys, conditions(2, True), config, generators(2), stop_step=20)
    assert {t <= 20 for t, _, _ in seen} == {True, False}
    for t, off, told in seen:
        assert (off == 0) == (t > 20)
        assert told == (2 * len(KEYS) if t > 20 else 0), "the denoiser is told"


@pytest.mark.parametrize("method", ["ddpm", "ddim", "dpm-solver++"])
def test_each_estimate_goes_to_the_next_step(method: Method) -> None:
    seen: list[Tensor | None] = []
    answers: list[Tensor] = []

    def spy(x: Tensor, t: Tensor, given: Conditions, estimate: Tensor | None, prepared: object) -> Tensor:
        seen.append(estimate)
        answers.append(torch.full_like(x, float(t[0])))
        return answers[-1]

    x_keys = torch.zeros(2, FRAMES, FEATURES)
    sample(Fake(spy), SCHEDULE, x_keys, conditions(2, True), sampler(method, 6), generators(2))
    assert len(seen) == 7
    assert seen[0] is None, "the first step has none, and is taken again with its own answer"
    for before, told in zip(answers, seen[1:], strict=False):
        assert told is not None
        assert torch.equal(before, told)


def test_the_estimate_is_what_the_next_step_sees() -> None:
    seen: list[Tensor | None] = []

    def spy(x: Tensor, t: Tensor, given: Conditions, estimate: Tensor | None, prepared: object) -> Tensor:
        seen.append(estimate)
        return torch.full_like(x, 3.0)

    x_keys = torch.zeros(1, FRAMES, FEATURES)
    made = sample(Fake(spy), SCHEDULE, x_keys, conditions(1, True), sampler("ddim", 4), generators(1))
    assert all(told is not None and torch.equal(told, torch.full_like(told, 3.0)) for told in seen[1:])
    torch.testing.assert_close(made, torch.full_like(made, 3.0))


def scenes(batch: int, shown: int) -> dict[str, Conditions]:
    """Windows of which so many are shown a scene, in both of its forms."""
    given, known = conditions(batch, True), (torch.arange(batch) < shown).float()
    box = torch.tensor([[[0.0, 1.0, 0.0, 0.1, 0.1, 0.1, 0.0]]]).expand(batch, -1, -1)
    scene = Descriptors(torch.ones(batch, 2, 2, 2), torch.zeros(batch, FRAMES, 1, 3), known, known)
    return {
        "field": replace(given, field=BoxField.of(box, known) if shown else None),
        "descriptors": replace(given, descriptors=scene),
    }


@pytest.mark.parametrize("form", ["field", "descriptors"])
def test_guidance_is_two_passes_and_none_at_weight_1_or_without_a_scene(form: str) -> None:
    calls: list[tuple[bool, object]] = []

    def scene_or_not(x: Tensor, t: Tensor, given: Conditions, estimate: Tensor | None, prepared: object) -> Tensor:
        calls.append((given.has_scene, prepared))
        return torch.full_like(x, 1.0 if given.has_scene else 0.25)

    x = torch.zeros(3, FRAMES, FEATURES)
    predict = guided(Fake(scene_or_not), x, scenes(3, 2)[form], 2.5, 0)
    for _ in range(2):
        torch.testing.assert_close(predict(x, 500), torch.full_like(x, 2.5 - 1.5 * 0.25))
    assert calls == [(True, 1), (False, 2)] * 3, "each pass with what was prepared for it, the first step twice"
    calls.clear()
    guided(Fake(scene_or_not), x, scenes(3, 2)[form], 1.0, 0)(x, 500)
    guided(Fake(scene_or_not), x, scenes(3, 0)[form], 2.5, 0)(x, 500)
    assert [seen for seen, _ in calls] == [True, True, False, False]


def test_both_passes_are_asked_along_the_guided_estimate() -> None:
    seen: list[Tensor | None] = []

    def spy(x: Tensor, t: Tensor, given: Conditions, estimate: Tensor | None, prepared: object) -> Tensor:
        seen.append(estimate)
        return torch.full_like(x, 1.0 if given.has_scene else 0.0)

    x = torch.zeros(1, FRAMES, FEATURES)
    predict = guided(Fake(spy), x, scenes(1, 1)["field"], 2.0, 0)
    predict(x, 500)
    predict(x, 400)
    assert seen[:2] == [None, None]
    for told in seen[2:]:
        assert told is not None
        torch.testing.assert_close(told, torch.full_like(told, 2.0))


def test_bad_settings_are_refused() -> None:
    for bad in (
        {"method": "euler"},
        {"steps": 0},
        {"steps": 1001},
        {"stop_step": -1},
        {"spacing": 0.5},
        {"temperature": 2},
        {"cutoff_hz": 15},
        {"noisy_cutoff_hz": 0},
        {"video_cutoff_hz": -1},
    ):
        with pytest.raises(ValueError, match="SamplerConfig"):
            SamplerConfig(**bad)  # type: ignore[arg-type]


def test_noisier_keyframes_are_low_passed_lower() -> None:
    config = SamplerConfig(cutoff_hz=6.0, noisy_cutoff_hz=3.0)
    assert config.cutoff_for(0.0) == config.cutoff_for(0.01) == 6.0
    assert config.cutoff_for(1.0) == 3.0
    assert config.cutoff_for(4.0) == 1.5
    assert config.cutoff_for(0.0, of_video=True) == config.video_cutoff_hz


def test_noise_steps_are_not_repeated() -> None:
    assert all(a > b for a, b in pairwise(time_steps(1000, 37, stop_step=20, spacing=3.0)))
