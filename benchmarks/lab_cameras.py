"""Focal length, gravity and camera height of eight real views of a laboratory against its calibration.

    python -m pip download pose2sim==0.10.49 --no-deps && unzip -q pose2sim-*.whl
    python benchmarks/lab_cameras.py --pose2sim Pose2Sim --work lab_work

Runs the pipeline on the demo clips of Pose2Sim (BSD 3-Clause; one person and several, four calibrated cameras each) as
far as stage metric; finished results are kept. The laboratory's origin is on the walkway on which a man walks, so the
height of the camera is taken over his soles; others stand on lower ground. Writes
`benchmarks/results/lab_cameras-<date>.json` and prints a table.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from v2a_bench import call

from video2anim.artifacts.codec import read_value
from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import posed_vertices
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import BodyMotion, MetricDepth
from video2anim.types.skeleton import FEET

DEMOS = ("Demo_SinglePerson", "Demo_MultiPerson")
SUBPIXELS = 64
"""Qualisys states focal lengths in these parts of a pixel."""
HEADS = ("view", "focal length", "error, %", "gravity error, degrees", "camera height, m", "error, %", "people")


@dataclass(frozen=True, slots=True)
class Camera:
    """The laboratory's calibration of one camera."""

    focal_px: float
    up_camera: Float[np.ndarray, "3"]
    """Unit vector in the camera's frame (OpenCV axes)."""
    height_m: float
    """Over the walkway."""


@dataclass(frozen=True, slots=True)
class Row:
    """One view."""

    view: str
    focal_px: float
    focal_error_percent: float
    gravity_error_deg: float
    height_m: float
    height_error_percent: float
    people: int


def main() -> None:
    """Run, compare, write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pose2sim", type=Path, required=True, help="folder of that name in the unpacked wheel")
    parser.add_argument("--work", type=Path, default=Path("lab_work"), help="scene folders, kept")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    rows = []
    for demo in DEMOS:
        cameras = calibration(next((options.pose2sim / demo / "calibration").glob("*.qca.txt")))
        for name, camera in sorted(cameras.items()):
            scene = options.work / f"{demo.removeprefix('Demo_')}_{name}"
            video = options.pose2sim / demo / "videos" / f"{name}.mp4"
            call("run", str(video), "--out", str(scene), "--person", "all", "--until", "metric")
            rows.append(compared(scene, camera))
    today = datetime.date.today().isoformat()
    report = {
        "date": today, "machine": f"{os.cpu_count()} x {platform.machine()}", "seed": 0,
        "views": [asdict(row) for row in rows],
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"lab_cameras-{today}.json").write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write("\n".join(table(rows)) + "\n")


def calibration(path: Path) -> dict[str, Camera]:
    """Cameras by name, of a Qualisys file (z up, millimeters; its cameras look along -z with y up)."""
    cameras = {}
    for one in ElementTree.parse(path).getroot().iter("camera"):
        place, lens = one.find("transform"), one.find("intrinsic")
        assert place is not None
        assert lens is not None
        up = np.array([float(place.attrib[f"r{row}3"]) for row in (1, 2, 3)])
        focal_px = float(lens.attrib["focalLengthU"]) / SUBPIXELS
        cameras[one.attrib["serial"]] = Camera(focal_px, up * [1, -1, -1], float(place.attrib["z"]) / 1000)
    return cameras


def compared(scene: Path, camera: Camera) -> Row:
    """The view's estimates beside the truth."""
    bodies = read_value(MetricDepth, stage_folder(scene, "metric")).bodies
    view = bodies.main_view
    walker = max(bodies.people, key=_way_m)
    body = shaped_body(walker.shape)
    feet = np.flatnonzero(np.isin(body.vertex_part, FEET))
    soles_m = posed_vertices(walker, body, feet, np.flatnonzero(walker.valid))[..., 1].min(1)
    height_m = float(view.T_world_camera[1, 3] - np.median(soles_m))
    cosine = float(view.T_world_camera[1, :3] @ camera.up_camera)
    focal_px = view.intrinsics.fx_px
    return Row(
        scene.name, focal_px, 100 * (focal_px / camera.focal_px - 1), float(np.degrees(np.arccos(min(cosine, 1.0)))),
        height_m, 100 * (height_m / camera.height_m - 1), len(bodies.people),
    )  # fmt: skip


def _way_m(motion: BodyMotion) -> float:
    """Distance between the farthest two places of the pelvis, about."""
    return float(np.ptp(motion.T_world_root[motion.valid, :3, 3], axis=0).max())


def table(rows: list[Row]) -> Iterator[str]:
    """Markdown, with the mean of absolute errors."""
    yield "| " + " | ".join(HEADS) + " |"
    yield "|" + "---|" * len(HEADS)
    for row in rows:
        yield (
            f"| {row.view} | {row.focal_px:.0f} | {row.focal_error_percent:+.1f} | {row.gravity_error_deg:.2f} | "
            f"{row.height_m:.2f} | {row.height_error_percent:+.1f} | {row.people} |"
        )
    focal, gravity, height = np.abs(
        [(row.focal_error_percent, row.gravity_error_deg, row.height_error_percent) for row in rows]
    ).mean(0)
    yield f"| mean | | {focal:.1f} | {gravity:.2f} | | {height:.1f} | |"


if __name__ == "__main__":
    main()
