"""From noise to motion: DDPM, DDIM and DPM-Solver++ over any denoiser that predicts the clean window (paper 3.2).

Keyframes are imputed into what the denoiser sees, x' = m s + (1 - m) x_t, while t > T* (paper 3.2.1). The chain itself
is not imputed: at the step where imputation ends, the keyframe rows are as noisy as all others, which is what the
denoiser was trained on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from scenemi.model.conditions import Conditions, impute
from scenemi.model.diffusion import STEPS, CosineSchedule
from scenemi.prior import DEFAULT_STOP_STEP
from video2anim.types.clip import FPS

Method = Literal["ddpm", "ddim", "dpm-solver++"]


class Denoise(Protocol):
    """A denoiser, or anything called alike."""

    def __call__(self, x: Tensor, t: Tensor, given: Conditions, estimate: Tensor | None, prepared: Any, /) -> Tensor:
        """Estimate of the clean window from x_t, the conditions, the last estimate, and what `prepare` made."""
        ...

    def prepare(self, given: Conditions) -> Any:
        """What all steps have in common."""
        ...

    def center(self, given: Conditions) -> Tensor:
        """What the forward process is about: x_t = center + sqrt(alpha_bar) (x_0 - center) + sqrt(1 - alpha_bar) n."""
        ...

    def noise(self, white: Tensor, prepared: Any) -> Tensor:
        """n of the forward process from independent unit Gaussians."""
        ...


Steer = Callable[[Tensor, int], Tensor]
"""Changes the estimate of the clean window at one step."""
Predict = Callable[[Tensor, int], Tensor]
"""Estimate of the clean window at one step."""


@dataclass(frozen=True, slots=True)
class SamplerConfig:
    """How windows are sampled."""

    method: Method = "dpm-solver++"
    steps: int = 1
    """Evaluations of the denoiser. One, at T, is the expected motion, the same for every seed: the least error, and the
    least shaking. More make samples that differ (20 are enough); the schedule's T (1000) is the paper's sampler."""
    guidance_weight: float = 1.0
    """w of classifier-free guidance on the scene (paper: 2.5); 1 = none, at half the cost."""
    stop_step: int | None = None
    """T*: keyframes are imputed while t > T*. None = 20 for noisy keyframes, 0 for exact ones."""
    temperature: float = 0.3
    """Size of the noise that sampling starts from (and adds); 1 = as varied as the data (the paper). Less gives motions
    nearer to the expected one: smaller error, less detail, samples that differ less. Chosen on validation clips."""
    hard_keyframes: bool = True
    """Exact keyframes are met to 1e-6 (`scenemi.model.keyframe_fit`); noisy ones never are, save the seed frames."""
    spacing: float = 1.5
    """Power by which steps are denser near t = 0, where detail is made; 1 = even."""

    cutoff_hz: float = 6.0
    """The motion is low-passed here before keyframes are met exactly: the network answers up to 6.6 Hz, above are the
    joins of curves and tokens. From 4 to 8 Hz the error changes by at most 0.005 and skating by 0.006; above 8 Hz
    motion shakes more than the truth (`benchmarks/scenemi/choices.py sampler --every 2`)."""
    noisy_cutoff_hz: float = 3.5
    """The same for keyframes with independent noise of level 1, where it is lower: the frequency above which such noise
    is stronger than motion, whose power falls with about the fourth power of the frequency, is inverse to the square
    root of the level (the same command; error 1.95 -> 1.75 cm at level 1, 1.07 -> 1.04 cm at 0.5)."""
    video_cutoff_hz: float = 5.0
    """The same for keyframes with errors by frame, as of a video (the same command with `--errors`). At 4 Hz
    accelerations err less still, but motion has less than 0.7 of the truth's jerk (`tests/test_v2a_bench.py`)."""

    def __post_init__(self) -> None:
        if self.method not in ("ddpm", "ddim", "dpm-solver++"):
            raise ValueError(f"SamplerConfig: want ddpm, ddim or dpm-solver++, got {self.method!r}")
        for name in ("cutoff_hz", "noisy_cutoff_hz", "video_cutoff_hz"):
            if not 0 < (hz := getattr(self, name)) < 0.5 * FPS:
                raise ValueError(f"SamplerConfig: want a {name} over 0 and under {0.5 * FPS:g}, got {hz}")
        if not 1 <= self.steps <= STEPS or self.spacing < 1:
            raise ValueError(
                f"SamplerConfig: want 1 to {STEPS} steps and spacing >= 1, got {self.steps} and {self.spacing}"
            )
        if not 0 <= self.temperature <= 1:
            raise ValueError(f"SamplerConfig: want temperature from 0 to 1, got {self.temperature}")
        if self.stop_step is not None and self.stop_step < 0:
            raise ValueError(f"SamplerConfig: want stop_step >= 0, got {self.stop_step}")

    def cutoff_for(self, noise_level: float, of_video: bool = False) -> float:
        """Hz, for keyframes with independent noise of this level, or with the errors of a video."""
        if of_video:
            return self.video_cutoff_hz
        return min(self.cutoff_hz, self.noisy_cutoff_hz / math.sqrt(noise_level)) if noise_level > 0 else self.cutoff_hz

    def stop_for(self, noisy: bool) -> int:
        """T* of a window."""
        return self.stop_step if self.stop_step is not None else DEFAULT_STOP_STEP if noisy else 0


