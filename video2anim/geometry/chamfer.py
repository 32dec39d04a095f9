"""Chamfer distance between point sets: robust, differentiable, nearest neighbors from a k-d tree.

Which point is nearest changes seldom during an optimization, so neighbors are looked up on the CPU every few steps
and the distances to them are differentiated every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

if TYPE_CHECKING:
    import torch

Sides = Literal["both", "source", "target"]


@dataclass(frozen=True, slots=True)
class ChamferConfig:
    """How distances are weighed."""

    huber_m: float
    """Distances above this count linearly, below quadratically. Infinite = plain squared distance."""
    sides: Sides = "both"
    """`source`: each source point to its nearest target point; `target`: the reverse; `both`: mean of the two."""
    trim_ratio: float = 0.0
    """Share of the largest distances on each side that is left out, in [0, 1)."""
    requery_every: int = 5
    """Steps between nearest-neighbor look-ups."""

    def __post_init__(self) -> None:
        if not 0 <= self.trim_ratio < 1 or self.huber_m <= 0 or self.requery_every < 1:
            raise ValueError(f"chamfer: want 0 <= trim_ratio < 1, huber_m > 0, requery_every >= 1, got {self}")


class ChamferLoss:
    """Robust Chamfer loss against a fixed target; the source moves. Keeps the last neighbors between calls."""

    def __init__(self, target_m: Float[np.ndarray, "targets 3"], config: ChamferConfig) -> None:
        self.config = config
        self._target_m = _expect_points(np.asarray(target_m, dtype=np.float64), "target_m")
        self._tree = KDTree(self._target_m)
        self._step = 0
        self._target_of_source: Int[np.ndarray, "sources"] | None = None
        self._source_of_target: Int[np.ndarray, "targets"] | None = None

    def __call__(self, source_m: torch.Tensor) -> torch.Tensor:
        """Scalar loss in m^2 for source points (S, 3)."""
        import torch

        if self._step % self.config.requery_every == 0:
            self._look_up(source_m.detach().cpu().numpy())
        self._step += 1
        target = torch.as_tensor(self._target_m, dtype=source_m.dtype, device=source_m.device)
        terms = []
        if self._target_of_source is not None:
            terms.append(self._robust_mean(source_m - target[torch.as_tensor(self._target_of_source)]))
        if self._source_of_target is not None:
            terms.append(self._robust_mean(source_m[torch.as_tensor(self._source_of_target)] - target))
        return torch.stack(terms).mean()

    def _look_up(self, source_m: np.ndarray) -> None:
        _expect_points(source_m, "source_m")
        if self.config.sides in ("both", "source"):
            self._target_of_source = np.asarray(self._tree.query(source_m)[1])
        if self.config.sides in ("both", "target"):
            self._source_of_target = np.asarray(KDTree(source_m).query(self._target_m)[1])

    def _robust_mean(self, difference_m: torch.Tensor) -> torch.Tensor:
        from video2anim.geometry.robust import huber_of_square

        square = (difference_m * difference_m).sum(-1)
        if self.config.trim_ratio > 0:
            kept = max(1, round(len(square) * (1 - self.config.trim_ratio)))
            square = square.topk(kept, largest=False).values
        return huber_of_square(square, self.config.huber_m).mean()


def chamfer_m(
    source_m: Float[np.ndarray, "sources 3"],
    target_m: Float[np.ndarray, "targets 3"],
    *,
    sides: Sides = "both",
    trim_ratio: float = 0.0,
) -> float:
    """Mean nearest-neighbor distance in meters (mean of both directions for `both`), for reports. Lower is closer."""
    source_m, target_m = _expect_points(source_m, "source_m"), _expect_points(target_m, "target_m")
    terms = []
    if sides in ("both", "source"):
        terms.append(_trimmed_mean(KDTree(target_m).query(source_m)[0], trim_ratio))
    if sides in ("both", "target"):
        terms.append(_trimmed_mean(KDTree(source_m).query(target_m)[0], trim_ratio))
    return float(np.mean(terms))


def _trimmed_mean(distance_m: np.ndarray, trim_ratio: float) -> float:
    kept = max(1, round(len(distance_m) * (1 - trim_ratio)))
    return float(np.sort(distance_m)[:kept].mean())


def _expect_points(points_m: np.ndarray, name: str) -> np.ndarray:
    if points_m.ndim != 2 or points_m.shape[1] != 3 or len(points_m) == 0:
        raise ValueError(f"chamfer {name}: want shape (N >= 1, 3), got {points_m.shape}")
    if not np.isfinite(points_m).all():
        raise ValueError(f"chamfer {name}: want finite points, got NaN or infinity; mask invalid depth first")
    return points_m
