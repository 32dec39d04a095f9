"""Time of stage refine per window of 121 frames, by parts, and its memory for long clips.

    python benchmarks/refine_time.py --scenes real_work/ocv_sts real_work/gvhmr_tennis [--repeats 5]
    python benchmarks/refine_time.py --scenes real_work/ocv_sts --frames 4500 --repeats 1

The stage runs in this process on its inputs in scene folders, with the threads of the environment (`OMP_NUM_THREADS`
and the like). A first run, which loads models and imports, is not counted. Wall and processor seconds are medians over
the repeats; parts are wall seconds of the median run. `--frames` repeats the motion forward and backward up to that
length. Peak memory is that of the process, including the scene and the models.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from stages import refine
from video2anim.lab.eval.results import SceneResult
from video2anim.motion import refinement
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, BodyTracks, KeyframedMotion, MetricDepth, SceneModel
from video2anim.types.clip import FPS

WINDOW = 121
PARTS = {
    "fields": (refinement, "movable_solids"), "prior": (refinement, "_filled"),
    "solves": (refinement, "solve_motions"), "scene moved": (refinement, "moved_scene"), "report": (refine, "_report"),
}  # fmt: skip
"""Function that does each part."""


def main() -> None:
    """Time the stage on each scene, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", type=Path, nargs="+", required=True, help="scene folders, finished up to stage keyframes"
    )
    parser.add_argument("--frames", type=int, help="length of the motions in frames; their own by default")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    spent = watch()
    rows = [of_scene(folder, options, spent) for folder in options.scenes]
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "not set"), "load_1_min": os.getloadavg()[0],
        "repeats": options.repeats, "rows": rows,
    }  # fmt: skip
    length = f"-{options.frames}_frames" if options.frames else ""
    (options.out / f"refine_time-{report['date']}{length}.json").write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(rows) + "\n")


def watch() -> dict[str, float]:
    """Wrap every part with a timer. Returns the seconds per part, which the timers update."""
    spent = dict.fromkeys(PARTS, 0.0)

    def clocked(part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return work(*args, **options)
            finally:
                spent[part] += time.perf_counter() - start

        return timed

    for part, (module, name) in PARTS.items():
        setattr(module, name, clocked(part, getattr(module, name)))
    return spent


def of_scene(folder: Path, options: argparse.Namespace, spent: dict[str, float]) -> dict[str, Any]:
    """The row of one scene."""
    result = SceneResult(folder)
    bodies, keyframed, scene = result.get(BodyTracks), result.get(KeyframedMotion), result.get(SceneModel)
    depth = result.get(MetricDepth)
    if bodies is None or depth is None or keyframed is None or scene is None:
        raise SystemExit(f"{folder}: {result.why(BodyTracks, MetricDepth, KeyframedMotion, SceneModel)}")
    if options.frames:
        bodies = replace(bodies, people=tuple(longer(one, options.frames) for one in bodies.people))
        keyframed = replace(keyframed, people=tuple(longer(one, options.frames) for one in keyframed.people))
    frames = bodies.people[0].frame_count
    windows = max(1.0, frames / WINDOW)
    runs = []
    for _ in range(options.repeats + 1):
        spent.update(dict.fromkeys(spent, 0.0))
        wall, processor = time.perf_counter(), time.process_time()
        with tempfile.TemporaryDirectory() as work:
            refine.refine_motion(bodies, depth, keyframed, scene, refine.RefineConfig(), StageContext(Path(work)))
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        runs.append({"wall": wall, "processor": processor} | spent)
    runs = sorted(runs[1:], key=lambda run: run["wall"])
    center = runs[len(runs) // 2]
    processor = float(np.median([run["processor"] for run in runs]))
    return {
        "scene": folder.name, "frames": frames, "people": len(bodies.people), "objects": len(scene.objects),
        "seconds_per_window": {name: value / windows for name, value in (center | {"processor": processor}).items()},
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }  # fmt: skip


def longer(motion: BodyMotion, frames: int) -> BodyMotion:
    """A motion repeated forward and backward up to `frames` frames."""
    own = motion.frame_count
    there_and_back = np.r_[0:own, own - 2 : 0 : -1]
    order = there_and_back[np.arange(frames) % len(there_and_back)]
    values = {field.name: getattr(motion, field.name) for field in fields(motion) if field.name != "rest_joints_m"}
    values = {name: value[order] for name, value in values.items() if isinstance(value, np.ndarray)}
    return replace(motion, **values | {"frame_time_s": np.arange(frames) / FPS})


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    names = list(rows[0]["seconds_per_window"])
    heads = ["scene", "frames", "people", "objects", *names, "peak, MB"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in rows:
        seconds = [f"{row['seconds_per_window'][name]:.2f}" for name in names]
        cells = [row["scene"], row["frames"], row["people"], row["objects"], *seconds, f"{row['peak_mb']:.0f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
