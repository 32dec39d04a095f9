"""The forward process: cosine schedule and noising (Nichol & Dhariwal 2021; paper Table 5)."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

STEPS = 1000
"""T of the paper."""
_OFFSET = 0.008
"""Nichol and Dhariwal 2021, section 3.2, as `_MAX_BETA`."""
_MAX_BETA = 0.999
"""Largest share of noise in a step."""


class CosineSchedule:
    """Share of signal left after each step: `alpha_bar[t]` for t = 0 (clean) to T."""

    def __init__(self, steps: int = STEPS) -> None:
        def share(t: float) -> float:
            return math.cos((t / steps + _OFFSET) / (1 + _OFFSET) * math.pi / 2) ** 2

        beta = np.array([min(1 - share(t + 1) / share(t), _MAX_BETA) for t in range(steps)])
        self.steps = steps
        self.beta: Float[np.ndarray, "steps_and_one"] = np.concatenate([[0.0], beta])
        """`beta[t]` of step t; `beta[0]` is not used."""
        self.alpha_bar: Float[np.ndarray, "steps_and_one"] = np.concatenate([[1.0], np.cumprod(1 - beta)])

    def add_noise(
        self, x0: Float[Tensor, "batch frames 201"], t: Int[Tensor, "batch"], noise: Float[Tensor, "batch frames 201"]
    ) -> Float[Tensor, "batch frames 201"]:
        """x_t = sqrt(alpha_bar_t) x_0 + sqrt(1 - alpha_bar_t) noise."""
        alpha_bar = torch.as_tensor(self.alpha_bar, dtype=x0.dtype, device=x0.device)[t][:, None, None]
        return alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * noise
