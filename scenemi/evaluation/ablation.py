"""A trained prior with a condition taken away when it samples.

This asks what the model makes of the condition. A model trained without it (`ModelConfig.scene`) is another object, and
the tables name which of the two a row is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scenemi.model.conditions import Conditions
from scenemi.model.prior import DiffusionPrior
from scenemi.prior import KeyframeWindow


class AblatedPrior(DiffusionPrior):
    """`DiffusionPrior` that does not look at some of its conditions."""

    def __init__(self, prior: DiffusionPrior, *, use_scene: bool = True, use_body: bool = True) -> None:
        super().__init__(prior.model, prior.sampler, device=prior.device)
        self.seed = prior.seed
        self._use_scene, self._use_body = use_scene, use_body

    def _conditions(
        self, windows: list[KeyframeWindow], T_world_canonical: Float[np.ndarray, "batch 4 4"]
    ) -> tuple[Tensor, Conditions]:
        x_keys, found = super()._conditions(windows, T_world_canonical)
        if not self._use_scene:
            found = found.without_scene()
        if not self._use_body:
            found = replace(found, body=torch.zeros_like(found.body))
        return x_keys, found
