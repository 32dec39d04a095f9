"""Numbers of the in-betweening prior on all test windows (those of its model card).

    python benchmarks/scenemi/reach.py --motion cmu.npz --split split.json --weights small [--blind FILE] \
        [--errors pipeline_errors.npz] [--out benchmarks/scenemi/results/reach.json]
    python benchmarks/scenemi/reach.py --motion cmu.npz --split split.json --part val --every 8 --choose-solve

- exact keyframes every 15, 30, 60 frames without scenes: error relative to that of interpolation (one sample; at 60 the
  mean of eight samples, and the best of eight), jerk relative to the truth's, raw and low-passed at 8 Hz, skating,
  contact F1; of the network's output, and after the final solve of `scenemi sample`;
- blocking scenes (`scenemi.evaluation.scenes`), r = 60, without postprocessing: share of close frames more than 1 cm
  inside, with the scene given, not given, and by a model trained without scenes (`--blind`);
- errors of the video pipeline on every frame, and with one second missing (`--errors`, of test clips);
- 20 steps compared with 1000; seconds per window.
Intervals are 95 % over clips.

`--choose-solve` instead compares settings of the solve without an image (`WITHOUT_PICTURE`), changing one at a time,
and prints error and skating; choose on `--part val`. `--choose-sampler` does so with the cutoff of the low-pass, with
answers to the window alone (not to its reflection too), and with the temperature of samples.
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
from scenemi.model.prior import DiffusionPrior
from scenemi.postprocess.in_scene import WITHOUT_PICTURE, SolvedPrior, put_in_scene
from scenemi.prior import InbetweeningPrior, InterpolationPrior, KeyframeWindow, WindowMotion
from scenemi.training.noise import PipelineErrors, reported_level
from video2anim.digest import file_digest
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.types.skeleton import forward_kinematics

SAMPLES = 8
"""Samples per window, each with `SAMPLE_STEPS` steps; all other rows are the expected motion (one step)."""
MISSING_FRAMES = 30
CUTOFFS_HZ = (4.0, 5.0, 6.0, 8.0, 10.0, 14.9)
NOISY_CUTOFFS_HZ = (2.5, 3.0, 3.5, 4.0, 5.0)
VIDEO_CUTOFFS_HZ = (2.5, 3.0, 4.0, 5.0, 6.0, 10.0)
TEMPERATURES = (0.3, 0.5, 0.7, 1.0)
SOLVES: dict[str, tuple[float, ...]] = {
    "root_m": (0.002, 0.02), "trunk_rad": (0.005, 0.03), "limb_rad": (0.3, 0.8), "acceleration_ratio": (2.0, 10.0),
    "stance_m_s": (0.02, 0.1), "odd_speed_m_s": (1.0, 4.0), "contact_threshold": (0.01, 0.1, 0.3),
}  # fmt: skip
"""Alternatives to the values of `WITHOUT_PICTURE`."""


def main() -> None:
    """Measure the prior and write the report."""
    options = arguments()
    names = read_split(options.split)[options.part]
    windows = cut_windows([MotionArchive.read(path) for path in options.motion], names)[:: options.every]
    prior = load_prior_by_name(options.weights, device="cpu", steps=options.steps)
    if options.choose_solve:
        sys.stdout.write(choice_of_solve(prior, windows))
        return
    if options.choose_sampler:
        assert isinstance(prior, DiffusionPrior)
        sys.stdout.write(choice_of_sampler(prior, windows))
        if options.errors:
            sys.stdout.write(choice_for_video(prior, windows, PipelineErrors.read(options.errors)))
        return
    report: dict[str, Any] = {
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "date": datetime.date.today().isoformat(), "seed": 0, "steps": options.steps, "windows": len(windows),
        "clips": [path.name for path in options.motion], "part": options.part, "card": prior.model.card,  # type: ignore[attr-defined]
        "weights_sha256": file_digest(prior.model.path),  # type: ignore[attr-defined]
    }  # fmt: skip
    report["inbetweening"] = [inbetweening(prior, windows, r) for r in (15, 30, 60)]
    solved: Any = SolvedPrior(prior)  # type: ignore[arg-type]
    report["solved"] = [inbetweening(solved, windows, r, samples=False) for r in (15, 30, 60)]
    report["scenes"] = scenes(prior, windows, options)
    if options.errors:
        report["pipeline"] = pipeline(prior, windows, PipelineErrors.read(options.errors))
    report["steps_1000"] = steps(options, windows)
    write_json(options.out, report)
    sys.stdout.write(markdown(report))


def inbetweening(
    prior: InbetweeningPrior, windows: Sequence[EvaluationWindow], interval: int, *, samples: bool = True
) -> dict[str, Any]:
    """The row of one keyframe interval."""
    found = evaluate(windows, prior, KeyframeProtocol(interval))
    several = load_prior_by_name(str(prior.model.path), device="cpu", steps=SAMPLE_STEPS)  # type: ignore[attr-defined]
    joints = [_samples(several, window, interval) for window in windows] if samples and interval >= 60 else []
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
    if joints:
        _, mean, best = _of_eight(joints, windows)
        row["ratio_mean_of_8"], row["ratio_best_of_8"] = mean / base, best / base
    return row


def choice_for_video(prior: DiffusionPrior, windows: Sequence[EvaluationWindow], errors: PipelineErrors) -> str:
    """Errors of the prior for cutoffs, where the keyframes have those of the video pipeline."""
    heads = "MJPE root-aligned, m | MJPE, m | acceleration error, m/s2"
    lines = ["", f"| cutoff with errors of a video, Hz | {heads} |", "|---|---|---|---|"]
    for hz in VIDEO_CUTOFFS_HZ:
        one = DiffusionPrior(prior.model, replace(prior.sampler, video_cutoff_hz=hz))
        row = pipeline(one, windows, errors)["all frames"]["prior"]
        lines.append(f"| {hz:g} | " + " | ".join(f"{value:.4g}" for value in row.values()) + " |")
    return "\n".join(lines) + "\n"


def choice_of_sampler(prior: DiffusionPrior, windows: Sequence[EvaluationWindow]) -> str:
    """Error over that of interpolation, jerk over that of the truth low-passed at 8 Hz, and skating, for cutoffs and
    for answers to the window alone; error of one sample, of the mean and of the best of eight for temperatures."""
    chosen = prior.sampler
    alone = DiffusionPrior(prior.model, chosen)
    alone._denoiser = prior.model.denoiser
    settings = {f"{hz:g} Hz": DiffusionPrior(prior.model, replace(chosen, cutoff_hz=hz)) for hz in CUTOFFS_HZ}
    lines = ["| | r | ratio | jerk / truth 8 Hz | skating |", "|---|---|---|---|---|"]
    for name, one in (settings | {"window alone": alone}).items():
        for interval in (15, 30, 60):
            found = evaluate(windows, one, KeyframeProtocol(interval))
            ratio = found.mean("mjpe_all_m") / mean_of(found.baseline, "mjpe_all_m")
            jerk = found.mean("jerk_m_s3") / mean_of(found.truth, "jerk_8hz_m_s3")
            lines.append(f"| {name} | {interval} | {ratio:.3f} | {jerk:.2f} | {found.mean('skating_gmd'):.3f} |")
    lines += ["", "| | noise level, r = 3 | error, cm | jerk / truth 8 Hz | skating |", "|---|---|---|---|---|"]
    for hz in NOISY_CUTOFFS_HZ:
        one = DiffusionPrior(prior.model, replace(chosen, noisy_cutoff_hz=hz))
        for level in (0.25, 0.5, 1.0):
            found = evaluate(windows, one, KeyframeProtocol(3, noise=level))
            jerk = found.mean("jerk_m_s3") / mean_of(found.truth, "jerk_8hz_m_s3")
            error, skating = 100 * found.mean("mjpe_all_m"), found.mean("skating_gmd")
            lines.append(f"| {hz:g} Hz at 1 | {level} | {error:.2f} | {jerk:.2f} | {skating:.3f} |")
    base = mean_of(evaluate(windows, prior, KeyframeProtocol(60)).baseline, "mjpe_all_m")
    lines += ["", "| temperature | one sample | mean of 8 | best of 8 |", "|---|---|---|---|"]
    for temperature in TEMPERATURES:
        one = DiffusionPrior(prior.model, replace(chosen, steps=SAMPLE_STEPS, temperature=temperature))
        single, mean, best = _of_eight([_samples(one, window, 60) for window in windows], windows)
        lines.append(f"| {temperature} | {single / base:.3f} | {mean / base:.3f} | {best / base:.3f} |")
    return "\n".join(lines) + "\n"


def choice_of_solve(prior: InbetweeningPrior, windows: Sequence[EvaluationWindow]) -> str:
    """Error and skating at r = 30 and 60, without the solve and with every alternative setting."""
    candidates = {"none": None, "present": WITHOUT_PICTURE} | {
        f"{name} {value:g}": replace(WITHOUT_PICTURE, **{name: value})
        for name, values in SOLVES.items()
        for value in values
    }
    rows: dict[str, list[float]] = {name: [] for name in ["truth", *candidates]}
    for interval in (30, 60):
        given = [give_keyframes(window, KeyframeProtocol(interval)).keyframes for window in windows]
        made = _filled(prior, given, range(len(given)))
        rows["truth"] += [0.0, float(np.mean([metrics.foot_skating_gmd(w.joints_m, FPS) for w in windows]))]
        for name, config in candidates.items():
            solved = made if config is None else [put_in_scene(m, g, config) for m, g in zip(made, given, strict=True)]
            joints_m = [_joints(m, w) for m, w in zip(solved, windows, strict=True)]
            errors = [metrics.mpjpe(j, w.joints_m) for j, w in zip(joints_m, windows, strict=True)]
            rows[name] += [1000 * float(np.mean(errors))]
            rows[name] += [float(np.mean([metrics.foot_skating_gmd(j, FPS) for j in joints_m]))]
            sys.stderr.write(f"{interval} {name} {rows[name]}\n")
    lines = [
        f"{len(windows)} windows\n",
        "| solve | MJPE r = 30, mm | skating | MJPE r = 60, mm | skating |",
        "|---" * 5 + "|",
    ]
    lines += [f"| {name} | {a:.2f} | {b:.3f} | {c:.2f} | {d:.3f} |" for name, (a, b, c, d) in rows.items()]
    return "\n".join(lines) + "\n"


def _of_eight(joints: Sequence[np.ndarray], windows: Sequence[EvaluationWindow]) -> tuple[float, float, float]:
    """Mean error of samples, of their means, and of the best of each window, m."""
    pairs = list(zip(joints, windows, strict=True))
    errors = [np.linalg.norm(made - w.joints_m, axis=-1).mean((1, 2)) for made, w in pairs]
    mean = [np.linalg.norm(made.mean(0) - w.joints_m, axis=-1).mean() for made, w in pairs]
    return float(np.mean(errors)), float(np.mean(mean)), float(np.mean([error.min() for error in errors]))


def _samples(prior: InbetweeningPrior, window: EvaluationWindow, interval: int) -> np.ndarray:
    """Joints (samples, frames, 22, 3) of eight samples of a window."""
    given = give_keyframes(window, KeyframeProtocol(interval)).keyframes
    made = fill_batch(prior, [given] * SAMPLES, [window_seed(window.name, s) % 2**31 for s in range(SAMPLES)])
    return np.stack([_joints(motion, window) for motion in made])


def _joints(motion: WindowMotion, window: EvaluationWindow) -> np.ndarray:
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
        _joints(WindowMotion(g.R_parent_joint, g.translation_world_m), w) for g, w in zip(given, windows, strict=True)
    ]
    made = [_joints(m, w) for m, w in zip(_filled(prior, given, seeds), windows, strict=True)]
    table: dict[str, Any] = {
        "all frames": _against(truths, {"observed": observed, "6 Hz": [_low(o, 6.0) for o in observed], "prior": made})
    }
    start = (len(truths[0]) - MISSING_FRAMES) // 2
    hidden = slice(start, start + MISSING_FRAMES)
    gaps = [replace(g, is_keyframe=_without(g.is_keyframe, hidden)) for g in given]
    bridged = [_joints(InterpolationPrior().fill(g), w) for g, w in zip(gaps, windows, strict=True)]
    filled = [_joints(m, w) for m, w in zip(_filled(prior, gaps, seeds), windows, strict=True)]
    inside: dict[str, Sequence[np.ndarray]] = {
        "interpolation": [b[hidden] for b in bridged],
        "prior": [f[hidden] for f in filled],
    }
    table["missing second"] = _against([t[hidden] for t in truths], inside)
    return table


def _filled(prior: InbetweeningPrior, given: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
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
    parser.add_argument("--choose-solve", action="store_true")
    parser.add_argument("--choose-sampler", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results/reach.json"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
