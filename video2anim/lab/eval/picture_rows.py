"""Evaluation groups of images: `background` (background image, person masks) and `depth`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.errors import ArtifactError
from video2anim.lab.eval.alignment import FrameMatch, common_maps, resample_nearest
from video2anim.lab.eval.model import Group, make_group
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import Truth
from video2anim.types import BackgroundImage, DepthClip, MetricDepth
from video2anim.types.quality import Quality

BACKGROUND = (
    Quality("psnr", math.nan, "dB", "higher"),
    Quality("error", math.nan, "/255", "lower"),
    Quality("error_behind", math.nan, "/255", "lower"),
    Quality("mask_iou", math.nan, "ratio", "higher"),
)
DEPTH = (
    Quality("abs_rel", math.nan, "ratio", "lower"),
    Quality("delta1", math.nan, "ratio", "higher"),
    Quality("abs_rel_person", math.nan, "ratio", "lower"),
    Quality("delta1_person", math.nan, "ratio", "higher"),
    Quality("covered", math.nan, "ratio", "higher"),
    Quality("covered_person", math.nan, "ratio", "higher"),
    Quality("scale_ratio", math.nan, "ratio", "near_1"),
    Quality("scale_error", math.nan, "%", "lower"),
)
_UNDEFINED = {
    "psnr": "the background image equals the truth",
    "error_behind": "nobody stands before the background in a labeled frame",
    **dict.fromkeys(("mask_iou", "covered_person"), "no sampled frame has true maps"),
    **dict.fromkeys(
        ("abs_rel", "delta1", "abs_rel_person", "delta1_person", "scale_ratio", "scale_error"), "no valid pixel"
    ),
}
_MIN_DISPARITY = 1e-3
"""Lower limit of a fitted disparity in 1/m, that is, 1 km."""
_DELTA = 1.25


def background_group(result: SceneResult, truth: Truth, frames: FrameMatch) -> Group:
    """The background image against the true one, and masks of people."""
    title = "Background image"
    background = result.get(BackgroundImage)
    if background is None:
        return make_group("background", title, BACKGROUND, {"value": result.why(BackgroundImage)})
    numbers: dict[str, float | str] = {"mask_iou": _mask_iou(background, truth, frames)}
    try:
        error = background_error(background.background_rgb, truth.background_rgb)
        behind = resample_nearest(np.asarray(truth.person_pixels.any(0)), error.shape)
        squared = float((error**2).mean())
        numbers |= {
            "psnr": 10 * float(np.log10(255**2 / squared)) if squared else np.nan,
            "error": float(error.mean()),
            "error_behind": float(error[behind].mean()) if behind.any() else np.nan,
        }
    except ArtifactError as lacking:
        numbers |= dict.fromkeys(("psnr", "error", "error_behind"), str(lacking))
    return make_group("background", title, BACKGROUND, {"value": numbers}, undefined=_UNDEFINED)


def background_error(
    background_rgb: UInt8[np.ndarray, "height width 3"], true_rgb: UInt8[np.ndarray, "true_height true_width 3"]
) -> Float[np.ndarray, "height width"]:
    """Per pixel, root mean square difference over the channels, in 8-bit steps, at the size of the true image."""
    height, width = true_rgb.shape[:2]
    if background_rgb.shape != true_rgb.shape:
        background_rgb = cv2.resize(background_rgb, (width, height), interpolation=cv2.INTER_AREA)
    return np.sqrt(((background_rgb.astype(np.float64) - true_rgb) ** 2).mean(-1))


def _mask_iou(background: BackgroundImage, truth: Truth, frames: FrameMatch) -> float:
    """Mean mask IoU over common frames in which a person is visible; all people as one mask."""
    overlaps = []
    person_pixels = truth.person_pixels
    for row, true_row in common_maps(background.frame_index, truth, frames):
        true = person_pixels[true_row]
        if true.any():
            estimated = resample_nearest(background.person_mask[row], true.shape)
            overlaps.append(mask_iou(estimated, true))
    return float(np.mean(overlaps)) if overlaps else np.nan


def mask_iou(a: Bool[np.ndarray, "height width"], b: Bool[np.ndarray, "height width"]) -> float:
    """Intersection over union; NaN if both are empty."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Estimated and true depth at the pixels that have both, and the shares of pixels with an estimate."""

    background: tuple[np.ndarray, np.ndarray]
    person: tuple[np.ndarray, np.ndarray]
    covered: float
    covered_person: float


