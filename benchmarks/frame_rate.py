"""Errors and lag of the motion on real clips with motion capture, at lower frame rates of the source.

    python benchmarks/frame_rate.py --media ../shared/media --work rate_work

Of each clip (60 pictures per second) those pictures are kept that a camera of the given rate would have taken, with
their time stamps, and the pipeline runs on the rest. `eval_mocap.py` of the media finds the lag: the shift in time at
which the poses fit the truth best. Writes `benchmarks/results/frame_rate-<date>.json` and prints a table.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from real_clips import mocap_report
from v2a_bench import call, number

CLIPS = ("ocv_sts", "ocv_walk")
TICKS = 60
"""Pictures of the clips per second."""


@dataclass(frozen=True)
class Row:
    """One clip at one rate."""

    clip: str
    rate_hz: float
    lag_ms: float
    """Positive: the motion is late."""
    pa_mpjpe_mm: float
    """Without a shift in time."""
    accel_error_m_s2: float


def main() -> None:
    """Make the clips, run the pipeline and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--media", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of the clips and scene folders, kept")
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 15.0, 24.0, 30.0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for clip in CLIPS:
        for rate in options.rates:
            video = options.work / f"{clip}_{rate:g}.mp4"
            if not video.is_file():
                write_slower(options.media / "videos" / f"{clip}.mp4", video, rate)
            scene_dir = options.work / video.stem
            call("run", str(video), "--out", str(scene_dir))
            rows.append(Row(clip, rate, *against_truth(scene_dir / "motion.npz", clip, options.media)))
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "rows": [asdict(row) for row in rows],
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"frame_rate-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    lines = [[row.clip, *map(number, list(asdict(row).values())[1:])] for row in rows]
    head = ["clip", "pictures/s", "lag, ms", "PA-MPJPE, mm", "acceleration error, m/s2"]
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *lines))
    sys.stdout.write(f"{table}\n{target}\n")


def pictures(path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Pictures that are shown, with their numbers."""
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            assert frame.pts is not None
            assert frame.time_base is not None
            tick = round(frame.pts * frame.time_base * TICKS)
            if tick >= 0:
                yield tick, frame.to_ndarray(format="rgb24")


def write_slower(source: Path, target: Path, rate_hz: float) -> None:
    """Those pictures of a clip that begin or fall into a new period of `rate_hz`, at their times."""
    with av.open(str(target), "w") as container:
        stream, taken = container.add_stream("libx264", rate=TICKS, options={"crf": "14"}), -1
        stream.pix_fmt = "yuv420p"
        for tick, rgb in pictures(source):
            period = int(tick * rate_hz / TICKS + 1e-6)
            if period == taken:
                continue
            if taken < 0:
                stream.height, stream.width = rgb.shape[:2]
            taken = period
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame.pts, frame.time_base = tick, Fraction(1, TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def against_truth(motion: Path, clip: str, media: Path) -> tuple[float, float, float]:
    """Lag (ms), PA-MPJPE without shift in time (mm) and acceleration error (m/s2) by motion capture."""
    found = mocap_report(motion, clip, media)
    return -found["time_offset_ms"], found["pa_mpjpe_at_offset_0_mm"], found["accel_error_m_s2"]


if __name__ == "__main__":
    main()
