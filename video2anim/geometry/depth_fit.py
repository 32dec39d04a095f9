"""Scale and offset of a clip's depth by Chamfer distance to bodies of known size (paper 8.1), and by the floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from video2anim.geometry.chamfer import ChamferConfig, ChamferLoss, chamfer_m, huber_of_square
from video2anim.geometry.steady_depth import fitted_line

_GROUND_BLOCKS = 12
_REACH_BINS = 12
_FACTORS = (0.7, 1.0, 1.4)
"""Starts, as multiples of the scale at which median depths agree."""


class NoScaleError(ValueError):
    """The evidence contradicts every positive scale: an answer, not a fault."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameEvidence:
    """One frame: the body in metres and the person's relative depth."""

    body_camera_m: Float[np.ndarray, "vertices 3"]
    """Visible vertices."""
    ray: Float[np.ndarray, "pixels 3"]
    """Rays of unit z-depth through the person's reliable pixels."""
    value: Float[np.ndarray, "pixels"]
    """Relative depth or disparity there."""


@dataclass(frozen=True, slots=True, eq=False)
class GroundEvidence:
    """Plate pixels that show the floor, or places on it where feet stood."""

    ray_up: Float[np.ndarray, "pixels"]
    """World height that is won along a ray of unit z-depth; negative."""
    value: Float[np.ndarray, "pixels"]
    """Relative depth or disparity there."""
    camera_height_m: float
    weight: float = 1.0
    """Weight of the mean miss of the floor beside that of the bodies."""

    @property
    def depth_m(self) -> Float[np.ndarray, "pixels"]:
        """z-depth of the floor."""
        return self.camera_height_m / np.maximum(-self.ray_up, 1e-6)

    def resampled(self, rng: np.random.Generator) -> GroundEvidence:
        """As many pixels, drawn in blocks: neighbours err together."""
        blocks = np.array_split(np.arange(len(self.value)), min(_GROUND_BLOCKS, len(self.value)))
        chosen = np.concatenate([blocks[i] for i in rng.integers(0, len(blocks), len(blocks))])
        return GroundEvidence(self.ray_up[chosen], self.value[chosen], self.camera_height_m, self.weight)


@dataclass(frozen=True, slots=True)
class DepthFit:
    """Scale and offset with standard deviations over resampled frames."""

    scale: float
    offset: float
    scale_sigma: float
    offset_sigma: float
    chamfer_before_m: float
    """With the scale that makes median depths agree, and no offset where such a scale exists."""
    chamfer_after_m: float
    ground_miss_m: float = float("nan")
    """Median height of the floor's pixels over (or under) the floor; NaN without floor."""