def time_steps(total: int, steps: int, *, stop_step: int = 0, spacing: float = 1.0) -> Int[np.ndarray, "steps_and_one"]:
    """Falling steps from T to 0 at which the denoiser is evaluated (the last, 0, is not).

    With `steps` = T all of them. With fewer, step T* is one of them and at least one in ten (two, where there are more
    than four) lies at or below it, since there the keyframes themselves are cleaned.
    """
    if steps >= total:
        return np.arange(total, -1, -1)
    stop = min(stop_step, total - 1)
    if stop == 0:
        return _falling(total, 0, steps, spacing)
    low = min(stop, max(1, round(0.1 * steps), 2 if steps > 4 else 1), steps)
    if low == steps:
        return _falling(total, 0, steps, spacing)
    # One curve from T to 0, cut where T* lies on it, keeps steps near T* equally long on both sides.
    high = _falling(total - stop, 0, steps - low, spacing) + stop
    return np.concatenate([high[:-1], _falling(stop, 0, low, 1.0)])


def _falling(top: int, bottom: int, pieces: int, spacing: float) -> Int[np.ndarray, "pieces_and_one"]:
    """`pieces` + 1 falling integers, all different, dense at the bottom."""
    pieces = min(pieces, top - bottom)
    curve = bottom + (top - bottom) * np.linspace(1.0, 0.0, pieces + 1) ** spacing
    whole = np.rint(curve).astype(np.int64)
    least = bottom + np.arange(pieces, -1, -1)
    return np.maximum(whole, least)


def sample(
    denoiser: Denoise,
    schedule: CosineSchedule,
    x_keys: Float[Tensor, "batch frames features"],
    conditions: Conditions,
    config: SamplerConfig,
    generators: Sequence[torch.Generator],
    *,
    stop_step: int = 0,
    steer: Steer | None = None,
) -> Float[Tensor, "batch frames features"]:
    """Windows from noise.

    Args:
        denoiser: predicts clean windows.
        schedule: forward process it was trained with.
        x_keys: normalized features; rows with `conditions.imputed` = 1 are the keyframes, others are not read.
        conditions: of the batch.
        config: method and steps.
        generators: one per window, so that a window's result does not depend on its neighbors in the batch.
        stop_step: T*.
        steer: applied to every estimate after the guidance.
    """
    center, prepared = denoiser.center(conditions), denoiser.prepare(conditions)

    def noise() -> Tensor:
        white = torch.stack([_noise(x_keys, generator) for generator in generators])
        return config.temperature * denoiser.noise(white, prepared)

    steps = time_steps(schedule.steps, config.steps, stop_step=stop_step, spacing=config.spacing)
    with torch.no_grad():
        clean = guided(denoiser, x_keys, conditions, config.guidance_weight, stop_step, prepared, steer)

        def predict(residual: Tensor, t: int) -> Tensor:
            return clean(center + residual, t) - center

        if config.method == "dpm-solver++":
            return center + _dpm_solver(predict, noise(), schedule.alpha_bar, steps, stop_step)
        eta = 1.0 if config.method == "ddpm" else 0.0
        return center + _ancestral(predict, noise, schedule.alpha_bar, steps, eta)


