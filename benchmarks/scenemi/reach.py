"""Numbers of the in-betweening prior on all test windows (those of its model card).

    python benchmarks/scenemi/reach.py --motion cmu.npz --split split.json --weights small [--blind FILE] \
        [--errors pipeline_errors.npz] [--out benchmarks/scenemi/results/reach.json]

- exact keyframes every 15, 30, 60 frames without scenes: error relative to that of interpolation (one sample; at 60 the
  mean of eight samples, and the best of eight), jerk relative to the truth's, raw and low-passed at 8 Hz, skating,
  contact F1; of the network's output, and after the final solve of `scenemi sample`;
- noisy keyframes (l = 1) every 3 frames, without scenes: error, skating; before and after the solve;
- blocking scenes (`scenemi.evaluation.scenes`), r = 60, without postprocessing: share of close frames more than 1 cm
  inside, with the scene given, not given, and by a model trained without scenes (`--blind`);
- errors of the video pipeline on every frame, and with one second missing (`--errors`, of test clips);
- 20 steps compared with 1000; seconds per window.
Intervals are 95 % over clips.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenemi import metrics
from scenemi.data.container import MotionArchive, read_split
from scenemi.data.files import write_json
from scenemi.evaluation.ablation import AblatedPrior
from scenemi.evaluation.protocol import Evaluation, evaluate, fill_batch
from scenemi.evaluation.scenes import telling_share, with_synthetic_scenes
from scenemi.evaluation.scores import mean_of
from scenemi.evaluation.windows import FPS, EvaluationWindow, KeyframeProtocol, cut_windows, give_keyframes, window_seed
from scenemi.model.choice import SAMPLE_STEPS, load_prior_by_name
from scenemi.postprocess.in_scene import SolvedPrior
from scenemi.prior import InbetweeningPrior, InterpolationPrior, KeyframeWindow, WindowMotion
from scenemi.training.noise import PipelineErrors, reported_level
from video2anim.digest import file_digest
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.skeleton import forward_kinematics

SAMPLES = 8
"""Samples per window, each with `SAMPLE_STEPS` steps; all other rows are the expected motion (one step)."""
MISSING_FRAMES = 30


def main() -> None:
    """Measure the prior and write the report."""
    options = arguments()
    names = read_split(options.split)[options.part]
    windows = cut_windows([MotionArchive.read(path) for path in options.motion], names)[:: options.every]
    prior = load_prior_by_name(options.weights, device="cpu", steps=options.steps)
    report: dict[str, Any] = {
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "date": datetime.date.today().isoformat(), "seed": 0, "steps": options.steps, "windows": len(windows),
        "clips": [path.name for path in options.motion], "part": options.part, "card": prior.model.card,  # type: ignore[attr-defined]
        "weights_sha256": file_digest(prior.model.path),  # type: ignore[attr-defined]
    }  # fmt: skip
    report["inbetweening"] = [inbetweening(prior, windows, r) for r in (15, 30, 60)]
    solved: Any = SolvedPrior(prior)  # type: ignore[arg-type]
    report["solved"] = [inbetweening(solved, windows, r, eight=False) for r in (15, 30, 60)]
    report["noisy"] = {name: noisy(one, windows) for name, one in (("network", prior), ("solved", solved))}
    report["scenes"] = scenes(prior, windows, options)
    if options.errors:
        report["pipeline"] = pipeline(prior, windows, PipelineErrors.read(options.errors))
    report["steps_1000"] = steps(options, windows)
    write_json(options.out, report)
    sys.stdout.write(markdown(report))


def inbetweening(
    prior: InbetweeningPrior, windows: Sequence[EvaluationWindow], interval: int, *, eight: bool = True
) -> dict[str, Any]:
    """The row of one keyframe interval."""
    found = evaluate(windows, prior, KeyframeProtocol(interval))
    several = load_prior_by_name(str(prior.model.path), device="cpu", steps=SAMPLE_STEPS)  # type: ignore[attr-defined]
    drawn = [samples(several, window, interval) for window in windows] if eight and interval >= 60 else []
    base = mean_of(found.baseline, "mjpe_all_m")
    row: dict[str, Any] = {
        "interval": interval,
        "mjpe_m": _interval(found, "mjpe_all_m"),
        "baseline_mjpe_m": base,
        "ratio": found.mean("mjpe_all_m") / base,
        "jerk_over_truth": found.mean("jerk_m_s3") / mean_of(found.truth, "jerk_m_s3"),
        "jerk_over_truth_8hz": found.mean("jerk_m_s3") / mean_of(found.truth, "jerk_8hz_m_s3"),
        "skating": _interval(found, "skating_gmd"),
        "skating_truth": mean_of(found.truth, "skating_gmd"),
        "contact_f1": found.mean("contact_f1"),
        "contact_f1_baseline": mean_of(found.baseline, "contact_f1"),
        "seconds_per_window": found.seconds_per_window,
    }
    if drawn:
        _, mean, best = of_eight(drawn, windows)
        row["ratio_mean_of_8"], row["ratio_best_of_8"] = mean / base, best / base
    return row


def noisy(prior: InbetweeningPrior, windows: Sequence[EvaluationWindow]) -> dict[str, Any]:
    """Numbers with noise of level 1 on keyframes every 3 frames."""
    found = evaluate(windows, prior, KeyframeProtocol(3, noise=1.0))
    return {key: _interval(found, key) for key in ("mjpe_all_m", "mjpe_key_m", "skating_gmd", "jerk_m_s3")}


def of_eight(joints: Sequence[np.ndarray], windows: Sequence[EvaluationWindow]) -> tuple[float, float, float]:
    """Mean error of samples, of their means, and of the best of each window, m."""
    pairs = list(zip(joints, windows, strict=True))
    errors = [np.linalg.norm(made - w.joints_m, axis=-1).mean((1, 2)) for made, w in pairs]
    mean = [np.linalg.norm(made.mean(0) - w.joints_m, axis=-1).mean() for made, w in pairs]
    return float(np.mean(errors)), float(np.mean(mean)), float(np.mean([error.min() for error in errors]))


def samples(prior: InbetweeningPrior, window: EvaluationWindow, interval: int) -> np.ndarray:
    """Joints (samples, frames, 22, 3) of eight samples of a window."""
    given = give_keyframes(window, KeyframeProtocol(interval)).keyframes
    made = fill_batch(prior, [given] * SAMPLES, [window_seed(window.name, s) % 2**31 for s in range(SAMPLES)])
    return np.stack([joints(motion, window) for motion in made])


def joints(motion: WindowMotion, window: EvaluationWindow) -> np.ndarray:
    return forward_kinematics(motion.R_parent_joint, motion.translation_world_m, window.body.rest_joints_m)[0]


def scenes(prior: Any, windows: Sequence[EvaluationWindow], options: argparse.Namespace) -> dict[str, Any]:
    """Collisions at r = 60 without postprocessing."""
    placed = with_synthetic_scenes(windows)
    rows: dict[str, InbetweeningPrior] = {
        "scene shown": prior,
        "scene not shown": AblatedPrior(prior, use_scene=False),
        "interpolation": InterpolationPrior(),
    }
    if options.blind:
        blind: Any = load_prior_by_name(str(options.blind), device="cpu", steps=options.steps)
        rows["trained without scene"] = blind
    table: dict[str, Any] = {"telling_share": telling_share(placed)}
    for name, one in rows.items():
        found = evaluate(placed, one, KeyframeProtocol(60))
        table[name] = {
            key: _interval(found, key)
            for key in (
                "close_collision_frame_ratio_1cm",
                "collision_frame_ratio_1cm",
                "penetration_max_m",
                "mjpe_all_m",
            )
        }
        table["truth"] = {"close_collision_frame_ratio_1cm": mean_of(found.truth, "close_collision_frame_ratio_1cm")}
    return table


def pipeline(prior: InbetweeningPrior, windows: Sequence[EvaluationWindow], errors: PipelineErrors) -> dict[str, Any]:
    """Errors with the pipeline's errors on every frame, and with one second missing."""
    rng = np.random.default_rng(5)
    given, truths = [], []
    for window in windows:
        turn_rad, shift_m = errors.draw(rng, len(window.translation_m))
        R = window.R_parent_joint @ matrix_from_axis_angle(turn_rad.astype(np.float64))
        level = reported_level(np.random.default_rng(0), turn_rad, shift_m)
        every = np.ones(len(R), bool)
        noise = np.tile(level, (len(R), 1))
        shifted_m, rest_m = window.translation_m + shift_m, window.body.rest_joints_m
        given.append(KeyframeWindow(R, shifted_m, every, rest_m, FPS, body=window.body, noise=noise))
        truths.append(window.joints_m)
    seeds = list(range(len(given)))
    observed = [
        joints(WindowMotion(g.R_parent_joint, g.translation_world_m), w) for g, w in zip(given, windows, strict=True)
    ]
    made = [joints(m, w) for m, w in zip(filled(prior, given, seeds), windows, strict=True)]
    table: dict[str, Any] = {
        "all frames": _against(truths, {"observed": observed, "6 Hz": [_low(o, 6.0) for o in observed], "prior": made})
    }
    start = (len(truths[0]) - MISSING_FRAMES) // 2
    hidden = slice(start, start + MISSING_FRAMES)
    gaps = [replace(g, is_keyframe=_without(g.is_keyframe, hidden)) for g in given]
    bridged = [joints(InterpolationPrior().fill(g), w) for g, w in zip(gaps, windows, strict=True)]
    inner = [joints(m, w) for m, w in zip(filled(prior, gaps, seeds), windows, strict=True)]
    inside: dict[str, Sequence[np.ndarray]] = {
        "interpolation": [b[hidden] for b in bridged],
        "prior": [f[hidden] for f in inner],
    }
    table["missing second"] = _against([t[hidden] for t in truths], inside)
    return table


