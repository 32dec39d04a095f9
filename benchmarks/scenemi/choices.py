"""Chooses settings of the in-betweening prior's sampler and of its solve, on validation windows.

    python benchmarks/scenemi/choices.py sampler --motion cmu.npz --split split.json --every 2 [--errors ERRORS.npz]
    python benchmarks/scenemi/choices.py solve --motion cmu.npz --split split.json --every 4
    python benchmarks/scenemi/choices.py prior-error --motion cmu.npz --split split.json --every 2

- sampler: cutoffs of the low-pass, answers to the window alone (not to its reflection too), temperature of samples;
  with `--errors` (`training/pipeline_errors.py`) the cutoff for motion of a video;
- solve: alternatives to `WITHOUT_PICTURE`, one at a time: error, skating, jerk, with `--in-scenes` frames inside;
- prior-error: errors of the prior by the distance from the nearest keyframe, beside `PRIOR_ERROR`.
Prints Markdown.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from reach import filled, of_eight, pipeline, samples

from scenemi.data.container import MotionArchive, read_split
from scenemi.evaluation.protocol import evaluate
from scenemi.evaluation.scenes import with_synthetic_scenes
from scenemi.evaluation.scores import mean_of
from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol, cut_windows, give_keyframes
from scenemi.model.choice import SAMPLE_STEPS, load_prior_by_name
from scenemi.model.prior import DiffusionPrior
from scenemi.postprocess.in_scene import PRIOR_ERROR, WITHOUT_PICTURE, SolvedPrior, prior_error
from scenemi.postprocess.motion_solve import TRUNK
from scenemi.training.noise import PipelineErrors
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.types.skeleton import JOINT_NAMES

CUTOFFS_HZ = (4.0, 5.0, 6.0, 8.0, 10.0, 14.9)
NOISY_CUTOFFS_HZ = (2.5, 3.0, 3.5, 4.0, 5.0)
VIDEO_CUTOFFS_HZ = (2.5, 3.0, 4.0, 5.0, 6.0, 10.0)
TEMPERATURES = (0.3, 0.5, 0.7, 1.0)
LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
SOLVES: dict[str, tuple[float, ...]] = {
    "acceleration_ratio": (5.0, 6.0, 12.0), "stance_m_s": (0.05, 0.3), "odd_speed_m_s": (1.0, 4.0),
    "contact_threshold": (0.03, 0.1, 0.3),
}  # fmt: skip
"""Alternatives to the values of `WITHOUT_PICTURE`."""


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
        single, mean, best = of_eight([samples(one, window, 60) for window in windows], windows)
        lines.append(f"| {temperature} | {single / base:.3f} | {mean / base:.3f} | {best / base:.3f} |")
    return "\n".join(lines) + "\n"


def choice_of_solve(prior: DiffusionPrior, windows: Sequence[EvaluationWindow]) -> str:
    """Error, skating and collisions for alternative settings of the solve."""
    candidates = {"present": WITHOUT_PICTURE} | {
        f"{name} {value:g}": replace(WITHOUT_PICTURE, **{name: value})
        for name, values in SOLVES.items()
        for value in values
    }
    rows = {"none": prior} | {name: SolvedPrior(prior, config) for name, config in candidates.items()}
    lines = [f"{len(windows)} windows\n", "| solve | r | MJPE, cm | skating | jerk | frames inside |", "|---" * 6 + "|"]
    for protocol in (KeyframeProtocol(3, noise=1.0), KeyframeProtocol(15), KeyframeProtocol(30), KeyframeProtocol(60)):
        for name, one in rows.items():
            found = evaluate(windows, one, protocol)
            numbers = [100 * found.mean("mjpe_all_m"), found.mean("skating_gmd"), found.mean("jerk_m_s3")]
            numbers.append(found.mean("collision_frame_ratio_1cm"))
            lines.append(f"| {name} | {protocol.interval} | " + " | ".join(f"{value:.3f}" for value in numbers) + " |")
            sys.stderr.write(lines[-1] + "\n")
        truth = [mean_of(found.truth, key) for key in ("skating_gmd", "jerk_8hz_m_s3")]
        lines.append(f"| truth (jerk at 8 Hz) | {protocol.interval} | 0 | {truth[0]:.3f} | {truth[1]:.1f} | 0 |")
    return "\n".join(lines) + "\n"


def errors_of_prior(prior: DiffusionPrior, windows: Sequence[EvaluationWindow]) -> str:
    """RMS error of an axis of the root's position, and of the rotations of trunk and limbs, beside `prior_error`."""
    trunk = list(TRUNK)
    limbs = [
        i for i, name in enumerate(JOINT_NAMES) if name.endswith(("shoulder", "elbow", "wrist", "hip", "knee", "ankle"))
    ]
    lines = ["| r | frames from a keyframe | root, cm | trunk, rad | limbs, rad |", "|---" * 5 + "|"]
    for protocol in (KeyframeProtocol(3, noise=1.0), KeyframeProtocol(15), KeyframeProtocol(30), KeyframeProtocol(60)):
        given = [give_keyframes(window, protocol).keyframes for window in windows]
        distance, off, said = [], [], []
        for window, one, made in zip(windows, given, filled(prior, given, range(len(given))), strict=True):
            frames = np.arange(len(one.is_keyframe))
            distance.append(np.abs(frames[:, None] - np.flatnonzero(one.is_keyframe)).min(1))
            turn = axis_angle_from_matrix(window.R_parent_joint.swapaxes(-1, -2) @ made.R_parent_joint)
            parts = (made.translation_world_m - window.translation_m)[:, None], turn[:, trunk], turn[:, limbs]
            off.append(np.stack([np.square(part).mean((1, 2)) for part in parts], 1))
            said.append(prior_error(one))
        every, off_all, said_all = np.concatenate(distance), np.concatenate(off), np.concatenate(said)
        for d in range(0, every.max() + 1, max(1, every.max() // 5)):
            measured, law = np.sqrt(off_all[every == d].mean(0)), said_all[every == d].mean(0)
            cells = [f"{m * s:.3f} ({e * s:.3f})" for m, e, s in zip(measured, law, (100, 1, 1), strict=True)]
            lines.append(f"| {protocol.interval} | {d} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + f"\n\nIn brackets: by `PRIOR_ERROR` = {PRIOR_ERROR}\n"


def main() -> None:
    """Print one comparison."""
    options = arguments()
    names = read_split(options.split)[options.part]
    windows = cut_windows([MotionArchive.read(path) for path in options.motion], names)[:: options.every]
    windows = with_synthetic_scenes(windows) if options.in_scenes else windows
    prior = load_prior_by_name(options.weights, device="cpu")
    assert isinstance(prior, DiffusionPrior)
    made = {"solve": choice_of_solve, "sampler": choice_of_sampler, "prior-error": errors_of_prior}
    sys.stdout.write(made[options.what](prior, windows))
    if options.what == "sampler" and options.errors:
        sys.stdout.write(choice_for_video(prior, windows, PipelineErrors.read(options.errors)))


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("solve", "sampler", "prior-error"))
    parser.add_argument("--motion", type=Path, nargs="+", required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--part", default="val")
    parser.add_argument("--weights", default="small")
    parser.add_argument("--errors", type=Path)
    parser.add_argument("--in-scenes", action="store_true")
    parser.add_argument("--every", type=int, default=1)
    return parser.parse_args()


if __name__ == "__main__":
    main()
