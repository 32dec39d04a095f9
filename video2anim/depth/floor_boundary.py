"""Where the floor ends and something upright begins, per plumb column of a picture (Hoiem et al. 2005, simplified).

The floor's look is learned from places where feet stood; everything else is told apart from it by color and
texture, by edges, and by the wish for a boundary without needless jumps. The best boundary is found exactly by
dynamic programming, and its uncertainty from the min-marginals of the same energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import gaussian_filter, gaussian_filter1d

_COLOR_BINS = 16
_TEXTURE_BINS = 12


@dataclass(frozen=True, slots=True)
class BoundaryConfig:
    """Weights of the energy, in nats."""

    rounds: int = 3
    """Times that the looks of floor and not-floor are learned again."""
    pixel_weight: float = 0.25
    """Share of a pixel's log-likelihood ratio that counts: neighboring pixels repeat each other."""
    ratio_limit: float = 3.0
    """Largest log-likelihood ratio of a pixel."""
    evidence_needed: float = 0.7
    """Log-likelihood ratio at which a pixel beyond the standing places counts neither way: what merely could be floor
    is not taken for it."""
    near_bonus: float = 1.0
    """So much less is needed of pixels nearer than the standing places: there is mostly floor in front of people."""
    edge_weight: float = 4.0
    """Gain of a boundary on the strongest edges."""
    jump_weight: float = 0.6
    """Cost of a step of one row between neighboring columns."""
    jump_limit: float = 6.0
    """Cost of any larger jump, as where an object begins."""


@dataclass(frozen=True, slots=True, eq=False)
class FloorBoundary:
    """Rows at and below `row` are floor."""

    row: Int[np.ndarray, "columns"]
    """First floor row; `rows` of the picture where a column shows no floor."""
    sigma_rows: Float[np.ndarray, "columns"]
    log_ratio: Float[np.ndarray, "rows columns"]
    """Log-likelihood ratio floor : not floor, by look alone."""


def find_floor_boundary(
    image_rgb: UInt8[np.ndarray, "rows columns 3"],
    seen: Bool[np.ndarray, "rows columns"],
    seed: Bool[np.ndarray, "rows columns"],
    first_row: int,
    horizon_row: int,
    config: BoundaryConfig,
) -> FloorBoundary:
    """Boundary of the floor in a cylinder picture.

    Args:
        image_rgb: the picture on the cylinder (columns are plumb).
        seen: nodes that the picture shows.
        seed: nodes known to be floor.
        first_row: no floor is considered above this row.
        horizon_row: rows above it are certainly not floor.

    Raises:
        ValueError: no seed lies in the seen part.
    """
    seed = seed & seen
    if not seed.any():
        raise ValueError("find_floor_boundary: no floor seed inside the picture")
    codes, gradient = image_codes(image_rgb)
    rows = np.arange(image_rgb.shape[0])[:, None]
    floor = seed
    other = seen & (rows < min(max(horizon_row - 1, 1), first_row + 1))
    if not other.any():
        other = seen & (rows <= np.argmax(seen, axis=0)[None, :] + 2) & ~seed
    boundary = np.zeros(image_rgb.shape[1], dtype=np.int64)
    sigma = np.zeros(image_rgb.shape[1])
    log_ratio = np.zeros(image_rgb.shape[:2])
    seed_rows = np.flatnonzero(seed.any(1))
    center, lowest = float(np.median(seed_rows)), float(seed_rows[-1])
    nearness = np.clip((rows - center) / max(lowest - center, 1.0), 0, 1)
    needed = config.evidence_needed - config.near_bonus * nearness
    for _ in range(config.rounds):
        log_ratio = look_log_ratio(codes, floor, other, seed, config.ratio_limit, picture=seen & ~seed)
        evidence = np.where(seed, 2 * config.ratio_limit, log_ratio - needed)
        unary = _column_costs(evidence, gradient, seen, first_row, config)
        boundary, sigma = best_path(unary, config)
        floor = seed | (seen & (rows >= boundary[None, :]) & (log_ratio > needed))
        other = seen & (rows < boundary[None, :])
        if not other.any() or not floor.any():
            break
    return FloorBoundary(boundary, sigma, log_ratio)


