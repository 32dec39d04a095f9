"""Raw landmarks and the fitted body, on the same tracks and cameras.

    python benchmarks/human_fit.py --media ../shared/media --truth bench_work/truth

Pose2Sim: 12 limb joints against the triangulated reference, as in `main_job.py`. V2A-Bench (clips of `video2anim synth
--preset bench`): the rows of `video2anim eval` for the humans stage; raw landmarks have the limb joints only. Track and
camera are made once per clip. Writes JSON and Markdown.
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
from pathlib import Path

import numpy as np
from main_job import JOINTS, LANDMARKS, accuracy, centered, pa_mpjpe_mm

from video2anim.artifacts.codec import read_value
from video2anim.lab.eval.truth import read_truth
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import BodyTracks, PersonTracks, VideoClip

REAL = ("pose2sim_single_cam01", "pose2sim_single_cam02")
REAL_ROWS = ("pa_mpjpe_mm", "root_relative_mpjpe_mm", "acceleration_error_m_s2", "root_error_m", "focal_error_percent",
             "up_error_deg")  # fmt: skip
EVAL_ROWS = ("pa_mpjpe", "mpjpe", "w_mpjpe", "root_error", "acceleration_error", "jerk", "skating_gmd", "contact_f1")
TRUE_ROWS = (*EVAL_ROWS, "limb_jerk")


def main() -> None:
    """Run the methods, compare, write the report."""
    options = arguments()
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory(prefix="human_fit-") as folder:
        work = options.work or Path(folder)
        for name in REAL if options.media else ():
            video = options.media / "videos" / f"{name}.mp4"
            scene = fitted(video, work / name)
            clip = read_value(VideoClip, stage_folder(scene, "ingest"))
            found = accuracy(scene, clip, options.media / "reference" / f"{name}_joints.npz")
            rows.extend(
                {"set": "Pose2Sim", "clip": name, "method": method, **column(found, f"_{method}")}
                for method in ("raw", "fit")
            )
        for truth in sorted(options.truth.iterdir()) if options.truth else ():
            if not (truth / "meta.json").is_file():
                continue
            scene = fitted(truth / "video.mp4", work / truth.name)
            own: dict[str, object] = {"set": "V2A-Bench", "clip": truth.name}
            rows += [own | {"method": name} | found for name, found in raw_and_true(scene, truth).items()]
            rows.append(own | {"method": "fit"} | evaluated(scene, truth, work))
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": 0,
        "rows": rows,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"human_fit-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(table(rows) + f"\n{target}\n")


def fitted(video: Path, scene: Path) -> Path:
    """The scene folder up to stage humans."""
    call("run", str(video), "--out", str(scene), "--until", "humans")
    return scene


def evaluated(scene: Path, truth: Path, work: Path) -> dict[str, float | None]:
    """Evaluation rows of stage humans, and identity switches."""
    target = work / "eval.json"
    call("eval", str(scene), "--truth", str(truth), "--json", str(target))
    groups = {group["key"]: group for group in json.loads(target.read_text())["groups"]}
    first = [row["qualities"][0] for name in ("motion", "track", "camera") for row in groups[name]["rows"]]
    found = {quality["key"]: quality["value"] for quality in first}
    body = read_value(BodyTracks, stage_folder(scene, "humans")).people[0]
    limbs_m = np.where(body.valid[:, None, None], body.joints_camera_m[:, JOINTS], np.nan)
    own = {key: found[key] for key in (*EVAL_ROWS, "id_switches", "focal_error", "gravity_error")}
    return own | {"limb_jerk": limb_jerk_m_s3(limbs_m, read_truth(truth).fps)}


def raw_and_true(scene: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Raw 3D landmarks of the main person's limbs against the true joints; jerk of both."""
    known = read_truth(truth)
    clip = read_value(VideoClip, stage_folder(scene, "ingest"))
    track = read_value(PersonTracks, stage_folder(scene, "track")).selected()[0].whole(clip.frame_count)
    frames = min(len(track.valid), len(known.main.valid))
    true_m = known.main.joints_camera_m[:frames, JOINTS]
    true_m[~(track.valid & known.main.valid)[:frames]] = np.nan
    raw_m = track.landmarks_m[:frames, LANDMARKS]
    off_m = np.linalg.norm(centered(raw_m) - centered(true_m), axis=-1)
    raw = {"pa_mpjpe": pa_mpjpe_mm(raw_m, true_m) / 1000, "mpjpe": float(np.nanmean(off_m))}
    raw_m = np.where(np.isnan(true_m), np.nan, raw_m)
    jerk = {
        name: {"limb_jerk": limb_jerk_m_s3(limbs_m, known.fps)} for name, limbs_m in (("raw", raw_m), ("truth", true_m))
    }
    return {"raw": raw | jerk["raw"], "truth": jerk["truth"]}


def limb_jerk_m_s3(limbs_m: np.ndarray, fps: float) -> float:
    """Mean norm of the third derivative of limb joints relative to the hips. Frames with a missing joint are left
    out."""
    return float(np.nanmean(np.linalg.norm(np.diff(centered(limbs_m), n=3, axis=0), axis=-1)) * fps**3)


def column(found: dict[str, float], ending: str) -> dict[str, float]:
    """The numbers of one column of `accuracy`. Raw landmarks have no position and no focal length."""
    own = {key.removesuffix(ending): value for key, value in found.items() if key.endswith(ending)}
    shared = (
        {} if ending == "_raw" else {key: found[key] for key in ("root_error_m", "focal_error_percent", "up_error_deg")}
    )
    return own | shared


def table(rows: list[dict[str, object]]) -> str:
    """Means over clips, one line per set and method."""
    lines: list[str] = []
    for title, keys in (("Pose2Sim", REAL_ROWS), ("V2A-Bench", TRUE_ROWS)):
        own = [row for row in rows if row["set"] == title]
        if not own:
            continue
        clips = sorted({str(row["clip"]) for row in own})
        parts = [[clip] for clip in clips] if title == "Pose2Sim" else [clips]
        lines += ["", f"| {title} | " + " | ".join(keys) + " |", "|---" * (len(keys) + 1) + "|"]
        for part in parts:
            for method in ("raw", "fit", "truth") if title == "V2A-Bench" else ("raw", "fit"):
                some = [row for row in own if row["method"] == method and row["clip"] in part]
                name = method if len(part) > 1 else f"{part[0]}: {method}"
                lines.append(f"| {name} | " + " | ".join(mean(some, key) for key in keys) + " |")
    return "\n".join(lines)


def mean(rows: list[dict[str, object]], key: str) -> str:
    """Mean over the clips that have the number."""
    values = [float(row[key]) for row in rows if isinstance(row.get(key), int | float)]  # type: ignore[arg-type]
    return f"{np.mean(values):.3g}" if values else "n/a"


def call(*words: str) -> None:
    """Run a command; on failure exit with its error output."""
    command = [sys.executable, "-m", "video2anim.cli.main", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--media", type=Path, help="folder with videos/ and reference/")
    parser.add_argument("--truth", type=Path, help="folder of clips with truth")
    parser.add_argument("--work", type=Path, help="folder of the scenes, kept; default: a temporary one")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