def depth_group(result: SceneResult, truth: Truth, frames: FrameMatch) -> Group:
    """Depth after a fit of scale and offset (column `depth`), and metric depth without a fit (column `metric`)."""
    columns: dict[str, dict[str, float | str] | str] = {}
    relative, metric = result.get(DepthClip), result.get(MetricDepth)
    note = ""
    if relative is None:
        columns["fitted"] = result.why(DepthClip)
    else:
        pairs = _pairs(
            relative.value, relative.valid, relative.background_value, relative.background_valid,
            relative.frame_index, truth, frames,
        )  # fmt: skip
        columns["fitted"] = _depth_numbers(_fitted(pairs, relative.kind == "disparity"), fitted=True)
        note = f"{relative.provider}, {relative.kind}."
    if metric is None:
        columns["metric"] = result.why(MetricDepth)
    else:
        pairs = _pairs(
            metric.depth_m, metric.valid, metric.background_depth_m, metric.background_valid, metric.frame_index,
            truth, frames,
        )  # fmt: skip
        columns["metric"] = _depth_numbers(pairs, fitted=False)
        note += "" if metric.trusted else f" Metric depth is not trusted: {metric.reason}."
    return make_group("depth", "Depth", DEPTH, columns, undefined=_UNDEFINED, note=note.strip())


def _pairs(
    value: np.ndarray,
    valid: np.ndarray,
    background: np.ndarray,
    background_valid: np.ndarray,
    frame_index: np.ndarray,
    truth: Truth,
    frames: FrameMatch,
) -> _Pairs:
    shape = truth.background_depth_m.shape
    true_m = truth.background_depth_m
    known = true_m > 0
    kept = known & resample_nearest(background_valid, shape)
    estimated, true, covered, all_px = [], [], 0, 0
    person_pixels = truth.person_pixels
    for row, true_row in common_maps(frame_index, truth, frames):
        person = person_pixels[true_row] & (truth.depth_mm[true_row] > 0)
        seen = person & resample_nearest(valid[row], shape)
        estimated.append(resample_nearest(value[row], shape)[seen])
        true.append(truth.depth_mm[true_row][seen] / 1000)
        covered, all_px = covered + int(seen.sum()), all_px + int(person.sum())
    empty = np.zeros(0)
    return _Pairs(
        background=(resample_nearest(background, shape)[kept].astype(np.float64), true_m[kept].astype(np.float64)),
        person=(
            np.concatenate([empty, *estimated]).astype(np.float64),
            np.concatenate([empty, *true]).astype(np.float64),
        ),
        covered=float(kept.sum() / max(1, known.sum())),
        covered_person=covered / all_px if all_px else np.nan,
    )


def _fitted(pairs: _Pairs, disparity: bool) -> _Pairs:
    """Metric depth by one scale and offset, fitted over background and people by least squares."""
    value = np.concatenate([pairs.background[0], pairs.person[0]])
    true_m = np.concatenate([pairs.background[1], pairs.person[1]])
    if not len(value):
        return pairs
    scale, offset = fit_scale_offset(value, 1 / true_m if disparity else true_m)

    def metric(values: np.ndarray) -> np.ndarray:
        found = scale * values + offset
        return 1 / np.maximum(found, _MIN_DISPARITY) if disparity else found

    background, person = (metric(pairs.background[0]), pairs.background[1]), (metric(pairs.person[0]), pairs.person[1])
    return _Pairs(background, person, pairs.covered, pairs.covered_person)


def fit_scale_offset(value: Float[np.ndarray, "pixels"], target: Float[np.ndarray, "pixels"]) -> tuple[float, float]:
    """Least-squares scale and offset with scale * value + offset = target; scale 0 for a constant value."""
    spread = value - value.mean()
    variance = float(spread @ spread)
    scale = float(spread @ (target - target.mean())) / variance if variance > 0 else 0.0
    return scale, float(target.mean() - scale * value.mean())


def _depth_numbers(pairs: _Pairs, *, fitted: bool) -> dict[str, float | str]:
    background, person = depth_errors(*pairs.background), depth_errors(*pairs.person)
    numbers: dict[str, float | str] = {
        "abs_rel": background[0],
        "delta1": background[1],
        "abs_rel_person": person[0],
        "delta1_person": person[1],
        "covered": pairs.covered,
        "covered_person": pairs.covered_person,
    }
    if fitted:
        return numbers | dict.fromkeys(("scale_ratio", "scale_error"), "the scale was fitted to the truth")
    estimated, true = (np.concatenate([a, b]) for a, b in zip(pairs.background, pairs.person, strict=True))
    ratio = float(np.median(estimated / true)) if len(estimated) else np.nan
    return numbers | {"scale_ratio": ratio, "scale_error": 100 * abs(ratio - 1)}


def depth_errors(estimated_m: Float[np.ndarray, "pixels"], true_m: Float[np.ndarray, "pixels"]) -> tuple[float, float]:
    """AbsRel, the mean of |estimate - truth| / truth, and delta1, the share of pixels within a factor of 1.25."""
    if not len(estimated_m):
        return float("nan"), float("nan")
    abs_rel = float((np.abs(estimated_m - true_m) / true_m).mean())
    return abs_rel, float(((estimated_m < _DELTA * true_m) & (true_m < _DELTA * estimated_m)).mean())
