"""Evaluation of a prior on windows: the paper's numbers beside those of the truth and of interpolation."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from scenemi.evaluation.scores import Interval, WindowEvaluator, WindowScores, bootstrap, mean_of
from scenemi.evaluation.windows import EvaluationWindow, GivenWindow, KeyframeProtocol, give_keyframes, window_seed
from scenemi.prior import InbetweeningPrior, InterpolationPrior, KeyframeWindow, WindowMotion
from video2anim.errors import StageError

FID_WINDOWS = 1000
"""Fewer windows on a side do not tell a covariance of 32 features well enough."""
BATCH = 8
"""Windows handed to a prior at once, where it takes several."""
Progress = Callable[[int, int], None]
FeatureExtractor = Callable[[Sequence[WindowMotion]], Float[np.ndarray, "windows features"]]
NUMBERS = (
    "mjpe_all_m", "mjpe_key_m", "jerk_m_s3", "jerk_8hz_m_s3", "skating_gmd", "contact_f1", "collision_frame_ratio",
    "collision_frame_ratio_1cm", "collision_vertex_ratio", "penetration_max_m", "close_collision_frame_ratio",
    "close_collision_frame_ratio_1cm", "close_collision_vertex_ratio", "close_penetration_max_m", "floor_depth_m",
)  # fmt: skip
"""What is averaged over windows."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Numbers of every window for one prior, the truth, the baseline and the noisy input."""

    prior_name: str
    window_names: tuple[str, ...]
    prior: tuple[WindowScores, ...]
    truth: tuple[WindowScores, ...]
    baseline: tuple[WindowScores, ...]
    """Interpolation between the same keyframes."""
    noisy_input: tuple[WindowScores, ...]
    """The whole motion with the noise that the keyframes carry; equal to the truth without noise."""
    seconds_per_window: float
    fid: float | None = None
    """Frechet distance to the true windows; None without a feature extractor or with fewer than 1,000 windows."""
    baseline_fid: float | None = None

    def mean(self, name: str) -> float:
        """Mean of one of `NUMBERS` for the prior."""
        return mean_of(self.prior, name)

    def interval(self, name: str) -> Interval:
        """The same with its 95 % interval over clips."""
        return bootstrap(self.prior, name, [window.split("@")[0] for window in self.window_names])

    def summary(self) -> dict[str, float | int]:
        """The twelve numbers that `scenemi evaluate --json` writes."""
        return {
            "windows": len(self.prior),
            "mjpe_all_m": self.mean("mjpe_all_m"),
            "mjpe_key_m": self.mean("mjpe_key_m"),
            "jerk_m_s3": self.mean("jerk_m_s3"),
            "jerk_truth_m_s3": mean_of(self.truth, "jerk_m_s3"),
            "skating_gmd": self.mean("skating_gmd"),
            "skating_gmd_truth": mean_of(self.truth, "skating_gmd"),
            "collision_frame_ratio": self.mean("collision_frame_ratio"),
            "penetration_max_m": self.mean("penetration_max_m"),
            "seconds_per_window": self.seconds_per_window,
            "baseline_mjpe_all_m": mean_of(self.baseline, "mjpe_all_m"),
            "baseline_jerk_m_s3": mean_of(self.baseline, "jerk_m_s3"),
        }

    def details(self) -> dict[str, Any]:
        """Everything: each number of the prior with its interval, and of truth, baseline and noisy input."""
        rows = {"truth": self.truth, "baseline": self.baseline, "noisy_input": self.noisy_input}
        table: dict[str, Any] = {"prior_name": self.prior_name, "windows": len(self.prior)}
        table["seconds_per_window"] = self.seconds_per_window
        table["fid"], table["baseline_fid"] = self.fid, self.baseline_fid
        table["close_frames"] = int(sum(row.close_frames for row in self.truth))
        intervals = {name: self.interval(name) for name in NUMBERS}
        table["prior"] = {name: found.mean for name, found in intervals.items()}
        table["prior_95"] = {name: [found.low, found.high] for name, found in intervals.items()}
        table |= {row: {name: mean_of(scores, name) for name in NUMBERS} for row, scores in rows.items()}
        return table


