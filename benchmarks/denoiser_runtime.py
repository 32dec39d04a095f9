"""Torch against onnxruntime on the CPU: one evaluation of the denoiser, and what it takes to get ready.

    python benchmarks/denoiser_runtime.py --out benchmarks/results

The batch is what guidance needs for one window: 2 x 121 frames. Both run in turn, so that other load of the machine
meets both; `cpu` is the process's own time, which such load changes less than the wall clock. Weights are random unless
a file is given: they change no time.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from scenemi.model.config import SIZES
from scenemi.model.denoiser import Conditions, Denoiser
from scenemi.model.onnx_denoiser import OnnxDenoiser, to_onnx
from scenemi.model.weights import load_weights

BATCH = 2
SEED = 0


def main() -> None:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--runs", type=int, default=25)
    parser.add_argument("--size", default="small", choices=sorted(SIZES))
    parser.add_argument("--weights", type=Path, help="a weights file instead of random weights of a size")
    options = parser.parse_args()
    torch.manual_seed(SEED)
    denoiser = load_weights(options.weights).denoiser if options.weights else random_weights(options.size)
    start = time.perf_counter()
    graph = to_onnx(denoiser)
    export_s = time.perf_counter() - start
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "torch": torch.__version__,
        "seed": SEED,
        "batch": [BATCH, denoiser.config.window_frames],
        "parameters": sum(p.numel() for p in denoiser.parameters()),
        "runs": options.runs,
        "export_s": export_s,
        "graph_bytes": len(graph),
        "threads": [measured(denoiser, graph, threads, options.runs) for threads in (1, 2)],
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"denoiser_runtime-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(report) + f"\n{target}\n")


def random_weights(size: str) -> Denoiser:
    """No weight is zero, as those of a new model are."""
    denoiser = Denoiser(SIZES[size]).eval()
    for parameter in denoiser.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    return denoiser


def measured(denoiser: Denoiser, graph: bytes, threads: int, runs: int) -> dict[str, Any]:
    """Median seconds of both, and how far their results lie apart."""
    torch.set_num_threads(threads)
    start = time.perf_counter()
    exported = OnnxDenoiser(denoiser, threads=threads, graph=graph)
    session_s = time.perf_counter() - start
    x, t, given = inputs(denoiser)
    calls: dict[str, Callable[[], Any]] = {
        "torch": lambda: denoiser(x, t, given),
        "onnxruntime": lambda: exported(x, t, given),
    }
    with torch.inference_mode():
        difference = float((calls["torch"]() - calls["onnxruntime"]()).abs().max())
        times: dict[str, list[tuple[float, float]]] = {
            name: [timed(call) for _ in range(2)] for name, call in calls.items()
        }
        for _ in range(runs):
            for name, call in calls.items():
                times[name].append(timed(call))
    row: dict[str, Any] = {"threads": threads, "session_s": session_s, "largest_difference": difference}
    for name, pairs in times.items():
        wall_s, cpu_s = zip(*pairs[2:], strict=True)
        row[name] = {"wall_s": statistics.median(wall_s), "wall_best_s": min(wall_s), "cpu_s": statistics.median(cpu_s)}
    return row


def inputs(denoiser: Denoiser) -> tuple[torch.Tensor, torch.Tensor, Conditions]:
    """Random arguments; half the batch without the scene."""
    config = denoiser.config
    frames, features = config.window_frames, config.feature_count
    given = Conditions(
        mask=(torch.arange(frames) % 15 == 0).float().repeat(BATCH, 1),
        imputed=(torch.arange(frames) % 15 == 0).float().repeat(BATCH, 1),
        base=torch.randn(BATCH, frames, features),
        local=torch.randn(BATCH, frames, config.bps_anchors, 3),
        body=torch.randn(BATCH, config.body_lengths),
        noise_level=torch.zeros(BATCH),
        scene=torch.randn(BATCH, config.embedding),
        scene_known=torch.tensor([1.0, 0.0]),
        local_known=torch.ones(BATCH),
    )
    return torch.randn(BATCH, frames, features), torch.full((BATCH,), 500), given


def timed(call: Callable[[], Any]) -> tuple[float, float]:
    """Wall and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def table(report: dict[str, Any]) -> str:
    """Markdown."""
    lines = [
        f"{report['machine']}, torch {report['torch']}; {report['parameters'] / 1e6:.1f} M parameters, batch "
        f"{report['batch'][0]} x {report['batch'][1]}; export {report['export_s']:.1f} s, "
        f"{report['graph_bytes'] / 1e6:.1f} MB",
        "",
        "| threads | torch wall (ms) | onnxruntime wall (ms) | torch cpu (ms) | onnxruntime cpu (ms) | difference | "
        "session (s) |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in report["threads"]:
        a, b = row["torch"], row["onnxruntime"]
        lines.append(
            f"| {row['threads']} | {1e3 * a['wall_s']:.1f} | {1e3 * b['wall_s']:.1f} | {1e3 * a['cpu_s']:.1f} | "
            f"{1e3 * b['cpu_s']:.1f} | {row['largest_difference']:.1e} | {row['session_s']:.2f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
