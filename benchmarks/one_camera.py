"""Pieces of a long video by one fixed camera: what each says of the camera, and how far bodies are from the landmarks.

    python benchmarks/one_camera.py --video ../shared/media/videos/intel_table.mp4 --work one_camera_work \
        --pieces 0-12 24-36 60-72

No truth is needed: focal length, pitch and height of the camera should be the same in all pieces. Bodies are those of
stage refine; their 12 limb joints are compared with the landmarks (visibility over 0.5), as a share of the standing
body's height in the image: median and 95th percentile over the frames that show the person. Writes Markdown and JSON.
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
from real_clips import misses_px

from video2anim.body.anny_body import shaped_body
from video2anim.lab.eval.results import SceneResult
from video2anim.types import MetricDepth, PersonTracks, RefinedMotion

COLUMNS = ("piece, s", "frames seen, %", "focal, px", "pitch, deg", "height, m", "off landmarks, %", "95 %, %")


def main() -> None:
    """Run the pieces, measure, write the report."""
    options = arguments()
    rows = []
    for piece in options.pieces:
        start, stop = piece.split("-")
        folder = options.work / piece
        command = [
            sys.executable, "-m", "video2anim.cli.main", "run", str(options.video), "--out", str(folder), "--until",
            "refine", "--set", f"ingest.start_s={start}", "--set", f"ingest.stop_s={stop}",
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        rows.append([piece, *measured(SceneResult(folder))])
        sys.stderr.write(f"{rows[-1]}\n")
    lines = [COLUMNS, ["---"] * len(COLUMNS), *rows]
    sys.stdout.write("\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n")
    report = {
        "date": datetime.date.today().isoformat(), "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "video": options.video.name, "seed": 0, "columns": COLUMNS, "rows": rows,
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"one_camera-{report['date']}.json").write_text(json.dumps(report, indent=1) + "\n")


def measured(result: SceneResult) -> list[float]:
    """The numbers of a piece, in the order of `COLUMNS`."""
    tracks, depth, refined = (result.get(kind) for kind in (PersonTracks, MetricDepth, RefinedMotion))
    assert isinstance(tracks, PersonTracks)
    assert isinstance(depth, MetricDepth)
    assert isinstance(refined, RefinedMotion)
    motion = refined.people[0]
    view, track = depth.bodies.main_view, tracks.selected()[0].whole(motion.frame_count)
    height_m = float(np.ptp(shaped_body(motion.shape).rest_vertices_m[:, 1]))
    distance_m = motion.joints_camera_m[:, 0, 2]
    off = misses_px(motion, track) * distance_m / (motion.intrinsics.fy_px * height_m)
    pitch_deg = np.degrees(np.arcsin(view.T_world_camera[1, 2]))
    median, high = (round(100 * float(np.nanpercentile(off, share)), 2) for share in (50, 95))
    return [
        round(100 * float(track.valid.mean()), 1), round(view.intrinsics.fx_px, 1), round(float(pitch_deg), 2),
        round(float(view.T_world_camera[1, 3]), 3), median, high,
    ]  # fmt: skip


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--video", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=Path("one_camera_work"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--pieces", nargs="+", required=True, metavar="START-STOP", help="in seconds")
    return parser.parse_args()


if __name__ == "__main__":
    main()
