"""What each loss of stage keyframes is good for: every one left out in turn; turns and leg inverse kinematics added.

    video2anim synth --preset bench --seed 0 --motion cmu.npz --motion deepmimic.npz --count 6 --out bench_work/truth
    python benchmarks/keyframe_losses.py --work bench_work

`--work` is laid out as `v2a_bench.py` leaves it: clips in truth/, scene folders in results/; scenes that are missing
are made up to stage scene. Bodies are compared with the truth on the frames that `video2anim eval` takes, all variants
beside the raw motion. Touching parts are those that truly touch; their distance is the one that the stage brings down,
to the clip's own scene. Time is that of the whole stage with the body model loaded, per keyframe. With `--refined`
every variant goes through stage refine too. Writes Markdown and JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from metric_evidence import mean
from v2a_bench import SEED, call, number

from scenemi.metrics import ROOT
from stages.keyframes import KeyframesConfig, optimize_keyframes
from stages.refine import RefineConfig, refine_motion
from video2anim.body.anny_body import shaped_body
from video2anim.eval.alignment import match_frames, match_people, truth_from_estimate
from video2anim.eval.motion_rows import CommonFrames, common_frames, motion_group
from video2anim.eval.results import SceneResult
from video2anim.eval.scene_rows import BodyInScenes
from video2anim.eval.true_scene import true_field
from video2anim.eval.truth import read_truth
from video2anim.fitting.keyframe_points import TOUCHING, SkinSample
from video2anim.fitting.keyframe_roots import contact_distance_m
from video2anim.fitting.keyframe_sight import across_sight_m, sight_of
from video2anim.geometry.sdf import SdfGrid
from video2anim.pipeline.stage import StageContext
from video2anim.types import BackgroundPlate, BodyMotion, BodyTracks, KeyframedMotion, MetricDepth, SceneModel

RAW = "raw"
ROOT_ONLY: dict[str, Any] = {"yaw": False, "leg_ik": False}
VARIANTS: dict[str, dict[str, Any]] = {
    "root only": ROOT_ONLY,
    "no regularization": ROOT_ONLY | {"weight_regularization": 0.0, "weight_regularization_across": 0.0},
    "no contact": ROOT_ONLY | {"weight_contact": 0.0},
    "no penetration": ROOT_ONLY | {"weight_penetration": 0.0},
    "no smoothness": ROOT_ONLY | {"weight_displacement_change": 0.0, "weight_acceleration": 0.0},
    "no depth": ROOT_ONLY | {"weight_depth": 0.0},
    "no picture limit": ROOT_ONLY | {"picture_limit_ratio": 10.0},
    "+ yaw": ROOT_ONLY | {"yaw": True},
    "+ leg IK": ROOT_ONLY | {"leg_ik": True},
    "+ yaw + leg IK": {"yaw": True, "leg_ik": True},
}
EVAL_ROWS = (
    ("own_scene", "collision_frames_1cm"), ("own_scene", "penetration_max"),
    ("true_scene", "collision_frames_1cm"), ("true_scene", "penetration_max"),
    ("true_scene_laid", "collision_frames_1cm"), ("true_scene_laid", "penetration_max"),
    ("motion", "mpjpe"), ("motion", "w_mpjpe"), ("motion", "root_error"), ("motion", "acceleration_error"),
    ("motion", "jerk"), ("motion", "skating_gmd"),
)  # fmt: skip
COLUMNS = (
    ("own_scene collision_frames_1cm", "frames > 1 cm inside, own scene", 1),
    ("own_scene penetration_max", "deepest, own, cm", 100),
    ("true_scene_laid collision_frames_1cm", "frames > 1 cm inside, true scene", 1),
    ("true_scene_laid penetration_max", "deepest, true, cm", 100),
    ("touching_m", "touching parts off, cm", 100),
    ("motion w_mpjpe", "W-MPJPE, mm", 1000),
    ("motion root_error", "root, m", 1),
    ("motion acceleration_error", "acceleration error, m/s²", 1),
    ("motion jerk", "jerk, m/s³", 1),
    ("motion skating_gmd", "skating `gmd`", 1),
    ("across_mean_m", "across the sight, mean, cm", 100),
    ("across_max_m", "greatest, cm", 100),
)


@dataclass(frozen=True, slots=True)
class Timed:
    """People after one variant of the stage (and perhaps refine), and what the stage took."""

    people: tuple[BodyMotion, ...]
    keyframe_index: tuple[np.ndarray, ...]
    wall_s: list[float]
    cpu_s: list[float]
    """Per keyframe, every repetition."""


def main() -> None:
    """Run, compare, write."""
    options = arguments()
    rows: list[dict[str, Any]] = []
    for truth in sorted(path.parent for path in (options.work / "truth").glob("*/meta.json"))[: options.clips]:
        scene = options.work / "results" / truth.name
        if not list(scene.glob("stages/*_scene/manifest.json")):
            words = ("--person", "all", "--until", "scene", "--overwrite")
            call("run", str(truth / "video.mp4"), "--out", str(scene), *words)
        found = of_clip(scene, truth, options)
        rows += found
        for row in found:
            sys.stderr.write(json.dumps(row) + "\n")
    names = list(dict.fromkeys(row["variant"] for row in rows))
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "load_average": os.getloadavg(),
        "seed": SEED,
        "clips": sorted({row["clip"] for row in rows}),
        "means": {name: means([row for row in rows if row["variant"] == name]) for name in names},
        "rows": rows,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"keyframe_losses{'-refined' if options.refined else ''}-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(f"{table(report)}\n{target}\n")


def of_clip(scene_dir: Path, truth_dir: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """One row per matched person and variant."""
    result, truth = SceneResult(scene_dir), read_truth(truth_dir)
    frames = match_frames(result.clip, truth)
    bodies, scene = result.get(BodyTracks), result.get(SceneModel)
    depth, plate = result.get(MetricDepth), result.get(BackgroundPlate)
    if bodies is None or scene is None or depth is None or plate is None:
        sys.exit(f"{scene_dir}: {result.why(BodyTracks, SceneModel, MetricDepth, BackgroundPlate)}")
    field, own = true_field(truth), SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    shaped_body(bodies.people[0].shape)
    made = {RAW: Timed(bodies.people, (), [], [])}
    for name in options.variants:
        config = replace(KeyframesConfig(), **VARIANTS[name])
        made[name] = timed(bodies, scene, depth, plate, config, options.repeats)
    for name in options.variants if options.refined else ():
        keyframed = KeyframedMotion(made[name].people, made[name].keyframe_index)
        done = refine_motion(keyframed, scene, RefineConfig(), StageContext(Path()))
        made[f"{name}, refined"] = Timed(done.people, (), [], [])
    rows = []
    for match in match_people(bodies.people, truth, frames):
        person, raw = truth.people[match.truth], bodies.people[match.estimate]
        stages: dict[str, BodyMotion | str] = {name: one.people[match.estimate] for name, one in made.items()}
        common = common_frames(raw, person, frames)
        T_true_estimate = truth_from_estimate(raw.T_world_camera, truth, frames)
        groups = (
            motion_group(stages, person, common, T_true_estimate, truth.fps),
            *BodyInScenes(stages, person, common, T_true_estimate, field, scene).groups(),
        )
        for column, (name, one) in enumerate(made.items()):
            motion = one.people[match.estimate]
            values = {f"{g.key} {row.key}": row.values[column] for g in groups for row in g.rows}
            rows.append(
                {"clip": truth.name, "person": raw.person_id, "variant": name}
                | {f"{group} {key}": values[f"{group} {key}"] for group, key in EVAL_ROWS}
                | {"touching_m": touching_m(motion, person, common, own)}
                | across(raw, motion)
                | {"wall_s": one.wall_s, "cpu_s": one.cpu_s}
            )
    return rows


def timed(
    bodies: BodyTracks,
    scene: SceneModel,
    depth: MetricDepth,
    plate: BackgroundPlate,
    config: KeyframesConfig,
    repeats: int,
) -> Timed:
    """The stage, run so often; it gives the same every time."""
    done, walls, cpus = KeyframedMotion((), ()), [], []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        done = optimize_keyframes(bodies, scene, depth, plate, config, StageContext(Path()))
        keyframes = max(1, sum(len(index) for index in done.keyframe_index))
        walls.append((time.perf_counter() - wall) / keyframes)
        cpus.append((time.process_time() - cpu) / keyframes)
    return Timed(done.people, done.keyframe_index, walls, cpus)


def touching_m(motion: BodyMotion, truth: BodyMotion, common: CommonFrames, own: SdfGrid) -> float | None:
    """Mean distance of truly touching parts to the clip's own scene."""
    config = KeyframesConfig()
    sample = SkinSample(shaped_body(motion.shape), spread=1, per_part=config.vertices_per_contact_part)
    truly = truth.contact[common.true_index[common.measured]] > 0.5
    skin = sample.on(motion)
    gaps_m = [
        np.abs(contact_distance_m(skin.touching_m(joints)[common.measured][touches], own, config.contact_points))
        for joints in TOUCHING
        if (touches := truly[:, joints].any(axis=1)).any()
    ]
    return float(np.concatenate(gaps_m).mean()) if gaps_m else None