def evaluate(
    windows: Sequence[EvaluationWindow],
    prior: InbetweeningPrior,
    protocol: KeyframeProtocol,
    *,
    seed: int = 0,
    features: FeatureExtractor | None = None,
    on_window: Progress | None = None,
) -> Evaluation:
    """Fill all windows and measure.

    Args:
        windows: the true motions, with or without scenes.
        prior: any prior; one with `fill_many(windows, seeds)` gets batches.
        protocol: which keyframes, how noisy.
        seed: of the sampling; every window has its own stream.
        features: motion features for the FID.
        on_window: called with (done, total).

    Raises:
        StageError: the prior gave motion that is not finite.
    """
    given = [give_keyframes(window, protocol) for window in windows]
    filled, seconds = _fill(windows, given, prior, seed, on_window)
    plain = [InterpolationPrior().fill(one.keyframes) for one in given]
    prior_scores, truth, baseline, noisy_input = [], [], [], []
    for window, one, motion, simple in zip(windows, given, filled, plain, strict=True):
        judge, is_keyframe = WindowEvaluator(window), one.keyframes.is_keyframe
        truth.append(judge.truth())
        prior_scores.append(judge.scores(motion, is_keyframe))
        baseline.append(judge.scores(simple, is_keyframe))
        noisy = WindowMotion(one.noisy_R_parent_joint, one.noisy_translation_m)
        noisy_input.append(judge.scores(noisy, is_keyframe) if protocol.noise > 0 else truth[-1])
    fid, baseline_fid = _distances(windows, filled, plain, features)
    return Evaluation(
        prior.name,
        tuple(window.name for window in windows),
        tuple(prior_scores),
        tuple(truth),
        tuple(baseline),
        tuple(noisy_input),
        seconds_per_window=seconds / len(windows),
        fid=fid,
        baseline_fid=baseline_fid,
    )


def _fill(
    windows: Sequence[EvaluationWindow],
    given: Sequence[GivenWindow],
    prior: InbetweeningPrior,
    seed: int,
    on_window: Progress | None,
) -> tuple[list[WindowMotion], float]:
    """Filled windows and the seconds it took, without measuring."""
    filled: list[WindowMotion] = []
    seconds = 0.0
    for start in range(0, len(given), BATCH):
        batch = [one.keyframes for one in given[start : start + BATCH]]
        names = [window.name for window in windows[start : start + BATCH]]
        before = time.perf_counter()
        filled += fill_batch(prior, batch, [window_seed(name, seed) % 2**31 for name in names])
        seconds += time.perf_counter() - before
        if on_window is not None:
            on_window(len(filled), len(given))
    for window, motion in zip(windows, filled, strict=True):
        if not np.isfinite(motion.R_parent_joint).all() or not np.isfinite(motion.translation_world_m).all():
            raise StageError(f"prior {prior.name}: motion of window {window.name} is not finite")
    return filled, seconds


def fill_batch(prior: InbetweeningPrior, windows: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
    """Several windows at once where the prior can, one by one where not."""
    many = getattr(prior, "fill_many", None)
    return list(many(windows, seeds)) if many is not None else [prior.fill(window) for window in windows]


def _distances(
    windows: Sequence[EvaluationWindow],
    filled: Sequence[WindowMotion],
    plain: Sequence[WindowMotion],
    features: FeatureExtractor | None,
) -> tuple[float | None, float | None]:
    if features is None or len(windows) < FID_WINDOWS:
        return None, None
    from scenemi.evaluation.frechet import frechet_distance

    true = features([WindowMotion(window.R_parent_joint, window.translation_m) for window in windows])
    return frechet_distance(true, features(filled)), frechet_distance(true, features(plain))
