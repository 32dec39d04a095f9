"""How large errors of joined keyframes are, and what noise of keyframes does to features; measured before training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from torch import Tensor

from scenemi.features import BODY_ROTATIONS, FEATURE_COUNT, JOINTS, ROOT_ROTATION, TRANSLATION, Statistics
from scenemi.model.base import join_keyframes
from scenemi.model.conditions import since_and_until
from scenemi.model.denoiser import MAX_FRAMES
from scenemi.model.heading import headings, to_heading, view
from scenemi.training.batches import Batch
from scenemi.training.noise import noisy_features

_MIN_VIEW = 0.1
"""Least deviation of an input, as `scenemi.features.MIN_STD` of 6D entries."""
_SMOOTHING = 3
"""Distances averaged over: far ones are rare."""


def measure_scales(
    batches: Sequence[Batch], statistics: Statistics, rest_joints_m: Float[Tensor, "bodies 22 3"]
) -> dict[str, Tensor]:
    """Tables for `Denoiser.set_scales`, from batches that training never reaches."""
    mean, std = torch.from_numpy(statistics.mean), torch.from_numpy(statistics.std)
    triples, views = [], []
    noise = torch.zeros(2, FEATURE_COUNT)
    generator = torch.Generator().manual_seed(0)
    for batch in batches:
        x = batch.features
        curve = join_keyframes(x, batch.mask)
        triples.append((x, curve, batch.mask))
        views.append(view(curve, headings(curve)).flatten(0, 1))
        turn = (torch.pi / 180) * torch.randn(*x.shape[:2], 22, 3, generator=generator)
        shift = 0.01 * torch.randn(*x.shape[:2], 3, generator=generator)
        for row, (turns, shifts) in enumerate(((turn, 0 * shift), (0 * turn, shift))):
            moved = noisy_features(x, rest_joints_m[batch.body], turns, shifts) - x
            noise[row] += moved.square().mean((0, 1)) / len(batches)
    every, size = torch.cat(views), residual_size(triples)
    return {
        "residual_std": size / std,
        "correlate": correlation(triples, std),
        "noise_std": noise.sqrt() / std,
        "view_mean": every.mean(0),
        "view_std": every.std(0).clamp(min=_MIN_VIEW),
        "feature_mean": mean,
        "feature_std": std,
    }


def residual_size(drawn: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Float[Tensor, "distances 201"]:
    """How far the truth is from a curve through the keyframes, by frames from the nearest one (0 to `MAX_FRAMES`): RMS
    of each feature in the heading of the curve, meters and 6D entries.

    Args:
        drawn: truth and curve (B, N, 201), denormalized, and mask (B, N) of batches.
    """
    total = torch.zeros(MAX_FRAMES + 1, FEATURE_COUNT, dtype=torch.float64)
    count = torch.zeros(MAX_FRAMES + 1, dtype=torch.float64)
    for truth, curve, mask in drawn:
        off = to_heading(truth - curve, headings(curve)).double().square().flatten(0, 1)
        distance = since_and_until(mask).amin(-1).clamp(max=MAX_FRAMES).flatten()
        total.index_add_(0, distance, off)
        count.index_add_(0, distance, torch.ones(len(distance), dtype=torch.float64))
    seen = torch.nonzero(count > 0)[:, 0]
    size = _pooled((total[seen] / count[seen, None]).numpy())
    grid = np.arange(MAX_FRAMES + 1)
    filled = np.stack([np.interp(grid, seen.numpy(), column) for column in size.T], 1)
    smooth = uniform_filter1d(filled, _SMOOTHING, axis=0, mode="nearest")
    smooth[0] = 0.0
    return torch.from_numpy(smooth).float()


def correlation(
    drawn: Sequence[tuple[Tensor, Tensor, Tensor]], std: Float[Tensor, "201"]
) -> Float[Tensor, "frames frames"]:
    """Symmetric root of the correlation over time of what joined keyframes miss: the same for all features and places
    in a window. Products are averaged, so the long gaps, where most is missed, decide.

    Args:
        drawn: as of `residual_size`.
        std: of the features.
    """
    frames = drawn[0][0].shape[1]
    product = torch.zeros(frames, dtype=torch.float64)
    for truth, curve, _ in drawn:
        off = to_heading(truth - curve, headings(curve)).double() / std
        spectrum = torch.fft.rfft(off, 2 * frames, dim=1).abs().square().sum((0, 2))
        product += torch.fft.irfft(spectrum)[:frames]
    lag = torch.arange(frames)
    by_lag = product / product[0] * frames / (frames - lag)
    values, vectors = torch.linalg.eigh(by_lag[(lag[:, None] - lag).abs()])
    root = (vectors * values.clamp(min=0).sqrt()) @ vectors.T
    return (root / root.norm(dim=1, keepdim=True)).float()


def _pooled(square: Float[np.ndarray, "distances 201"]) -> np.ndarray:
    """RMS in which half of each column's square is its own and half that of all columns of its kind (translation, root
    orientation, rotations, joints): what hardly moved in the windows seen may move in others."""
    pooled = square.copy()
    for kind in (TRANSLATION, ROOT_ROTATION, BODY_ROTATIONS, JOINTS):
        pooled[:, kind] = 0.5 * square[:, kind] + 0.5 * square[:, kind].mean(1, keepdims=True)
    return np.sqrt(pooled)
