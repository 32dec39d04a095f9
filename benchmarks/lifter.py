"""A lifter on real clips: stage humans against marker-based capture (`ocv_*`) and four-view triangulation (Pose2Sim).

    python benchmarks/lifter.py --media ../shared/media --work lifter_work
    python benchmarks/lifter.py --media ../shared/media --work lifter_work --lifter lifter.onnx --label longer

Ingest and track are made once in the work folder; camera and humans stages use the lifter in question. The table has a
line per clip, and the mean over all clips: choose nothing on one. Writes JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
from human_fit import REAL, call, column
from main_job import accuracy

from video2anim.artifacts.codec import read_value
from video2anim.digest import file_digest
from video2anim.networks.fetch import model_path
from video2anim.networks.table import find_model
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import VideoClip

CAPTURED = ("ocv_sts", "ocv_walk")
ROWS = ("pa_mpjpe_mm", "root_relative_mpjpe_mm", "knee_flexion_error_deg", "hip_flexion_error_deg", "up_error_deg")


def main() -> None:
    """Run the methods, compare, write the report."""
    options = arguments()
    rows = []
    for name in (*CAPTURED, *REAL):
        scene = fitted(options.media / "videos" / f"{name}.mp4", options.work / name, options.lifter)
        rows.append({"clip": name} | scored(options.media, name, scene))
        sys.stdout.write(f"{line(rows[-1])}\n")
        sys.stdout.flush()
    rows.append({"clip": "mean"} | mean(rows))
    file = options.lifter or model_path(find_model("lifter"))
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "lifter": {"label": options.label, "sha256": file_digest(file), "bytes": file.stat().st_size},
        "seed": 0,
        "rows": rows,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"lifter-{options.label}-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write("\n".join([head(), *map(line, rows), str(target), ""]))


def fitted(video: Path, scene: Path, lifter: Path | None) -> Path:
    """The scene folder with the humans stage by these weights."""
    named = () if lifter is None else ("humans.model", "camera.model")
    settings = dict.fromkeys(named, f"lifter@{lifter.resolve()}" if lifter else "")
    words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    call("run", str(video), "--out", str(scene), "--until", "humans", *words)
    return scene


def scored(media: Path, name: str, scene: Path) -> dict[str, float]:
    """Errors of a clip in millimeters and degrees."""
    if name in REAL:
        clip = read_value(VideoClip, stage_folder(scene, "ingest"))
        return column(accuracy(scene, clip, media / "reference" / f"{name}_joints.npz"), "_fit")
    target = scene / "eval_mocap.json"
    motion = stage_folder(scene, "humans") / "motion.npz"
    program = [sys.executable, str(media / "eval_mocap.py"), str(motion), "--clip", name, "--json", str(target)]
    subprocess.run(program, check=True, capture_output=True)
    found = json.loads(target.read_text())
    found["root_relative_mpjpe_mm"], found["up_error_deg"] = found["mpjpe_root_mm"], found["gravity_tilt_deg"]
    return {key: found[key] for key in ROWS}


def mean(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean over the clips that have the number."""
    return {key: float(np.mean([row[key] for row in rows if key in row])) for key in ROWS}


def head() -> str:
    """First lines of the table."""
    return "| clip | " + " | ".join(ROWS) + " |\n" + "|---" * (1 + len(ROWS)) + "|"


def line(row: dict[str, float]) -> str:
    """One line of the Markdown table."""
    numbers = " | ".join(f"{row[key]:.1f}" if key in row else "" for key in ROWS)
    return f"| {row['clip']} | {numbers} |"


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--media", type=Path, required=True, help="folder with videos/, reference/ and eval_mocap.py")
    parser.add_argument("--work", type=Path, required=True, help="folder of the scenes, kept")
    parser.add_argument("--lifter", type=Path, help="ONNX file (default: the shipped weights)")
    parser.add_argument("--label", default="shipped", help="name of these weights in the report")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
