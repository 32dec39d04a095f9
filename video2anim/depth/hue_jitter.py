"""Uncertainty of a depth network: the deviation of its output over hue shifts of the image (supplement 8.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import kornia
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8


def jittered_disparity(
    predict: Callable[[UInt8[np.ndarray, "h w 3"]], np.ndarray],
    image_rgb: UInt8[np.ndarray, "h w 3"],
    hue_shifts_rad: Sequence[float],
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Mean of the disparity of an image and of its hue-shifted copies, and their standard deviation.

    Disparity is determined up to scale and offset only, so that of each copy is first fitted to that of the image.
    Pixels that are NaN in any of them are NaN.
    """
    reference = np.asarray(predict(image_rgb), dtype=np.float64)
    answers = [reference]
    known = np.isfinite(reference)
    tensor = torch.from_numpy(image_rgb).permute(2, 0, 1).float() / 255
    for shift in hue_shifts_rad:
        shifted = kornia.enhance.adjust_hue(tensor, float(shift)).clamp(0, 1)
        copy = (shifted.permute(1, 2, 0) * 255).round().byte().numpy()
        answer = np.asarray(predict(copy), dtype=np.float64)
        both = known & np.isfinite(answer)
        design = np.stack([answer[both], np.ones(int(both.sum()))], 1)
        solution = np.linalg.lstsq(design, reference[both], rcond=None)[0]
        answers.append(answer * solution[0] + solution[1])
    return np.mean(np.stack(answers), axis=0), np.std(np.stack(answers), axis=0)


def reliable(
    value: Float[np.ndarray, "h w"], sigma: Float[np.ndarray, "h w"], limit_ratio: float
) -> Bool[np.ndarray, "h w"]:
    """Pixels whose standard deviation is below a share of the range of values."""
    if not np.isfinite(value).any():
        return np.zeros(value.shape, dtype=bool)
    low, high = np.nanpercentile(value, [2, 98])
    return np.isfinite(value) & (sigma < limit_ratio * max(high - low, 1e-9))
