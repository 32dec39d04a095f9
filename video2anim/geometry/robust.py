"""Robust costs of squared residuals."""

from __future__ import annotations

import math

import torch


def huber_of_square(square: torch.Tensor, threshold: float) -> torch.Tensor:
    """Huber cost of a squared residual r^2: r^2 up to `threshold`, then 2 threshold |r| - threshold^2.

    Its unit is that of r^2. The gradient is finite at zero; an infinite threshold leaves the square as it is.
    """
    if not math.isfinite(threshold):
        return square
    limit = threshold**2
    far = 2 * threshold * torch.sqrt(torch.clamp(square, min=limit)) - limit
    return torch.where(square <= limit, square, far)
