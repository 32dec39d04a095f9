"""Keyframes joined by local cubic curves: what the denoiser corrects."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def join_keyframes(
    keys: Float[Tensor, "batch frames channels"], mask: Float[Tensor, "batch frames"]
) -> Float[Tensor, "batch frames channels"]:
    """Every channel by cubic Hermite pieces, tangents from the keyframes before and after (parabola through three
    unevenly spaced values). Exact at keyframes; constant before the first and after the last one.

    Args:
        keys: values; rows that are no keyframes are not read, so long as they are finite.
        mask: 1 at keyframes, at least one in each row.
    """
    return joining_matrix(mask).to(keys.dtype) @ (keys * mask[..., None])


def joining_matrix(mask: Float[Tensor, "batch frames"]) -> Float[Tensor, "batch frames frames"]:
    """`join_keyframes` as a matrix: it is linear in the values, only the mask decides."""
    batch, frames = mask.shape
    index = torch.arange(frames, device=mask.device).expand(batch, frames)
    given = mask > 0
    low = torch.where(given, index, -1).cummax(1).values
    high = torch.where(given, index, frames).flip(1).cummin(1).values.flip(1)
    low, high = torch.where(low < 0, high, low), torch.where(high >= frames, low, high)
    # The keyframe before each frame's `low` and the one after its `high`; themselves at the ends of the row.
    before = torch.where(low > 0, _last_before(given, index).gather(1, low), low)
    after = torch.where(high < frames - 1, _first_after(given, index).gather(1, high), high)

    span = (high - low).clamp(min=1).float()
    u = ((index - low).float() / span).clamp(0, 1)
    matrix = torch.zeros(batch, frames, frames, device=mask.device)

    def add(column: Tensor, value: Tensor) -> None:
        matrix.scatter_add_(2, column[..., None], value[..., None])

    add(low, 2 * u**3 - 3 * u**2 + 1)
    add(high, -2 * u**3 + 3 * u**2)
    for weight, knots in (
        ((u**3 - 2 * u**2 + u) * span, (before, low, high)),
        ((u**3 - u**2) * span, (low, high, after)),
    ):
        for column, slope in zip(knots, _slope(*knots), strict=True):
            add(column, weight * slope)
    return matrix


def _slope(before: Tensor, at: Tensor, after: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Factors of the three values in the slope at the middle one; one-sided where a neighbor is missing."""
    left, right = (at - before).float(), (after - at).float()
    total = (left + right).clamp(min=1)
    share_left = torch.where(right == 0, 1.0, right / total) * (left > 0)
    share_right = torch.where(left == 0, 1.0, left / total) * (right > 0)
    down, up = share_left / left.clamp(min=1), share_right / right.clamp(min=1)
    return -down, down - up, up


def _last_before(given: Tensor, index: Tensor) -> Int[Tensor, "batch frames"]:
    """Last keyframe strictly before each frame; the frame itself where there is none."""
    upto = torch.where(given, index, -1).cummax(1).values
    earlier = torch.cat([torch.full_like(upto[:, :1], -1), upto[:, :-1]], 1)
    return torch.where(earlier < 0, index, earlier)


def _first_after(given: Tensor, index: Tensor) -> Int[Tensor, "batch frames"]:
    frames = given.shape[1]
    return frames - 1 - _last_before(given.flip(1), index).flip(1)
