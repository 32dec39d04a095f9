from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import make_smoothing_spline

from scenemi.model import keyframe_smoothing
from scenemi.model.keyframe_smoothing import EXACT, smooth_keyframes

TIMES = torch.arange(121) / 30


def wave(hertz: float, size_m: float) -> torch.Tensor:
    return (size_m * torch.sin(2 * np.pi * hertz * TIMES))[None, :, None].expand(1, -1, 8).clone()


def noisy(clean: torch.Tensor, deviation: float, seed: int = 0) -> torch.Tensor:
    return clean + deviation * torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))


def smooth(keys: torch.Tensor, weight: torch.Tensor, deviation: float) -> torch.Tensor:
    return smooth_keyframes(keys, weight, torch.full((len(keys), keys.shape[2]), deviation))


def every(interval: int) -> torch.Tensor:
    weight = torch.zeros(1, 121)
    weight[:, ::interval] = 1
    return weight


def rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt())


def test_what_rests_is_averaged_and_what_swings_is_kept() -> None:
    weight, at = every(3), slice(None, None, 3)
    for hertz, size_m, most in ((0.0, 0.0, 0.4), (0.3, 0.05, 0.65), (1.0, 0.5, 1.1), (4.0, 0.3, 1.1)):
        clean = wave(hertz, size_m)
        made = smooth(noisy(clean, 0.01), weight, 0.01)
        assert rms((made - clean)[:, at]) < most * 0.01, hertz
    assert float(made[0, 1].abs().max()) == 0, "only keyframes are answered"


def test_a_channel_is_smoothed_by_its_own_movement() -> None:
    clean = torch.cat([wave(0.0, 0.0), wave(4.0, 0.3)], -1)
    keys, weight = noisy(clean, 0.01), every(3)
    both = smooth(keys, weight, 0.01)
    torch.testing.assert_close(both[..., :8], smooth(keys[..., :8], weight, 0.01))
    torch.testing.assert_close(both[..., 8:], smooth(keys[..., 8:], weight, 0.01))


def test_it_is_the_cubic_smoothing_spline(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one stiffness to choose from, the same values as scipy's spline of that penalty."""
    stiffness = 30.0
    monkeypatch.setattr(keyframe_smoothing, "_STIFFNESS", torch.tensor([stiffness], dtype=torch.float64))
    weight = torch.zeros(1, 121)
    at = torch.tensor([0, 4, 5, 11, 30, 31, 60, 90, 117, 120])
    weight[0, at] = 1
    keys = noisy(wave(0.5, 0.2), 0.05)
    made = smooth(keys, weight, 1.0)
    for channel in range(3):
        spline = make_smoothing_spline(at.numpy().astype(float), keys[0, at, channel].double().numpy(), lam=stiffness)
        np.testing.assert_allclose(made[0, at, channel].numpy(), spline(at.numpy()), atol=1e-5)


def test_exact_keyframes_stay_and_carry_the_curve() -> None:
    clean = wave(0.3, 0.3)
    keys, weight = noisy(clean, 0.02), every(3)
    keys[:, :30], weight[:, :30] = clean[:, :30], EXACT
    made = smooth(keys, weight, 0.02)
    torch.testing.assert_close(made[:, :30], clean[:, :30], atol=1e-4, rtol=0)
    assert rms((made - clean)[:, 30::3]) < 0.6 * 0.02


def test_few_keyframes_are_as_given() -> None:
    weight = torch.zeros(1, 121)
    weight[0, [0, 60, 120]] = 1
    keys = noisy(wave(0.3, 0.3), 0.02)
    torch.testing.assert_close(smooth(keys, weight, 0.02), keys * weight[..., None])


def test_rows_without_a_keyframe_are_not_read_and_windows_do_not_mix() -> None:
    weight = torch.cat([every(3), every(7)])
    weight[1, -1] = 1
    keys = torch.cat([noisy(wave(0.5, 0.1), 0.01, seed) for seed in (1, 2)])
    hidden = torch.where(weight[..., None] > 0, keys, torch.nan)
    made = smooth(hidden, weight, 0.01)
    assert bool(made.isfinite().all())
    for i in range(2):
        torch.testing.assert_close(made[i : i + 1], smooth(keys[i : i + 1], weight[i : i + 1], 0.01))


def test_it_scales_with_the_noise() -> None:
    """Values and noise in other units give the same curve in those units."""
    keys, weight = noisy(wave(0.5, 0.2), 0.01), every(3)
    torch.testing.assert_close(smooth(100 * keys, weight, 1.0), 100 * smooth(keys, weight, 0.01), rtol=1e-4, atol=1e-4)
