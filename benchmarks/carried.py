"""Errors of the paths of moved objects on six synthetic clips.

    python benchmarks/carried.py --work carried_work [--told-height]

Makes the clips of `video2anim synth --preset carried --seed 0` in `<work>/truth`, runs the pipeline into
`<work>/results` (finished results are kept), and compares the path of every moved object of the truth with the nearest
estimated path, in the true world aligned by the shared camera (docs/evaluation.md, `carried`). Writes
`benchmarks/results/carried-<date>.json` and the table as `.md`. For comparison, each row has the error of the holding
wrist in the same frames, because one camera cannot observe the size, and so the distance, of a person. `--told-height`
gives the pipeline the true height of the main person.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
import platform
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from v2a_bench import call, number

from video2anim.body.anny_body import shaped_body
from video2anim.geometry.projection import transform_points
from video2anim.lab.eval.alignment import match_frames, truth_from_estimate
from video2anim.lab.eval.carried_rows import MovedObjects, moved_objects
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import Truth, read_truth
from video2anim.types import BodyTracks, RefinedMotion, SceneModel
from video2anim.types.skeleton import JOINT_INDEX

SEED = 0
HEADS = ("clip", "object", "found", "error, mean, m", "95 %, m", "wrist error, m", "hold error, frames", "false paths")


@dataclass(frozen=True, slots=True)
class ClipRow:
    """One moved object of a clip; errors are None if no path is matched."""

    clip: str
    label: str
    """Label of the true moved object."""
    found: bool
    path_mean_m: float | None
    path_p95_m: float | None
    wrist_mean_m: float | None
    """Error of the holding wrist in the frames in which the object is held in truth."""
    hold_error_frames: float | None
    """Mean absolute error of the first and the last held frame; None without an estimated hold."""
    false_paths: int


def main() -> None:
    """Make the clips, run the pipeline, compare, write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("carried_work"), help="clips and scene folders, kept")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--seed", type=int, default=SEED, help="seed of the clips; the published table has 0")
    parser.add_argument("--told-height", action="store_true", help="give the pipeline the main person's true height")
    options = parser.parse_args()
    truth = options.work / "truth"
    call("synth", "--preset", "carried", "--seed", str(options.seed), "--out", str(truth))
    rows: list[ClipRow] = []
    for name in [clip["name"] for clip in json.loads((truth / "set.json").read_text())["clips"]]:
        scene_dir = options.work / ("results_told" if options.told_height else "results") / name
        known = (
            ("--height-m", f"1={shaped_body(read_truth(truth / name).main.shape).height_m:.3f}")
            if options.told_height
            else ()
        )
        video = str(truth / name / "video.mp4")
        call("run", video, "--out", str(scene_dir), "--person", "all", "--until", "refine", *known)
        rows += of_clip(scene_dir, truth / name)
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": options.seed,
        "height told": options.told_height,
        "clips": [asdict(row) for row in rows],
        "means": means(rows),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"carried{'-told-height' if options.told_height else ''}-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    target.with_suffix(".md").write_text(f"Seed {options.seed}; {report['machine']}.\n\n{table(rows)}\n")
    sys.stdout.write(f"{table(rows)}\n{target}\n")


def of_clip(scene_dir: Path, truth_dir: Path) -> list[ClipRow]:
    """A row for each moved object of a clip."""
    result, truth = SceneResult(scene_dir), read_truth(truth_dir)
    scene, bodies = result.scene, result.bodies
    if scene is None or bodies is None or not bodies.people:
        raise SystemExit(f"{scene_dir}: {result.why(BodyTracks, SceneModel) or 'nobody was fitted'}")
    frames = match_frames(result.clip, truth)
    T_true_estimate = truth_from_estimate(bodies.main.T_world_camera, truth, frames)
    refined = result.get(RefinedMotion)
    main = (refined.people if refined else bodies.people)[0]
    joints_m = transform_points(T_true_estimate, main.joints_world_m.astype(np.float64))
    gap_m = np.linalg.norm(joints_m - truth.main.joints_world_m[frames.true_index], axis=-1)
    wrist_m = {}
    for item in truth.objects:
        if item.held is not None and item.hands is not None:
            held = item.held[frames.true_index] & frames.known
            wrist_m[item.object_id] = float(gap_m[held][:, np.flatnonzero(item.hands) + _LEFT_WRIST].mean())
    return clip_rows(truth, moved_objects(scene.objects, truth, frames, T_true_estimate), wrist_m)


def clip_rows(truth: Truth, found: MovedObjects, wrist_m: dict[int, float]) -> list[ClipRow]:
    """Rows of the matched objects; the clip's false paths are in the row of its first object."""
    rows = []
    for place, obj in enumerate(found.objects):
        present = obj.estimate_id is not None
        rows.append(
            ClipRow(
                truth.name, obj.label, present,
                float(obj.error_m.mean()) if present else None,
                float(np.percentile(obj.error_m, 95)) if present else None,
                wrist_m.get(obj.object_id),
                obj.hold_error_frames if math.isfinite(obj.hold_error_frames) else None,
                0 if place else found.false_paths,
            )
        )  # fmt: skip
    return rows


def means(rows: list[ClipRow]) -> dict[str, Any]:
    """Share found, means over the rows that have the number, sum of false paths."""
    values_by_key = {key: [getattr(row, key) for row in rows if getattr(row, key) is not None] for key in _AVERAGED}
    return {
        "found": float(np.mean([row.found for row in rows])) if rows else None,
        **{key: float(np.mean(values)) if values else None for key, values in values_by_key.items()},
        "false_paths": sum(row.false_paths for row in rows),
    }


_AVERAGED = ("path_mean_m", "path_p95_m", "wrist_mean_m", "hold_error_frames")
_LEFT_WRIST = JOINT_INDEX["left_wrist"]
"""The right wrist is the next joint."""


def table(rows: list[ClipRow]) -> str:
    """Markdown: one row per object, then the means."""
    lines = ["| " + " | ".join(HEADS) + " |", "|---" * len(HEADS) + "|"]
    for row in rows:
        cells = [_cell(getattr(row, key)) for key in _AVERAGED]
        lines.append(
            f"| {row.clip} | {row.label} | {'yes' if row.found else 'no'} | {' | '.join(cells)} | {row.false_paths} |"
        )
    mean = means(rows)
    cells = [_cell(mean[key]) for key in _AVERAGED]
    lines.append(f"| mean, sum | | {_cell(mean['found'])} | {' | '.join(cells)} | {mean['false_paths']} |")
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return "-" if value is None else number(value)


if __name__ == "__main__":
    main()