def image_codes(image_rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Codes (rows, columns, 2) of color and texture, and strength of horizontal edges in [0, 1]."""
    lab = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2LAB).astype(np.float32)
    smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
    bins = (smooth / 256.0 * _COLOR_BINS).astype(np.int64)
    color = (bins[..., 0] * _COLOR_BINS + bins[..., 1]) * _COLOR_BINS + bins[..., 2]
    detail = cv2.GaussianBlur(((lab - smooth) ** 2).sum(-1), (0, 0), 2.0)
    texture = np.clip(np.log2(detail + 0.25) + 2, 0, _TEXTURE_BINS - 1).astype(np.int64)
    vertical = np.abs(cv2.Sobel(cv2.GaussianBlur(lab, (0, 0), 1.5), cv2.CV_32F, 0, 1, ksize=3)).sum(-1)
    strongest = max(float(np.percentile(vertical, 98)), 8.0)
    return np.stack([color, texture], -1), np.clip(vertical / strongest, 0, 1)


def look_log_ratio(
    codes: np.ndarray,
    floor: np.ndarray,
    other: np.ndarray,
    seed: np.ndarray,
    limit: float,
    picture: np.ndarray | None = None,
) -> Float[np.ndarray, "rows columns"]:
    """Naive-Bayes log ratio; the seeds make up half of the floor's look, so that it cannot drift away from them.

    `picture` makes up a third of the other look: what is unlike the floor counts against it though it is new.
    """
    color_shape, texture_shape = (_COLOR_BINS,) * 3, (_TEXTURE_BINS,)
    ratio = np.zeros(codes.shape[:2])
    for channel, shape, width in ((0, color_shape, 0.8), (1, texture_shape, 0.8)):
        code = codes[..., channel]
        floor_look = 0.5 * _histogram(code[floor], shape, width) + 0.5 * _histogram(code[seed], shape, width)
        other_look = _histogram(code[other], shape, width)
        if picture is not None and picture.any():
            other_look = (2 * other_look + _histogram(code[picture], shape, width)) / 3
        floor_eps = 0.02 / len(floor_look)
        ratio += np.log((floor_look + floor_eps) / (other_look + floor_eps))[code]
    ratio = cv2.blur(ratio, (5, 5))
    return np.clip(ratio, -limit, limit)


def _histogram(codes: np.ndarray, shape: tuple[int, ...], width: float) -> np.ndarray:
    counts = np.bincount(codes, minlength=int(np.prod(shape))).astype(float).reshape(shape)
    smooth = gaussian_filter(counts, width, mode="constant")
    return (smooth / max(smooth.sum(), 1e-12)).ravel()


def _column_costs(
    evidence: np.ndarray, gradient: np.ndarray, seen: np.ndarray, first_row: int, config: BoundaryConfig
) -> Float[np.ndarray, "columns candidates"]:
    """Cost of starting the floor at row b, for b in 0..rows (rows = no floor in the column)."""
    weighed = np.where(seen, evidence, 0.0) * config.pixel_weight
    above = np.concatenate([np.zeros((1, weighed.shape[1])), np.cumsum(weighed, axis=0)])
    total = above[-1:]
    cost = above - (total - above)
    edge = np.concatenate([np.where(seen, gradient, 0.0), np.zeros((1, weighed.shape[1]))])
    cost = cost - config.edge_weight * np.maximum(edge, np.roll(edge, 1, axis=0))
    cost[: max(first_row, 0)] = 1e6
    return cost.T


def best_path(unary: np.ndarray, config: BoundaryConfig) -> tuple[np.ndarray, np.ndarray]:
    """Exact minimum over paths, and the spread of the column marginals exp(-min-marginal)."""
    candidates = np.arange(unary.shape[1])
    jump = np.minimum(config.jump_weight * np.abs(candidates[:, None] - candidates[None, :]), config.jump_limit)
    forward = np.zeros_like(unary)
    backward = np.zeros_like(unary)
    for column in range(1, len(unary)):
        forward[column] = _pass_on(forward[column - 1] + unary[column - 1], jump)
    for column in range(len(unary) - 2, -1, -1):
        backward[column] = _pass_on(backward[column + 1] + unary[column + 1], jump)
    marginal = forward + unary + backward
    best = marginal.argmin(1)
    weight = np.exp(np.clip(marginal.min(1, keepdims=True) - marginal, -60, 0))
    weight /= weight.sum(1, keepdims=True)
    sigma = np.sqrt((weight * (candidates[None, :] - best[:, None]) ** 2).sum(1))
    return best, gaussian_filter1d(np.maximum(sigma, 0.5), 2.0)


def _pass_on(cost: np.ndarray, jump: np.ndarray) -> np.ndarray:
    return (cost[:, None] + jump).min(0)
