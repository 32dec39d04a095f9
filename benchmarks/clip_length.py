"""Time and memory of the stages track, camera and humans as a function of the clip's length.

    python benchmarks/clip_length.py --video ../shared/media/videos/sports2d_demo.mp4 --seconds 10 60 300

The video is repeated forward and backward until it is long enough, so that motion is continuous. Every length runs in
new processes; time and peak memory are from the stages' manifests.
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
from fractions import Fraction
from pathlib import Path

import av

STAGES = ("ingest", "track", "camera", "humans")


def main() -> None:
    """Make the clips, run them, write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--video", type=Path, required=True)
    parser.add_argument("--seconds", type=float, nargs="+", default=[10, 60, 300])
    parser.add_argument("--width", type=int, default=640, help="of the clips; the height follows")
    parser.add_argument("--model", default="blazepose-heavy")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory(prefix="clip_length-") as folder:
        for length_s in options.seconds:
            clip = Path(folder) / f"{length_s:g}.mp4"
            frames = there_and_back(options.video, clip, length_s, options.width)
            rows.append({"seconds": length_s, "frames": frames} | run(clip, Path(folder) / f"{length_s:g}", options))
            sys.stdout.write(json.dumps(rows[-1]) + "\n")
            sys.stdout.flush()
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "model": options.model,
        "rows": rows,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"clip_length-{report['date']}.json").write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(rows) + "\n")


def there_and_back(video: Path, out: Path, length_s: float, width: int) -> int:
    """Write the video forward and backward up to `length_s` seconds. Returns the number of frames."""
    with av.open(str(video)) as source:
        stream = source.streams.video[0]
        fps = stream.average_rate or Fraction(30)
        height = 2 * round(width * stream.height / stream.width / 2)
        pictures = [frame.reformat(width, height, "yuv420p").to_ndarray() for frame in source.decode(stream)]
    order = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
    count = round(length_s * float(fps))
    with av.open(str(out), "w") as sink:
        target = sink.add_stream("libx264", rate=fps, options={"crf": "20", "preset": "veryfast"})
        target.width, target.height, target.pix_fmt = width, height, "yuv420p"
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(pictures[order[number % len(order)]], format="yuv420p")
            sink.mux(target.encode(frame))
        sink.mux(target.encode(None))
    return count


def run(clip: Path, scene: Path, options: argparse.Namespace) -> dict[str, object]:
    """Run each stage in its own process, so that its peak memory can be measured."""
    for stage in STAGES:
        command = [sys.executable, "-m", "video2anim.cli.main", "run", str(clip), "--out", str(scene)]
        command += ["--until", stage, "--set", f"track.model={options.model}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
    manifests = [json.loads(path.read_text()) for path in sorted(scene.glob("stages/*/manifest.json"))]
    return {m["stage"]: {"wall_s": m["wall_time_s"], "peak_mb": m["peak_memory_mb"]} for m in manifests}


def table(rows: list[dict[str, object]]) -> str:
    """Markdown: seconds and megabytes of each stage, and frames per second of track, camera and humans together."""
    lines = ["| clip | " + " | ".join(f"{s}, s | {s}, MB" for s in STAGES) + " | frames/s without ingest |"]
    lines.append("|---" * (2 * len(STAGES) + 2) + "|")
    for row in rows:
        parts = [row[stage] for stage in STAGES]
        cells = " | ".join(f"{p['wall_s']:.1f} | {p['peak_mb']:.0f}" for p in parts)  # type: ignore[index]
        work_s = sum(p["wall_s"] for p in parts[1:])  # type: ignore[index]
        lines.append(f"| {row['seconds']:g} s | {cells} | {row['frames'] / work_s:.1f} |")  # type: ignore[operator]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
