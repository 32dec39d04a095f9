"""V2A-Bench: make the clips (or take them from the cache), run the pipeline on each, compare with the truth.

    python benchmarks/v2a_bench.py --motion ../shared/motion/cmu.npz ../shared/motion/deepmimic.npz

Writes `benchmarks/results/v2a_bench-<date>.json` and puts the table between the marks in README.md. Clips are those of
`video2anim synth --preset bench --seed 0`; without --motion captured walks are replaced by the gait model, which makes
another set, and the report says so. A run that was broken off goes on where it stopped: clips and scene folders are
cached in --work.
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
from pathlib import Path
from typing import Any

SEED = 0
MARKS = ("<!-- v2a-bench -->", "<!-- /v2a-bench -->")
RECORDED = Path(__file__).with_name("v2a_bench_digests.json")


def main() -> None:
    """Make, run, evaluate, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="*", default=[])
    parser.add_argument("--work", type=Path, default=Path("bench_work"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--count", type=int, help="only the first so many clips; no README table then")
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) // 2))
    parser.add_argument("--record", action="store_true", help="write the digests of the clips beside this script")
    options = parser.parse_args()
    truth, results = options.work / "truth", options.work / "results"
    made = make(options, truth)
    for clip in made["clips"]:
        scene_dir = results / clip["name"]
        call("run", str(truth / clip["name"] / "video.mp4"), "--out", str(scene_dir), "--person", "all", "--overwrite")
    report_json, report_html = options.work / "eval.json", options.work / "eval.html"
    call("eval-set", str(results), "--truth", str(truth), "--json", str(report_json), "--html", str(report_html))
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": SEED,
        "benchmark": made["benchmark"],
        "generator": made["generator"],
        "motion_sources": made["motion_sources"],
        "clip_digests": {clip["name"]: clip["truth.npz"] for clip in made["clips"]},
        "same_clips_as_recorded": same_as_recorded(made),
        "cost": cost(results, [clip["name"] for clip in made["clips"]]),
        "evaluation": json.loads(report_json.read_text()),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"v2a_bench-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    if options.record:
        RECORDED.write_text(json.dumps({k: made[k] for k in ("benchmark", "motion_sources", "clips")}, indent=1) + "\n")
    sys.stdout.write(f"{target}\n{report_html}\n")


def make(options: argparse.Namespace, truth: Path) -> dict[str, Any]:
    """The clips of the benchmark; what is there is kept."""
    words = ["synth", "--preset", "bench", "--seed", str(SEED), "--out", str(truth), "--workers", str(options.workers)]
    for path in options.motion:
        words += ["--motion", str(path)]
    if options.count:
        words += ["--count", str(options.count)]
    call(*words)
    return json.loads((truth / "set.json").read_text())


def call(*words: str) -> None:
    """One command of video2anim, to the end."""
    done = subprocess.run([sys.executable, "-m", "video2anim.cli.main", *words], check=False)
    if done.returncode:
        sys.exit(f"video2anim {' '.join(words)} ended with {done.returncode}")


def same_as_recorded(made: dict[str, Any]) -> bool | None:
    """Whether the clips are byte for byte those of the recorded table; None where none is recorded."""
    if not RECORDED.is_file():
        return None
    recorded = {clip["name"]: clip["truth.npz"] for clip in json.loads(RECORDED.read_text())["clips"]}
    return all(recorded.get(clip["name"]) == clip["truth.npz"] for clip in made["clips"])


def cost(results: Path, names: list[str]) -> dict[str, float]:
    """Median time and greatest memory of the runs, from the stage manifests."""
    walls, peaks = [], []
    for name in names:
        stages = [json.loads(path.read_text()) for path in sorted((results / name).glob("stages/*/manifest.json"))]
        walls.append(sum(stage["wall_time_s"] for stage in stages))
        peaks.append(max(stage["peak_memory_mb"] for stage in stages))
    return {"median_wall_s": statistics.median(walls), "peak_mb": max(peaks)}


def put_table(readme: Path, table: str) -> None:
    """Replace what stands between the marks."""
    text = readme.read_text()
    pattern = re.compile(re.escape(MARKS[0]) + ".*?" + re.escape(MARKS[1]), re.DOTALL)
    readme.write_text(pattern.sub(lambda _: f"{MARKS[0]}\n{table}\n{MARKS[1]}", text))


if __name__ == "__main__":
    main()