def guided(
    denoiser: Denoise,
    x_keys: Tensor,
    conditions: Conditions,
    weight: float,
    stop_step: int,
    prepared: Any = None,
    steer: Steer | None = None,
) -> Predict:
    """The clean estimate as a function of x_t and t alone: imputation, guidance.

    x0 = w D(scene) + (1 - w) D(no scene); the first alone where w is 1 or no scene is given. Each estimate is handed
    to the next step, where the scene is asked along it; at the first step the denoiser is evaluated again with its own
    answer (1 % less error at 60 frames on validation clips, in scenes and without). `prepared`: of the conditions,
    where it is at hand.
    """
    batch = len(x_keys)
    blind = conditions.without_scene() if weight != 1 and conditions.has_scene else None
    both = [(conditions, denoiser.prepare(conditions) if prepared is None else prepared)]
    both += [(blind, denoiser.prepare(blind))] if blind is not None else []
    estimate: Tensor | None = None

    def predict(x: Tensor, t: int) -> Tensor:
        nonlocal estimate
        imputed = conditions.imputed if t > stop_step else torch.zeros_like(conditions.mask)
        seen, steps = impute(x, x_keys, imputed), torch.full((batch,), t, device=x.device)
        # There is no estimate yet at the first step: it is taken twice.
        for _ in range(2 if estimate is None else 1):
            x0, *without = (
                denoiser(seen, steps, replace(given, imputed=imputed), estimate, prepared) for given, prepared in both
            )
            if without:
                x0 = weight * x0 + (1 - weight) * without[0]
            estimate = x0 if steer is None else steer(x0, t)
        assert estimate is not None
        return estimate

    return predict


def posterior(alpha_bar_t: float, alpha_bar_s: float, eta: float) -> tuple[float, float, float]:
    """Weights of x_0 and of x_t in the mean of x_s, and its standard deviation, for a step from t down to s.

    eta = 1 is DDPM's posterior with the variance beta~ = (1 - alpha_bar_s) / (1 - alpha_bar_t) beta (paper Table 5);
    eta = 0 is DDIM (Song et al. 2021, eq. 12).
    """
    beta = 1 - alpha_bar_t / alpha_bar_s
    deviation = eta * math.sqrt((1 - alpha_bar_s) / (1 - alpha_bar_t) * beta)
    of_noise = math.sqrt(max(1 - alpha_bar_s - deviation**2, 0.0)) / math.sqrt(1 - alpha_bar_t)
    return math.sqrt(alpha_bar_s) - math.sqrt(alpha_bar_t) * of_noise, of_noise, deviation


def _ancestral(
    predict: Predict, noise: Callable[[], Tensor], alpha_bar: np.ndarray, steps: np.ndarray, eta: float
) -> Tensor:
    x = noise()
    for t, s in pairwise(steps):
        x0 = predict(x, int(t))
        of_clean, of_noisy, deviation = posterior(float(alpha_bar[t]), float(alpha_bar[s]), eta)
        x = of_clean * x0 + of_noisy * x
        if deviation > 0:
            x = x + deviation * noise()
    return x


def _dpm_solver(predict: Predict, x: Tensor, alpha_bar: np.ndarray, steps: np.ndarray, stop_step: int) -> Tensor:
    """DPM-Solver++(2M) in the form that predicts x_0 (Lu et al. 2022, algorithm 2).

    The estimate has a jump where imputation ends, and no slope is taken over it; the last step is of first order.
    """
    before: Tensor | None = None
    h_before = 0.0
    for t, s in pairwise(steps):
        x0 = predict(x, int(t))
        if s == 0:
            return x0
        ab_t, ab_s = float(alpha_bar[t]), float(alpha_bar[s])
        h = 0.5 * (math.log(ab_s / (1 - ab_s)) - math.log(ab_t / (1 - ab_t)))
        slope = x0
        if before is not None and t != stop_step:
            ratio = h / (2 * h_before)
            slope = (1 + ratio) * x0 - ratio * before
        x = math.sqrt((1 - ab_s) / (1 - ab_t)) * x - math.sqrt(ab_s) * math.expm1(-h) * slope
        before, h_before = x0, h
    return x


def _noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Noise of one window, drawn on the CPU so that every device gives the same motion."""
    return torch.randn(like.shape[1:], generator=generator, dtype=torch.float32).to(like)
