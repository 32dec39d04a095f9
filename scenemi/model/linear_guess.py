"""The best linear guess of a clean window from a noisy one: Gaussian-process regression over time.

What the joined keyframes miss is smooth in time, the noise of the diffusion is not, so most of the noise can be taken
out without knowing anything about people: with a residual r ~ N(0, s C s) of known size s and correlation C, and
y = sqrt(a) r + sqrt(1 - a) e, the mean of r given y is linear in y (Rasmussen & Williams 2006, eq. 2.23). A denoiser
that starts from this guess has only to learn what is not linear, and does not pass on noise that is white in time.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

GROUPS = 8
"""Channels with residuals of about the same size are filtered alike."""
LENGTHS = (0.5, 30.0)
"""Shortest and longest correlation length that is looked for, frames."""
_JITTER = 1e-4


def matern(apart: Tensor) -> Tensor:
    """Matern correlation of order 5/2 (twice differentiable) at distances in correlation lengths."""
    scaled = math.sqrt(5.0) * apart
    return (1 + scaled + scaled**2 / 3) * torch.exp(-scaled)


def correlation(
    span: Int[Tensor, "batch frames"], length: Float[Tensor, "spans"]
) -> Float[Tensor, "batch frames frames"]:
    """Correlation of residuals between the frames of windows.

    Args:
        span: frames from keyframe to keyframe around each frame.
        length: correlation length (frames) for each such span; between segments, time is measured in the lengths on the
            way, which keeps the matrix positive.
    """
    passed = (1 / length[span.clamp(max=len(length) - 1)]).cumsum(1)
    return matern((passed[:, :, None] - passed[:, None]).abs())


def linear_guess(
    off: Float[Tensor, "batch frames channels"],
    size: Float[Tensor, "batch frames channels"],
    alpha_bar: Float[Tensor, "batch"],
    C: Float[Tensor, "batch frames frames"],
    order: Int[Tensor, "channels"],
) -> Float[Tensor, "batch frames channels"]:
    """Mean of the residual given the noisy window, in the unit of `size`.

    Args:
        off: y = x_t - sqrt(alpha_bar) base; zero where nothing is known.
        size: s, standard deviation of the residual; zero where nothing is known or nothing is missing.
        alpha_bar: a of each window's diffusion step.
        C: correlation over time.
        order: channels sorted by their size; filtered in `GROUPS` groups.
    """
    a = alpha_bar[:, None, None]
    guess = torch.zeros_like(off)
    eye = torch.eye(off.shape[1], device=off.device)
    for channels in order.chunk(GROUPS):
        s = size[..., channels].square().mean(-1, keepdim=True).sqrt()
        root = a.sqrt() * s / (1 - a).sqrt()  # of the precision of y / s
        factor = torch.linalg.cholesky(eye * (1 + _JITTER) + root * C * root.transpose(1, 2))
        solved = torch.cholesky_solve(off[..., channels] / (1 - a).sqrt(), factor)
        guess[..., channels] = s * (C @ (root * solved))
    return guess


def fitted_length(lag_correlation: Float[Tensor, "lags"]) -> float:
    """Correlation length (frames) whose Matern curve is nearest to measured correlations at lags 1, 2, ..."""
    tried = torch.logspace(math.log10(LENGTHS[0]), math.log10(LENGTHS[1]), 200)
    lags = torch.arange(1, len(lag_correlation) + 1)
    return float(tried[(matern(lags / tried[:, None]) - lag_correlation).square().sum(1).argmin()])
