"""Time of one window and of a motion of 690 frames, and jerk where windows meet.

    python benchmarks/scenemi/long_motion.py --motion cmu.npz --split split.json --weights small

Times are medians and include scene encoding and postprocessing. `seams` is the median jerk (third differences) across
the first or last frame that two windows share, divided by the median over the motion; `keyframes` is the same ratio
across keyframes.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenemi.data.container import MotionArchive, read_split
from scenemi.data.files import write_json
from scenemi.data.retarget import RetargetedMotion, retarget
from scenemi.evaluation.scenes import with_synthetic_scenes
from scenemi.evaluation.seams import keyframe_motion, seam_jerk
from scenemi.evaluation.windows import KeyframeProtocol, adult_body, cut_windows, give_keyframes
from scenemi.longmotion import inbetween
from scenemi.model.choice import load_prior_by_name
from scenemi.prior import InbetweeningPrior


def main() -> None:
    """Measure, write JSON and print it."""
    options = arguments()
    names = read_split(options.split)["test"]
    archive = MotionArchive.read(options.motion)
    body = adult_body()
    counts = zip(archive.names, archive.frame_counts, strict=True)
    long_names = [name for name, count in counts if name in names and count >= options.frames][: options.clips]
    clips = [retarget(archive.clip(name), body) for name in long_names]
    windows = with_synthetic_scenes(cut_windows([archive], names)[:1])
    rows = []
    for weights in options.weights:
        prior = load_prior_by_name(weights, device=options.device, steps=options.steps)
        row: dict[str, Any] = {"weights": Path(weights).stem}
        for interval in options.intervals:
            window = give_keyframes(windows[0], KeyframeProtocol(interval)).keyframes
            row[f"window r = {interval}, s"] = seconds(lambda prior=prior, window=window: prior.fill(window), 5)
            row |= long_motion(prior, clips, interval, options.frames)
        rows.append(row)
    report = {
        "date": datetime.date.today().isoformat(), "steps": options.steps, "frames": options.frames, "rows": rows,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads, {options.device}",
        "clips": long_names, "python": platform.python_version(),
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "long_motion.json", report)
    for row in rows:
        sys.stdout.write("\n".join(f"{name}: {value}" for name, value in row.items()) + "\n")


def long_motion(
    prior: InbetweeningPrior, clips: list[RetargetedMotion], interval: int, frames: int
) -> dict[str, float]:
    """Median time and jerk of the first `frames` frames of the clips."""
    took, seams, keys = [], [], []
    for clip in clips:
        given = keyframe_motion(clip, interval, frames)
        start = time.perf_counter()
        filled = inbetween(given, prior)
        took.append(time.perf_counter() - start)
        jerk = seam_jerk(given, filled)
        seams.append(jerk.at_seams)
        keys.append(jerk.at_keyframes)
    return {
        f"{frames} frames r = {interval}, s": float(np.median(took)),
        f"seams r = {interval}": float(np.median(np.concatenate(seams))),
        f"keyframes r = {interval}": float(np.median(np.concatenate(keys))),
    }


def seconds(run: Callable[[], object], times: int) -> float:
    """Median time of calls, without the first one."""
    run()
    took = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        took.append(time.perf_counter() - start)
    return float(np.median(took))


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--weights", nargs="+", default=["small"])
    parser.add_argument("--intervals", type=int, nargs="+", default=[15, 30])
    parser.add_argument("--frames", type=int, default=690)
    parser.add_argument("--clips", type=int, default=4, help="number of long clips")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