def evenly_far(
    pixels: Int[np.ndarray, "pixels"], reach_m: Float[np.ndarray, "all"], count: int
) -> Int[np.ndarray, "chosen"]:
    """At most `count` of the pixels, in their order, spread over near and far: of a floor most pixels are near."""
    if len(pixels) <= count:
        return pixels
    log_m = np.log(reach_m[pixels])
    edges = np.linspace(log_m.min(), log_m.max(), _REACH_BINS + 1)[1:-1]
    number = np.digitize(log_m, edges)
    size = np.bincount(number, minlength=_REACH_BINS)
    quota = np.zeros(_REACH_BINS, int)
    # Bins with few pixels give all of theirs, the others share what is left.
    for done, i in enumerate(np.argsort(size)):
        quota[i] = min(size[i], (count - quota.sum()) // (_REACH_BINS - done))
    chosen = [_spread(np.flatnonzero(number == i), quota[i]) for i in range(_REACH_BINS)]
    return pixels[np.sort(np.concatenate(chosen))]


def _spread(index: np.ndarray, count: int) -> np.ndarray:
    return index[np.linspace(0, len(index) - 1, count).round().astype(int)] if count else index[:0]


def metric_depth(kind: str, value: np.ndarray, scale: float, offset: float) -> Float[np.ndarray, "..."]:
    """Metres of relative depth or disparity; what the model sends behind the camera or beyond 1 km is NaN."""
    line = scale * np.asarray(value, dtype=np.float64) + offset
    depth_m = line if kind == "depth" else 1.0 / np.where(line > 1e-3, line, np.nan)
    return np.where((depth_m > 0.02) & (depth_m < 1e3), depth_m, np.nan)


def fit_depth(
    frames: Sequence[FrameEvidence],
    kind: str,
    *,
    with_offset: bool,
    rng: np.random.Generator,
    resamples: int = 8,
    huber_m: float = 0.1,
    trim_ratio: float = 0.1,
    ground: GroundEvidence | None = None,
) -> DepthFit:
    """The scale (and offset) of least robust Chamfer distance between bodies and lifted depth, over all frames.

    With `ground`, the height that lifted floor pixels miss the floor by counts as well, under the same robust cost; it
    may stand alone, without frames.

    Raises:
        ValueError: there is neither a frame nor ground.
        NoScaleError: no positive scale makes the medians agree.
    """
    if not frames and ground is None:
        raise ValueError("fit_depth: no frame with both body and depth, and no floor")
    line = _line_start(frames, kind, ground) if with_offset else None
    start = _median_scale(frames, kind, ground)
    if not (np.isfinite(start) and start > 0) and line is None:
        raise NoScaleError(f"fit_depth: no positive scale makes median depths agree (got {start})")
    config = ChamferConfig(huber_m=huber_m, trim_ratio=trim_ratio)
    starts = [(factor * start, 0.0) for factor in _FACTORS if np.isfinite(start) and start > 0]
    starts += [line] if line is not None else []
    solutions = [_descend(frames, kind, *at, with_offset, config, 40, ground) for at in starts]
    best = min(solutions, key=lambda found: found[2])
    scale, offset, _ = best
    spread = []
    for _ in range(resamples if len(frames) > 1 or ground is not None else 0):
        chosen = [frames[i] for i in rng.integers(0, len(frames), len(frames))] if frames else []
        floor = ground.resampled(rng) if ground is not None else None
        spread.append(_descend(chosen, kind, scale, offset, with_offset, config, 12, floor)[:2])
    deviation = np.std(spread, axis=0, ddof=1) if spread else np.array([scale, abs(offset)])
    return DepthFit(
        scale=scale,
        offset=offset,
        scale_sigma=float(deviation[0]),
        offset_sigma=float(deviation[1]),
        chamfer_before_m=mean_chamfer_m(frames, kind, *starts[0]),
        chamfer_after_m=mean_chamfer_m(frames, kind, scale, offset),
        ground_miss_m=ground_miss_m(ground, kind, scale, offset) if ground is not None else float("nan"),
    )


def ground_miss_m(ground: GroundEvidence, kind: str, scale: float, offset: float) -> float:
    """Median distance of lifted floor pixels from the floor, metres; infinite where most go nowhere."""
    height_m = ground.camera_height_m + metric_depth(kind, ground.value, scale, offset) * ground.ray_up
    return float(np.median(np.where(np.isfinite(height_m), np.abs(height_m), np.inf)))


def _median_scale(frames: Sequence[FrameEvidence], kind: str, ground: GroundEvidence | None) -> float:
    ratios = []
    if not frames and ground is not None:
        ratio = ground.depth_m / ground.value if kind == "depth" else 1.0 / (ground.depth_m * ground.value)
        ratios = ratio[np.isfinite(ratio) & (ratio > 0)].tolist() or [float("nan")]
    for frame in frames:
        depth_m, value = float(np.median(frame.body_camera_m[:, 2])), float(np.median(frame.value))
        ratios.append(depth_m / value if kind == "depth" else 1.0 / (depth_m * value))
    return float(np.median(ratios))


def _line_start(
    frames: Sequence[FrameEvidence], kind: str, ground: GroundEvidence | None
) -> tuple[float, float] | None:
    """Scale and offset of the line through the frames' medians and the floor; None where no rising line fits."""
    x = [float(np.median(frame.value)) for frame in frames]
    y = [float(np.median(frame.body_camera_m[:, 2])) for frame in frames]
    if ground is not None:
        x, y = x + ground.value.tolist(), y + ground.depth_m.tolist()
    values, goals = np.array(x), np.array(y) if kind == "depth" else 1.0 / np.array(y)
    return fitted_line(values, goals, np.isfinite(values) & np.isfinite(goals), least=2)


def _descend(
    frames: Sequence[FrameEvidence],
    kind: str,
    scale: float,
    offset: float,
    with_offset: bool,
    config: ChamferConfig,
    steps: int,
    ground: GroundEvidence | None = None,
) -> tuple[float, float, float]:
    """Scale, offset and loss after a few L-BFGS rounds, with neighbours looked up anew before each round.

    The offset is optimised in units that move the person as far as the scale does.
    """
    every = [frame.value for frame in frames] + ([] if ground is None else [ground.value])
    unit = scale * float(np.median(np.abs(np.concatenate(every))))
    state = torch.tensor([np.log(scale), offset / unit], dtype=torch.float64, requires_grad=True)
    rays = [torch.as_tensor(frame.ray, dtype=torch.float64) for frame in frames]
    values = [torch.as_tensor(frame.value, dtype=torch.float64) for frame in frames]
    mask = torch.tensor([1.0, 1.0 if with_offset else 0.0], dtype=torch.float64)

    def lifted(value: torch.Tensor) -> torch.Tensor:
        line = torch.exp(state[0]) * value + state[1] * unit
        depth = line if kind == "depth" else 1.0 / torch.clamp(line, min=1e-3)
        return torch.clamp(depth, min=0.02, max=1e3)

    floor = None if ground is None else [torch.as_tensor(x, dtype=torch.float64) for x in (ground.value, ground.ray_up)]

    def objective(losses: Sequence[ChamferLoss]) -> torch.Tensor:
        total = torch.zeros((), dtype=torch.float64)
        for loss, ray, value in zip(losses, rays, values, strict=True):
            total = total + loss(ray * lifted(value)[:, None])
        total = total / max(len(losses), 1)
        if ground is not None and floor is not None:
            height = ground.camera_height_m + lifted(floor[0]) * floor[1]
            total = total + ground.weight * huber_of_square(height * height, config.huber_m).mean()
        return total

    held = ChamferConfig(config.sides, config.huber_m, config.trim_ratio, requery_every=10**9)
    value = float("inf")
    for _ in range(max(steps // 4, 1)):
        losses = [ChamferLoss(frame.body_camera_m, held) for frame in frames]
        optimizer = torch.optim.LBFGS([state], max_iter=4, line_search_fn="strong_wolfe")
        before = state.detach().clone()

        def closure(losses: Sequence[ChamferLoss] = losses, optimizer: torch.optim.LBFGS = optimizer) -> float:
            optimizer.zero_grad()
            result = objective(losses)
            result.backward()
            if state.grad is not None:
                state.grad *= mask
            return result.item()

        value = float(optimizer.step(closure))
        if float((state.detach() - before).abs().max()) < 1e-4:
            break
    log_scale, relative_offset = state.detach().tolist()
    return float(np.exp(log_scale)), float(relative_offset * unit), value


def mean_chamfer_m(frames: Sequence[FrameEvidence], kind: str, scale: float, offset: float) -> float:
    """Chamfer distance between bodies and lifted depth, metres, mean over frames; infinite where nothing is lifted."""
    distances = []
    for frame in frames:
        depth_m = metric_depth(kind, frame.value, scale, offset)
        points = (frame.ray * depth_m[:, None])[np.isfinite(depth_m)]
        if len(points):
            distances.append(chamfer_m(points, frame.body_camera_m, trim_ratio=0.05))
    return float(np.mean(distances)) if distances else float("inf")
