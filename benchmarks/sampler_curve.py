"""Quality of fast samplers compared with the paper's 1000 steps, on the same test windows and seeds.

    python benchmarks/sampler_curve.py --clips cmu.npz --split split.json --weights small --interval 30

Every row is one sampler; errors are means over the windows, and `to 1000` compares MJPE all with DDPM's 1000 steps. No
scene, and keyframes without noise unless `--noise` is given.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any

import torch

from scenemi.data.container import MotionArchive, read_split
from scenemi.evaluation.protocol import evaluate
from scenemi.evaluation.windows import EvaluationWindow, KeyframeProtocol, cut_windows
from scenemi.model.prior import DiffusionPrior
from scenemi.model.sampling import SamplerConfig
from scenemi.model.weights import LoadedModel, load_weights

SAMPLERS: tuple[tuple[str, int, float], ...] = (
    ("ddpm", 1000, 1.0),
    *(("dpm-solver++", steps, 1.5) for steps in (1, 2)),
    *(("ddim", steps, 1.5) for steps in (5, 10, 20, 50)),
    *(("dpm-solver++", steps, spacing) for steps in (5, 10, 20, 50) for spacing in (1.0, 1.5, 2.0)),
    *(("ddpm", steps, 1.5) for steps in (20, 50)),
)
"""Method, steps, spacing; the first is the reference."""


def main() -> None:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=Path, required=True, help="archive of motion clips")
    parser.add_argument("--split", type=Path, help="split.json: only its test part is used")
    parser.add_argument("--weights", default="small")
    parser.add_argument("--interval", type=int, default=30)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--windows", type=int, default=32, help="maximum number of windows, spread over all clips")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    names = read_split(options.split)["test"] if options.split else None
    windows = cut_windows([MotionArchive.read(options.clips)], names)
    chosen = [windows[i * len(windows) // options.windows] for i in range(options.windows)]
    chosen = chosen if options.windows < len(windows) else list(windows)
    protocol = KeyframeProtocol(options.interval, noise=options.noise, seed=options.seed)
    model = load_weights(options.weights, device=options.device)
    rows = [measured(model, sampler, chosen, protocol, options.device, options.seed) for sampler in SAMPLERS]
    for row in rows:
        row["to_1000"] = row["mjpe_all_m"] / rows[0]["mjpe_all_m"]
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {options.device}, torch {torch.__version__}",
        "weights": model.path.name,
        "windows": len(chosen),
        "interval": options.interval,
        "noise": options.noise,
        "seed": options.seed,
        "rows": rows,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"sampler_curve-r{options.interval}-l{options.noise:g}-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(report) + f"\n{target}\n")


def measured(
    model: LoadedModel,
    sampler: tuple[str, int, float],
    windows: list[EvaluationWindow],
    protocol: KeyframeProtocol,
    device: str,
    seed: int,
) -> dict[str, Any]:
    """The numbers of one sampler."""
    method, steps, spacing = sampler
    config = SamplerConfig(method, steps, spacing=spacing)  # type: ignore[arg-type]
    found = evaluate(windows, DiffusionPrior(model, config, device=device), protocol, seed=seed)
    return {"method": method, "steps": steps, "spacing": spacing, **found.summary()}


def table(report: dict[str, Any]) -> str:
    """Markdown."""
    lines = [
        f"{report['machine']}; {report['weights']}, {report['windows']} windows, keyframes every {report['interval']}, "
        f"noise {report['noise']:g}",
        "",
        "| method | steps | spacing | MJPE all (cm) | to 1000 | jerk (m/s^3) | truth | skating gmd | s / window |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['method']} | {row['steps']} | {row['spacing']:g} | {100 * row['mjpe_all_m']:.2f} | "
        f"{row['to_1000']:.3f} | {row['jerk_m_s3']:.0f} | {row['jerk_truth_m_s3']:.0f} | {row['skating_gmd']:.3f} | "
        f"{row['seconds_per_window']:.2f} |"
        for row in report["rows"]
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
