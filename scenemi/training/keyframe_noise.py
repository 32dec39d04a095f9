"""How large the noise of keyframes is in each feature."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scenemi.data.windows import MotionSet, WindowBatch
from scenemi.features import LEVEL_X, LEVEL_Z, to_canonical
from scenemi.training.losses import features_of, noisy_features

_WINDOWS = 128


def with_noise(
    windows: WindowBatch, motions: MotionSet, rng: np.random.Generator
) -> tuple[Float[Tensor, "batch frames 201"], Float[Tensor, "batch frames 201"]]:
    """Features of windows in their canonical frames, and what noise of l = 1 (paper 3.2.1) adds to them."""
    R, translation_m = to_canonical(windows.R_parent_joint, windows.translation_m)
    count, frames = translation_m.shape[:2]
    pose = torch.from_numpy(R.astype(np.float32)), torch.from_numpy(translation_m.astype(np.float32))
    rest = torch.from_numpy(motions.rest_joints_m[windows.body_index])
    turn = torch.from_numpy(rng.standard_normal((count, frames, 22, 3), np.float32))
    shift = torch.from_numpy(rng.standard_normal((count, frames, 3), np.float32))
    x0 = features_of(*pose, rest)
    return x0, noisy_features(*pose, rest, torch.ones(count), turn, shift) - x0


def measured_noise(motions: MotionSet, seed: int) -> Float[Tensor, "201"]:
    """Standard deviation that noise of l = 1 (paper 3.2.1) has in each feature, over windows as they are drawn: metres
    and 6D entries. x and z are alike, as no heading is preferred."""
    rng = np.random.default_rng([seed, 0x401E])
    _, noise = with_noise(motions.sample_batch(rng, _WINDOWS), motions, rng)
    square = noise.square().mean((0, 1))
    square[LEVEL_X] = square[LEVEL_Z] = (square[LEVEL_X] + square[LEVEL_Z]) / 2
    return square.sqrt()
