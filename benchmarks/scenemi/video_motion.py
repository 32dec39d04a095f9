"""Table 4 of the paper on real noisy motion: in-betweening of what stage humans estimates from video.

    python benchmarks/scenemi/video_motion.py --scenes v2a=bench_work/results real=real_work \
        --truth bench_work/truth [--weights small] [--variant NAME=FILE ...]

`--scenes` takes groups of scene folders, as `v2a_bench.py` and `real_clips.py` leave them. Keyframes are every 15th
frame (paper) of the main person after stage metric, which puts the estimate of stage humans into the metric scene; they
carry the noise that stage refine assumes. The scene is that of stage scene. Rows:

- humans: the source itself, all frames;
- interpolation; scenemi; other weights by `--variant`;
- w/o scene, w/o noise awareness: scenemi without this condition when it samples (keyframes then count as exact);
- refined: the result of the pipeline, with keyframes every 5 frames and the solve.

Columns: skating (`gmd`), mean acceleration, jerk, share of frames with skin more than 1 cm inside the scene (floor
included), deepest penetration; with `--truth`, root-relative MPJPE and acceleration error in the camera. Means over
clips with 95 % intervals (bootstrap over clips). Writes `table_4.json` and `table_4.md`.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import bootstrap
from tables import named

from scenemi import metrics
from scenemi.data.files import write_json
from scenemi.evaluation.ablation import AblatedPrior
from scenemi.model.choice import INTERPOLATION, load_prior_by_name
from scenemi.model.prior import DiffusionPrior
from scenemi.prior import InbetweeningPrior
from stages.refine import RefineConfig
from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import posed_vertices
from video2anim.digest import file_digest
from video2anim.errors import StageError, Video2AnimError
from video2anim.geometry.sdf import SdfGrid
from video2anim.lab.eval.alignment import match_frames, match_people
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import read_truth
from video2anim.motion.movable_scene import scene_field
from video2anim.motion.observation import observation
from video2anim.motion.refinement import PriorConfig, fill_between
from video2anim.types import BodyMotion, MetricDepth, RefinedMotion, SceneModel
from video2anim.types.clip import FPS

INTERVAL = 15
"""Frames between keyframes (paper, Table 4)."""
SKIN_STEP = 7
"""Every seventh vertex of the skin is tested against the scene."""
DRAWS = 1000
COLUMNS = {
    "skating": "skating", "acceleration_m_s2": "acceleration, m/s2", "jerk_m_s3": "jerk, m/s3",
    "inside_1cm": "frames inside", "penetration_max_m": "deepest, m", "root_relative_m": "root-relative MPJPE, m",
    "acceleration_error_m_s2": "acceleration error, m/s2",
}  # fmt: skip


def main() -> None:
    """Fill, measure, write the table."""
    options = arguments()
    methods = methods_of(options)
    report: dict[str, Any] = {
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, Python {platform.python_version()}",
        "date": datetime.date.today().isoformat(), "seed": 0, "interval": INTERVAL, "weights": digests(options),
        "groups": {},
    }  # fmt: skip
    for group, folder in options.scenes:
        rows = {}
        for scene in sorted(path.parent for path in folder.glob("*/run.json")):
            try:
                rows[scene.name] = of_clip(scene, methods, options.truth)
            except Video2AnimError as problem:
                sys.stderr.write(f"{scene.name} left out: {problem}\n")
                continue
            sys.stderr.write(f"{scene.name} {rows[scene.name]['scenemi']}\n")
        report["groups"][group] = rows
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "table_4.json", report)
    (options.out / "table_4.md").write_text(text := markdown(report), encoding="utf-8")
    sys.stdout.write(text)


def methods_of(options: argparse.Namespace) -> dict[str, tuple[InbetweeningPrior, bool]]:
    """Prior of each row, and whether it is given the noise of the keyframes."""
    ours = load_prior_by_name(options.weights)
    assert isinstance(ours, DiffusionPrior)
    others = {name: (load_prior_by_name(file), True) for name, file in options.variant}
    return {
        "interpolation": (load_prior_by_name(INTERPOLATION), True), **others, "scenemi": (ours, True),
        "w/o scene": (AblatedPrior(ours, use_scene=False), True), "w/o noise awareness": (ours, False),
    }  # fmt: skip


def of_clip(
    folder: Path, methods: dict[str, tuple[InbetweeningPrior, bool]], truths: Path | None
) -> dict[str, dict[str, float]]:
    """Numbers of every row for one scene folder.

    Raises:
        StageError: a stage is missing, or the main person has no valid frame.
    """
    result = SceneResult(folder)
    depth, scene, refined = result.get(MetricDepth), result.get(SceneModel), result.get(RefinedMotion)
    if depth is None or scene is None or refined is None:
        raise StageError(result.why(MetricDepth, SceneModel, RefinedMotion))
    source, field = depth.bodies.main, scene_field(scene)
    if not source.valid.any():
        raise StageError("the main person has no valid frame")
    truth = None
    if truths and (truths / folder.name).is_dir():
        known = read_truth(truths / folder.name)
        for pair in match_people([source], known, match_frames(result.clip, known)):
            truth = known.people[pair.truth]
    made = {"humans": source} | {
        name: filled(source, prior, field, noisy=noisy) for name, (prior, noisy) in methods.items()
    }
    numbers = {name: measured(motion, source, field, truth) for name, motion in made.items()}
    numbers["refined"] = measured(refined.people[0], source, scene_field(refined.scene), truth)
    return numbers


def filled(source: BodyMotion, prior: InbetweeningPrior, field: SdfGrid, *, noisy: bool) -> BodyMotion:
    """The source between its keyframes as the prior makes it."""
    config = RefineConfig()
    noise = (config.keyframe_noise_deg, config.keyframe_noise_cm) if noisy else (0.0, 0.0)
    found, _ = fill_between(source, observation(source, ()), prior, field, PriorConfig(INTERVAL, noise))
    return source.with_pose(translation_world_m=found.translation_world_m, R_parent_joint=found.R_parent_joint)


def measured(motion: BodyMotion, source: BodyMotion, field: SdfGrid, truth: BodyMotion | None) -> dict[str, float]:
    """Numbers of one motion from the first to the last valid frame of the source."""
    valid = np.flatnonzero(source.valid)
    span = np.arange(valid[0], valid[-1] + 1)
    body, joints_m = shaped_body(motion.shape), motion.joints_world_m[span]
    distance_m = field.sample(posed_vertices(motion, body, np.arange(0, len(body.rest_vertices_m), SKIN_STEP), span))
    acceleration = np.linalg.norm(np.diff(joints_m, n=2, axis=0), axis=-1).mean() * FPS**2
    found = {
        "skating": metrics.foot_skating_gmd(joints_m, FPS),
        "acceleration_m_s2": float(acceleration),
        "jerk_m_s3": metrics.jerk_m_s3(joints_m, FPS),
        "inside_1cm": metrics.collision_frame_ratio(distance_m, metrics.COLLISION_TAUS_M[1]),
        "penetration_max_m": metrics.penetration_max_m(distance_m),
    }
    if truth is None:
        return found
    seen_m, true_m = motion.joints_camera_m[span], truth.joints_camera_m[span]
    return found | {
        "root_relative_m": metrics.root_relative_mpjpe(seen_m, true_m),
        "acceleration_error_m_s2": metrics.acceleration_error_m_s2(seen_m, true_m, FPS),
    }


def markdown(report: dict[str, Any]) -> str:
    """The report as Markdown, a table for each group."""
    lines = [
        f"Keyframes every {report['interval']} frames; {report['machine']}, {report['date']}, seed {report['seed']}. "
        "Means over clips with 95 % intervals."
    ]
    for group, clips in report["groups"].items():
        rows = list(next(iter(clips.values()), {}))
        columns = [key for key in COLUMNS if any(key in numbers["humans"] for numbers in clips.values())]
        heads = " | ".join(COLUMNS[key] for key in columns)
        lines += ["", f"**{group}**, {len(clips)} clips", "", f"| | {heads} |", "|---" * (len(columns) + 1) + "|"]
        for row in rows:
            values = [[numbers[row].get(key, np.nan) for numbers in clips.values()] for key in columns]
            lines.append(f"| {row} | " + " | ".join(map(cell, values)) + " |")
    return "\n".join(lines) + "\n"


def cell(values: Sequence[float]) -> str:
    """Mean and its 95 % interval over clips."""
    known = np.array([value for value in values if not np.isnan(value)])
    found = bootstrap((known,), np.mean, n_resamples=DRAWS, method="percentile", rng=0).confidence_interval
    return f"{known.mean():.3g} [{found.low:.3g}, {found.high:.3g}]"


def digests(options: argparse.Namespace) -> dict[str, str]:
    """SHA-256 of the weights of each row."""
    ours: Any = load_prior_by_name(options.weights)
    return {"scenemi": file_digest(ours.model.path)} | {name: file_digest(Path(file)) for name, file in options.variant}


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", type=lambda t: (named(t)[0], Path(named(t)[1])), required=True)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--weights", default="small")
    parser.add_argument("--variant", type=named, action="append", default=[])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
