"""V2A-Bench: makes the clips (or reuses them), runs the pipeline on each, and compares the results with the truth.

    python benchmarks/v2a_bench.py --motion ../shared/motion/cmu.npz ../shared/motion/deepmimic.npz

Writes `benchmarks/results/v2a_bench-<date>.json` and puts the table between the marks in README.md. Clips are those of
`video2anim synth --preset bench --seed 0`. Without --motion, captured walks are replaced by the gait model; this is
another set of clips, and the report says so. Clips and scene folders are cached in --work, so an interrupted run
continues where it stopped.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from scenemi import metrics
from video2anim.body.anny_body import shaped_body
from video2anim.geometry.projection import transform_points
from video2anim.lab.eval.alignment import match_frames, match_people, truth_from_estimate
from video2anim.lab.eval.motion_rows import CommonFrames, common_frames
from video2anim.lab.eval.object_rows import scene_objects
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import read_truth
from video2anim.types import BodyMotion, BodyTracks, RefinedMotion

SEED = 0
MARKS = ("<!-- v2a-bench -->", "<!-- /v2a-bench -->")
RECORDED = Path(__file__).with_name("v2a_bench_digests.json")


def main() -> None:
    """Make, run, evaluate, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="*", default=[])
    parser.add_argument("--work", type=Path, default=Path("bench_work"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--count", type=int, help="use only the first COUNT clips; no README table then")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="number of clips processed in parallel"
    )
    parser.add_argument(
        "--set", nargs="*", default=[], metavar="STAGE.OPTION=VALUE", help="an ablation; no README table then"
    )
    parser.add_argument(
        "--given-height", action="store_true", help="give everybody's true body height; no README table then"
    )
    parser.add_argument("--record", action="store_true", help="write the digests of the clips beside this script")
    options = parser.parse_args()
    truth, results = options.work / "truth", options.work / "results"
    made = make(options, truth)
    with ThreadPoolExecutor(options.workers) as pool:
        jobs = [
            pool.submit(run_pipeline, truth / clip["name"], results / clip["name"], options) for clip in made["clips"]
        ]
        for job in jobs:
            job.result()
    report_json, report_html = options.work / "eval.json", options.work / "eval.html"
    words = ["--workers", str(options.workers), "--json", str(report_json), "--html", str(report_html)]
    call("eval-set", str(results), "--truth", str(truth), *words)
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": SEED,
        "benchmark": made["benchmark"],
        "generator": made["generator"],
        "motion_sources": made["motion_sources"],
        "clip_digests": {clip["name"]: clip["truth.npz"] for clip in made["clips"]},
        "settings": options.set,
        "given_height": options.given_height,
        "same_clips_as_recorded": same_as_recorded(made),
        "cost": cost(results, [clip["name"] for clip in made["clips"]]),
        "objects": objects(truth, results, [clip["name"] for clip in made["clips"]]),
        "prior": prior_at_work(truth, results, [clip["name"] for clip in made["clips"]]),
        "evaluation": json.loads(report_json.read_text()),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"v2a_bench{'-given-height' if options.given_height else ''}-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    if options.record:
        RECORDED.write_text(json.dumps({k: made[k] for k in ("benchmark", "motion_sources", "clips")}, indent=1) + "\n")
    if not (options.count or options.set or options.given_height):
        put_table(Path("README.md"), tables(report))
    sys.stdout.write(f"{tables(report)}\n\n{prior_table(report['prior'])}\n{target}\n{report_html}\n")


def make(options: argparse.Namespace, truth: Path) -> dict[str, Any]:
    """Make the clips of the benchmark; existing ones are kept."""
    words = ["synth", "--preset", "bench", "--seed", str(SEED), "--out", str(truth), "--workers", str(options.workers)]
    for path in options.motion:
        words += ["--motion", str(path)]
    if options.count:
        words += ["--count", str(options.count)]
    call(*words)
    return json.loads((truth / "set.json").read_text())


def run_pipeline(truth: Path, scene_dir: Path, options: argparse.Namespace) -> None:
    """Run the stages up to refine for all persons of the clip."""
    words = ["run", str(truth / "video.mp4"), "--out", str(scene_dir), "--person", "all", "--overwrite"]
    for setting in options.set:
        words += ["--set", setting]
    if options.given_height:
        call(*words, "--until", "humans")
        if heights := true_heights(truth, scene_dir):
            words += ["--height-m", heights]
    call(*words, "--until", "refine")


def true_heights(truth_dir: Path, scene_dir: Path) -> str:
    """The argument of `--height-m` for the persons found in a clip; empty if none is a true one."""
    truth, result = read_truth(truth_dir), SceneResult(scene_dir)
    bodies = result.get(BodyTracks)
    if bodies is None:
        sys.exit(f"{scene_dir}: {result.why(BodyTracks)}")
    found = bodies.people
    matches = match_people(found, truth, match_frames(result.clip, truth))
    heights_m = {found[one.estimate].person_id: shaped_body(truth.people[one.truth].shape).height_m for one in matches}
    return ",".join(f"{person}={height_m:.3f}" for person, height_m in heights_m.items())


def call(*words: str) -> None:
    """Run one command of video2anim; on failure exit with its error output."""
    done = subprocess.run([sys.executable, "-m", "video2anim.cli.main", *words], check=False)
    if done.returncode:
        sys.exit(f"video2anim {' '.join(words)} ended with {done.returncode}")


def same_as_recorded(made: dict[str, Any]) -> bool | None:
    """Whether the clips are byte for byte those of the recorded digests; None if there are none."""
    if not RECORDED.is_file():
        return None
    recorded = {clip["name"]: clip["truth.npz"] for clip in json.loads(RECORDED.read_text())["clips"]}
    return all(recorded.get(clip["name"]) == clip["truth.npz"] for clip in made["clips"])


def cost(results: Path, names: list[str]) -> dict[str, float]:
    """Median time and maximum memory of the runs, from the stage manifests."""
    walls, peaks = [], []
    for name in names:
        stages = [json.loads(path.read_text()) for path in sorted((results / name).glob("stages/*/manifest.json"))]
        walls.append(sum(stage["wall_time_s"] for stage in stages))
        peaks.append(max(stage["peak_memory_mb"] for stage in stages))
    return {"median_wall_s": statistics.median(walls), "peak_mb": max(peaks)}


def objects(truth: Path, results: Path, names: list[str]) -> dict[str, Any]:
    """Medians over all objects of all clips, and a row for each object."""
    rows = []
    for name in names:
        found = scene_objects(SceneResult(results / name), read_truth(truth / name))
        rows += [(name, row) for row in found]
    values = [{quality.key: quality.value for quality in row} for _, row in rows]
    medians = {key: statistics.median(value[key] for value in values) for key in OBJECT_MEDIANS} if rows else {}
    written = [{"clip": name, "qualities": [asdict(quality) for quality in row]} for name, row in rows]
    return {"count": len(rows), "medians": medians, "rows": written}


def prior_at_work(truth: Path, results: Path, names: list[str]) -> dict[str, Any]:
    """Effect of the prior on the main person of each clip: share of frames that it changed, errors with and without it,
    and the mean difference (with minus without) with its paired bootstrap interval over clips."""
    rows = [row for name in names if (row := _with_and_without(truth / name, results / name)) is not None]
    differences = {
        key: paired_interval([row["refined"][key] - row["without_prior"][key] for row in rows])
        for key in (PAIRED if rows else ())
    }
    return {"rows": rows, "differences": differences, "resamples": RESAMPLES, "seed": SEED}


def _with_and_without(truth_dir: Path, scene_dir: Path) -> dict[str, Any] | None:
    """The row of a clip; None if no person matches the true main person, or too few frames are measured."""
    result, truth = SceneResult(scene_dir), read_truth(truth_dir)
    bodies, refined = result.get(BodyTracks), result.get(RefinedMotion)
    if bodies is None or refined is None:
        sys.exit(f"{scene_dir}: {result.why(BodyTracks, RefinedMotion)}")
    frames = match_frames(result.clip, truth)
    match = next((match for match in match_people(bodies.people, truth, frames) if match.truth == 0), None)
    if match is None:
        return None
    raw = bodies.people[match.estimate]
    common = common_frames(raw, truth.main, frames)
    if len(common.measured) < 3:
        return None
    T_true_estimate = truth_from_estimate(refined.people[match.estimate].T_world_camera, truth, frames)
    return {
        "clip": truth.name,
        "prior": refined.prior[match.estimate],
        "share": refined.prior_share[match.estimate],
        **{
            name: errors(people[match.estimate], truth.main, common, T_true_estimate, truth.fps)
            for name, people in (("refined", refined.people), ("without_prior", refined.without_prior))
        },
    }


def errors(
    motion: BodyMotion, true: BodyMotion, common: CommonFrames, T_true_estimate: np.ndarray, fps: float
) -> dict[str, float]:
    """W-MPJPE and PA-MPJPE in meters over measured frames, acceleration error in m/s2 over the span, as in `eval`."""
    estimated_m, true_m = motion.joints_world_m, true.joints_world_m[common.true_index]
    span_m = transform_points(T_true_estimate, estimated_m[common.span])
    return {
        "w_mpjpe": metrics.w_mpjpe(estimated_m[common.measured], true_m[common.measured]),
        "acceleration_error": metrics.acceleration_error_m_s2(span_m, true_m[common.span], fps),
        "pa_mpjpe": metrics.pa_mpjpe(estimated_m[common.measured], true_m[common.measured]),
    }


def paired_interval(differences: list[float]) -> dict[str, float]:
    """Mean difference over clips with its 95 % percentile-bootstrap interval."""
    values = np.array(differences)
    drawn = np.random.default_rng(SEED).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.percentile(values[drawn].mean(1), [2.5, 97.5])
    return {"mean": float(values.mean()), "low": float(low), "high": float(high)}


RESAMPLES = 10_000
"""Number of bootstrap samples of the paired intervals."""
PAIRED = {
    "w_mpjpe": ("W-MPJPE, mm", 1000), "acceleration_error": ("acceleration error, m/s²", 1),
    "pa_mpjpe": ("PA-MPJPE, mm", 1000),
}  # fmt: skip
"""Title and factor of the numbers compared with and without the prior."""
OBJECT_MEDIANS = {"chamfer": "Chamfer", "center_error": "center"}
MOTION_ROWS = (
    ("motion", "mpjpe", "root-relative MPJPE, mm", 1000), ("motion", "pa_mpjpe", "PA-MPJPE, mm", 1000),
    ("motion", "w_mpjpe", "W-MPJPE, mm", 1000), ("motion", "root_error", "root, absolute, m", 1),
    ("motion", "acceleration_error", "acceleration error, m/s²", 1), ("motion", "jerk", "jerk, m/s³", 1),
    ("motion", "skating_gmd", "foot skating `gmd`", 1), ("motion", "contact_f1", "foot contact F1", 1),
    ("true_scene_laid", "collision_frames_1cm", "frames over 1 cm inside the true scene", 1),
    ("true_scene_laid", "penetration_max", "deepest penetration, true scene, m", 1),
    ("own_scene", "collision_frames_1cm", "frames over 1 cm inside the reconstructed scene", 1),
)  # fmt: skip
STAGE_ROWS = (
    ("track", "main_recall", "person frames found"), ("track", "id_switches", "identity switches"),
    ("camera", "fov_error", "vertical field of view, error in degrees"),
    ("camera", "gravity_error", "gravity, error in degrees"),
    ("background", "mask_iou", "person mask IoU"), ("depth", "abs_rel", "background AbsRel, aligned scale"),
    ("depth", "delta1", "background δ < 1.25, aligned scale"), ("segment", "floor_iou", "floor IoU"),
    ("segment", "f1", "furniture F1 at IoU 0.5"), ("objects", "reconstructed", "furniture with a shape"),
    ("objects", "chamfer", "object Chamfer, m"), ("objects", "center_error", "object center, error in m"),
)  # fmt: skip
STAGE_COLUMN = {"depth": "metric", "objects": "placed"}
"""Column used for groups with several columns; the last one by default."""


def tables(report: dict[str, Any]) -> str:
    """Markdown for the README: motion stages side by side, then one number per stage."""
    groups = {group["key"]: group for group in report["evaluation"]["groups"]}
    count, failed = len(report["evaluation"]["clips"]), len(report["evaluation"]["failures"])
    lines = [
        f"{report['benchmark'] or 'not V2A-Bench'}, {count} clips, {failed} failed; {report['machine']}, "
        f"{report['date']}, "
        f"seed {report['seed']}; at most {report['cost']['peak_mb'] / 1000:.1f} GB a clip. Means over clips with 95 % "
        f"intervals. {pooled(report['objects'])}",
        "",
        "| | raw | keyframes | refined | truth |",
        "|---|---|---|---|---|",
    ]
    for key, name, title, factor in MOTION_ROWS:
        row = row_of(groups[key], name)
        cells = [cell(statistic, factor) for statistic in row["statistics"][-3:]]
        true = "" if row["truth_mean"] is None else number(factor * row["truth_mean"])
        lines.append(f"| {title} | {' | '.join(cells)} | {true} |")
    lines += ["", "| stage | mean | median |", "|---|---|---|"]
    for key, name, title in STAGE_ROWS:
        group = groups[key]
        wanted = STAGE_COLUMN.get(key)
        column = group["columns"].index(wanted) if wanted in group["columns"] else len(group["columns"]) - 1
        statistic = row_of(group, name)["statistics"][column]
        median = "" if statistic is None else number(statistic["median"])
        lines.append(f"| {key}: {title} | {cell(statistic, 1)} | {median} |")
    return "\n".join([*lines, "", prior_sentence(report["prior"])])


def prior_sentence(found: dict[str, Any]) -> str:
    """Sentence with the mean share of frames that the prior changed, and the mean differences (with minus without)."""
    if not found["rows"]:
        return "The prior: no main person was measured."
    share = statistics.mean(row["share"] for row in found["rows"])
    texts = [f"{title} {cell(found['differences'][key], factor)}" for key, (title, factor) in PAIRED.items()]
    return (
        f"The prior shaped {share:.2f} of the main persons' frames. With it minus without it, means with paired 95 % "
        f"intervals over {len(found['rows'])} clips ({found['resamples']} resamples): {'; '.join(texts)}."
    )


def prior_table(found: dict[str, Any]) -> str:
    """Markdown: per clip, the share of frames that the prior changed, and errors with / without it."""
    titles = [title for title, _ in PAIRED.values()]
    lines = [
        f"| clip | frames shaped | {' | '.join(titles)} |",
        "|---" * (2 + len(titles)) + "|",
    ]
    for row in found["rows"]:
        cells = [
            f"{number(factor * row['refined'][key])} / {number(factor * row['without_prior'][key])}"
            for key, (_, factor) in PAIRED.items()
        ]
        lines.append(f"| {row['clip']} | {row['share']:.2f} | {' | '.join(cells)} |")
    return "\n".join(lines)


def pooled(found: dict[str, Any]) -> str:
    """Sentence with the medians over all objects."""
    texts = [f"{title} {number(found['medians'][key])} m" for key, title in OBJECT_MEDIANS.items() if found["medians"]]
    return f"Medians over all {found['count']} matched pieces of furniture: {', '.join(texts) or '-'}."


def row_of(group: dict[str, Any], key: str) -> dict[str, Any]:
    """A row of a group by its key."""
    return next(row for row in group["rows"] if row["qualities"][0]["key"] == key)


def cell(statistic: dict[str, Any] | None, factor: float) -> str:
    """Mean with interval, as text."""
    if statistic is None:
        return "-"
    mean, low, high = (number(factor * statistic[key]) for key in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}]"


def number(value: float) -> str:
    """Three significant digits."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def put_table(readme: Path, table: str) -> None:
    """Replace the text between `MARKS` in the README."""
    text = readme.read_text()
    pattern = re.compile(re.escape(MARKS[0]) + ".*?" + re.escape(MARKS[1]), re.DOTALL)
    readme.write_text(pattern.sub(lambda _: f"{MARKS[0]}\n{table}\n{MARKS[1]}", text))


if __name__ == "__main__":
    main()
