"""Time and memory of the whole pipeline on real clips; `real_clips.py` has their accuracy.

    python benchmarks/main_job.py --media ../shared/media --out benchmarks/results

Every clip runs in a new process and a new scene folder with the embedded preset, then again with nothing to do.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from video2anim.artifacts.codec import read_value
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import VideoClip

CLIPS = ("sports2d_demo", "pose2sim_single_cam01", "pose2sim_single_cam02", "sam2_bedroom")


def main() -> None:
    """Run the clips, print the tables, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--media", type=Path, default=Path("../shared/media"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--clips", nargs="*", default=CLIPS)
    parser.add_argument("--work", type=Path, help="empty folder for the scene folders, which are then kept")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="main_job-") as work:
        rows = [measure(options.media, name, (options.work or Path(work)) / name) for name in options.clips]
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": 0,
        "clips": rows,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"main_job-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(tables(report) + f"\n{target}\n")


def measure(media: Path, name: str, scene_dir: Path) -> dict[str, object]:
    """One clip: wall time of the whole command, stage table, peak memory, and the time of a cached run."""
    command = [sys.executable, "-m", "video2anim.cli.main", "run", str(media / "videos" / f"{name}.mp4")]
    command += ["--out", str(scene_dir)]
    started = time.perf_counter()
    run(command)
    wall_s = time.perf_counter() - started
    started = time.perf_counter()
    run(command)
    cached_s = time.perf_counter() - started
    stages = [json.loads(p.read_text()) for p in sorted(scene_dir.glob("stages/*/manifest.json"))]
    clip = read_value(VideoClip, stage_folder(scene_dir, "ingest"))
    return {
        "clip": name,
        "frames": clip.frame_count,
        "wall_s": wall_s,
        "frames_per_s": clip.frame_count / wall_s,
        "peak_mb": max(s["peak_memory_mb"] for s in stages),
        "cached_s": cached_s,
        "stages": {s["stage"]: {"wall_s": s["wall_time_s"], "peak_mb": s["peak_memory_mb"]} for s in stages},
        "quality": {s["stage"]: {q["key"]: q["value"] for q in s["qualities"]} for s in stages},
    }


def run(command: list[str]) -> None:
    """Run a command; on failure exit with its error output."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")


def tables(report: dict[str, object]) -> str:
    """Markdown for the README."""
    lines = [f"{report['machine']}, {report['date']}, seed {report['seed']}", ""]
    rows = report["clips"]
    lines += ["| clip | frames | whole run | frames/s | peak memory | second run |", "|---|---|---|---|---|---|"]
    for r in rows:  # type: ignore[attr-defined]
        lines.append(
            f"| {r['clip']} | {r['frames']} | {r['wall_s']:.0f} s | {r['frames_per_s']:.1f} | "
            f"{r['peak_mb'] / 1000:.2f} GB | {r['cached_s']:.1f} s |"
        )
    stages = list(rows[0]["stages"])  # type: ignore[index]
    lines += ["", "| stage | " + " | ".join(r["clip"] for r in rows) + " |", "|---" * (len(rows) + 1) + "|"]  # type: ignore[attr-defined]
    for stage in stages:
        lines.append(f"| {stage} | " + " | ".join(f"{r['stages'][stage]['wall_s']:.1f} s" for r in rows) + " |")  # type: ignore[attr-defined]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