def filled(prior: InbetweeningPrior, given: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
    return [m for i in range(0, len(given), 8) for m in fill_batch(prior, given[i : i + 8], seeds[i : i + 8])]


def _without(mask: np.ndarray, hidden: slice) -> np.ndarray:
    kept = mask.copy()
    kept[hidden] = False
    return kept


def _low(joints_m: np.ndarray, cutoff_hz: float) -> np.ndarray:
    from scipy.signal import butter, sosfiltfilt

    return np.asarray(sosfiltfilt(butter(2, cutoff_hz, fs=FPS, output="sos"), joints_m, axis=0))


def _against(truths: Sequence[np.ndarray], made: dict[str, Sequence[np.ndarray]]) -> dict[str, Any]:
    """Root-aligned joint error, joint error and acceleration error, means over windows."""
    measures: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {
        "mjpe_root_aligned_m": metrics.root_relative_mpjpe,
        "mjpe_m": metrics.mpjpe,
        "acceleration_error_m_s2": lambda a, b: metrics.acceleration_error_m_s2(a, b, FPS),
    }
    return {
        name: {key: float(np.mean([f(a, b) for a, b in zip(rows, truths, strict=True)])) for key, f in measures.items()}
        for name, rows in made.items()
    }


def steps(options: argparse.Namespace, windows: Sequence[EvaluationWindow]) -> dict[str, Any]:
    """The paper's 1000 steps and a sampler with few steps, on every eighth window."""
    some = windows[::8]
    few, many = (
        evaluate(some, load_prior_by_name(options.weights, device="cpu", steps=n), KeyframeProtocol(30)).mean(
            "mjpe_all_m"
        )
        for n in (SAMPLE_STEPS, 1000)
    )
    return {"windows": len(some), "interval": 30, "mjpe_few_m": few, "mjpe_1000_m": many, "ratio": few / many}


def _interval(found: Evaluation, name: str) -> dict[str, float]:
    value = found.interval(name)
    return {"mean": value.mean, "low": value.low, "high": value.high}


def markdown(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [
        "| r | ratio | mean of 8 | best of 8 | jerk / truth | jerk / truth 8 Hz | skating (truth) |",
        "|---|---|---|---|---|---|---|",
    ]
    rows = [("", row) for row in report["inbetweening"]] + [(", after the solve", row) for row in report["solved"]]
    for after, row in rows:
        eight = [f"{row[key]:.3f}" if key in row else "" for key in ("ratio_mean_of_8", "ratio_best_of_8")]
        skating = f"{row['skating']['mean']:.3f} ({row['skating_truth']:.3f})"
        jerk = f"{row['jerk_over_truth']:.2f} | {row['jerk_over_truth_8hz']:.2f}"
        lines.append(
            f"| {row['interval']}{after} | {row['ratio']:.3f} | {eight[0]} | {eight[1]} | {jerk} | {skating} |"
        )
    lines += ["", "| r = 3, l = 1 | MJPE, cm | skating |", "|---|---|---|"]
    for name, row in report["noisy"].items():
        error, skating = row["mjpe_all_m"], row["skating_gmd"]
        low, high = 100 * error["low"], 100 * error["high"]
        lines.append(f"| {name} | {100 * error['mean']:.2f} [{low:.2f}, {high:.2f}] | {skating['mean']:.3f} |")
    lines += ["", "| scenes, r = 60 | close frames > 1 cm inside | MJPE, m |", "|---|---|---|"]
    for name, row in report["scenes"].items():
        if isinstance(row, dict) and "mjpe_all_m" in row:
            close, error = row["close_collision_frame_ratio_1cm"], row["mjpe_all_m"]
            lines.append(
                f"| {name} | {close['mean']:.3f} [{close['low']:.3f}, {close['high']:.3f}] | {error['mean']:.4f} |"
            )
    for title, rows in report.get("pipeline", {}).items():
        lines += ["", f"| {title} | MJPE root-aligned, mm | MJPE, mm | acceleration error, m/s2 |", "|---|---|---|---|"]
        for name, row in rows.items():
            values = 1000 * row["mjpe_root_aligned_m"], 1000 * row["mjpe_m"], row["acceleration_error_m_s2"]
            lines.append(f"| {name} | {values[0]:.1f} | {values[1]:.1f} | {values[2]:.2f} |")
    lines.append(f"\n{SAMPLE_STEPS} steps over 1000: {report['steps_1000']['ratio']:.3f}")
    return "\n".join(lines) + "\n"


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="+", required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--part", default="test")
    parser.add_argument("--weights", default="small")
    parser.add_argument("--blind", type=Path, help="weights of a model trained alike, but without scenes")
    parser.add_argument("--errors", type=Path)
    parser.add_argument("--steps", type=int, default=1)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results/reach.json"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