def across(raw: BodyMotion, moved: BodyMotion) -> dict[str, float]:
    """How far roots went from where the picture shows them."""
    valid = np.flatnonzero(raw.valid)
    sight = sight_of(raw, valid, stature_m=1.0, limit_ratio=0.0, reprojection_px=0.0)
    shift_m = (moved.joints_world_m - raw.joints_world_m)[valid, ROOT]
    length_m = across_sight_m(shift_m, sight.direction)
    return {"across_mean_m": float(length_m.mean()), "across_max_m": float(length_m.max())}


def means(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Over persons and clips; times are medians."""
    keys = [key for key in rows[0] if key not in ("clip", "person", "variant", "wall_s", "cpu_s")]
    found = {key: mean([row[key] for row in rows]) for key in keys}
    for key in ("wall_s", "cpu_s"):
        every = [value for row in rows for value in row[key]]
        if every:
            found[key] = float(np.median(every))
    return found


def table(report: dict[str, Any]) -> str:
    """Markdown, a line per variant."""
    titles = [title for _, title, _ in COLUMNS]
    lines = [
        f"{len(report['clips'])} clips of V2A-Bench; {report['machine']}, load {report['load_average'][0]:.1f}, "
        f"{report['date']}, seed {report['seed']}",
        "",
        "| | " + " | ".join([*titles, "s per keyframe, wall", "CPU"]) + " |",
        "|---" * (len(titles) + 3) + "|",
    ]
    for name, row in report["means"].items():
        cells = [number(factor * row[key]) for key, _, factor in COLUMNS]
        times = [number(row[key]) if key in row else "" for key in ("wall_s", "cpu_s")]
        lines.append(f"| {name} | " + " | ".join([*cells, *times]) + " |")
    return "\n".join(lines)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder with truth/ and results/, kept")
    parser.add_argument("--clips", type=int, default=6, help="the first so many clips")
    parser.add_argument("--repeats", type=int, default=1, help="times that every variant is run and timed")
    parser.add_argument("--variants", nargs="*", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--refined", action="store_true", help="every variant goes through stage refine too")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
