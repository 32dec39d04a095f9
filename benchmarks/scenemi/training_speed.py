"""Training speed in windows per second, and the time of its parts. Run it on an idle machine (`make train-stop` first).

    python benchmarks/scenemi/training_speed.py --run ~/.cache/video2anim/training/prior [--config FILE] [--threads 1 2]

Uses the window pool of an existing run, trains a separate model for some steps and saves nothing. Numbers are medians
of several groups of ten steps, after ten steps to warm up.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenemi.data.adults import draw_adults
from scenemi.data.files import write_json
from scenemi.training.batches import PoolBatches
from scenemi.training.config import TrainConfig
from scenemi.training.loop import POOL
from scenemi.training.pool import open_pool
from scenemi.training.run import Run
from video2anim.body.anny_body import shaped_body

STEPS = 10


def main() -> None:
    """Measure and write."""
    options = arguments()
    config = TrainConfig() if options.config is None else TrainConfig.read(options.config)
    shards = open_pool(options.run / POOL)
    bodies = [shaped_body(shape) for shape in draw_adults(config.bodies)]
    rows = [measured(config, shards, bodies, threads, options) for threads in options.threads]
    report = {
        "machine": f"{platform.machine()}, Python {platform.python_version()}, torch {torch.__version__}",
        "date": datetime.date.today().isoformat(), "model": config.model.to_json(),
        "windows_of_a_step": config.step_windows, "rows": rows,
    }  # fmt: skip
    write_json(options.out / f"training_speed-{report['date']}.json", report)
    for row in rows:
        sys.stdout.write(f"{row}\n")


def measured(
    config: TrainConfig, shards: Any, bodies: Any, threads: int, options: argparse.Namespace
) -> dict[str, Any]:
    """The row of a number of threads: windows per second, and milliseconds per window of each part."""
    torch.set_num_threads(threads)
    run = Run(config, bodies, shards, options.device, None)
    data = PoolBatches(shards, config)
    for step in range(STEPS):
        run.advance(data.of_step(step))
    rates, making = [], []
    for piece in range(options.pieces):
        first = time.perf_counter()
        steps = [data.of_step(STEPS * (piece + 1) + step) for step in range(STEPS)]
        second = time.perf_counter()
        for batches in steps:
            run.advance(batches)
        making.append((second - first) / (STEPS * config.step_windows))
        rates.append(STEPS * config.step_windows / (time.perf_counter() - second))
    return {
        "threads": threads, "windows_per_s": round(float(np.median(rates)), 1),
        "slowest_and_fastest": [round(min(rates), 1), round(max(rates), 1)],
        "making_batches_ms_a_window": round(1000 * float(np.median(making)), 3),
        "parameters_million": round(sum(p.numel() for p in run.model.parameters()) / 1e6, 2),
    }  # fmt: skip


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--pieces", type=int, default=7)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
