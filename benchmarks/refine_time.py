"""What stage refine takes per window, and where.

    video2anim run CLIP.mp4 --out scenes/clip
    python benchmarks/refine_time.py --scenes scenes/* --out benchmarks/results

Each scene folder is refined once to load everything, then `--repeat` times; people with keyframes count. A window is
121 frames, of which the fallback may fill some up to three times. Writes Markdown and JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenemi import longmotion
from stages.refine import RefineConfig, refine_motion
from video2anim.eval.results import SceneResult
from video2anim.pipeline.stage import StageContext
from video2anim.types import KeyframedMotion, SceneModel

COLUMNS = ("clip", "people", "windows", "fills", "s", "s per window")


def main() -> None:
    """Time and write."""
    options = arguments()
    torch.set_num_threads(options.threads)
    rows = [of_scene(folder, options) for folder in options.scenes]
    windows = sum(row["windows"] for row in rows)
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "load_average": os.getloadavg(), "threads": options.threads, "repeat": options.repeat,
        "s per window": sum(row["s"] for row in rows) / windows,
        "s per fill": sum(row["s"] for row in rows) / sum(row["fills"] for row in rows),
        "rows": rows,
    }  # fmt: skip
    if options.out:
        target = options.out / f"refine_time-{report['date']}.json"
        target.write_text(json.dumps(report, indent=1) + "\n")
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + " --- |" * len(COLUMNS)]
    lines += ["| " + " | ".join(_cell(row[name]) for name in COLUMNS) + " |" for row in rows]
    sys.stdout.write("\n".join([*lines, f"\n{report['s per window']:.2f} s per window"]) + "\n")


def of_scene(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Median time of the stage on one scene folder."""
    result = SceneResult(folder)
    keyframed, scene = result.get(KeyframedMotion), result.get(SceneModel)
    if keyframed is None or scene is None:
        raise SystemExit(f"{folder}: {result.why(KeyframedMotion, SceneModel)}")
    windows, fills = counted(keyframed, scene)
    took = []
    for _ in range(options.repeat):
        start = time.perf_counter()
        refine_motion(keyframed, scene, RefineConfig(), StageContext(folder))
        took.append(time.perf_counter() - start)
    s = float(np.median(took))
    return {
        "clip": folder.name, "people": len(keyframed.people), "windows": windows, "fills": fills, "s": s,
        "s per window": s / max(windows, 1), "all s": took,
    }  # fmt: skip


def counted(keyframed: KeyframedMotion, scene: SceneModel) -> tuple[int, int]:
    """Windows of a refinement, and how often one was filled by the diffusion prior (the plain interpolation and
    windows that keep their observed frames need next to nothing)."""
    spans, filled = [], []
    inner = longmotion._filled

    def spy(span: Any, motion: Any, done: Any, prior: Any, scene: Any) -> Any:
        if prior.name == "scenemi":
            spans.append((id(motion.rest_joints_m), span.start))
            filled.append(motion.noise_level > 0)
        return inner(span, motion, done, prior, scene)

    longmotion._filled = spy
    try:
        refine_motion(keyframed, scene, RefineConfig(), StageContext(Path()))
    finally:
        longmotion._filled = inner
    return len(set(spans)), sum(filled)


def _cell(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", required=True, help="scene folders")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder of the JSON")
    return parser.parse_args()


if __name__ == "__main__":
    main()
