"""The whole pipeline on real clips: time, memory, motion before and after refinement (numbers of the paper's table 4,
which need no truth), and the accuracy of stage humans for clips with a reference.

    python benchmarks/main_job.py --media ../shared/media --out benchmarks/results

Every clip runs in a new process and a new scene folder with the embedded preset. Pose errors are against the
triangulated reference of the Pose2Sim clips: 12 limb joints, millimeters, mean over frames. The errors of the raw
BlazePose world landmarks of the same run are given for comparison.
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

import numpy as np

from scenemi.metrics import align_similarity
from video2anim.artifacts.codec import read_value
from video2anim.artifacts.motion_io import read_motion
from video2anim.export.quality import measured_span, motion_quality
from video2anim.pipeline.scene_folder import stage_folder
from video2anim.types import BodyTracks, KeyframedMotion, PersonTracks, RefinedMotion, VideoClip
from video2anim.types.skeleton import JOINT_INDEX

LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
JOINTS = [JOINT_INDEX[f"{side}_{part}"] for part in LIMBS for side in ("left", "right")]
LANDMARKS = [11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
HIPS = slice(6, 8)
STEPS = {"humans": BodyTracks, "keyframes": KeyframedMotion, "refine": RefinedMotion}
"""Stages whose motions are compared, and the types of their values."""
REFINEMENT = (
    "frames in collision, over 1 cm", "deepest penetration", "foot skating (gmd)", "foot skating (kimodo)", "jerk",
)  # fmt: skip
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
    """One clip: wall time of the whole command, stage table, peak memory, accuracy, and the time of a cached run."""
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
    row: dict[str, object] = {
        "clip": name,
        "frames": clip.frame_count,
        "wall_s": wall_s,
        "frames_per_s": clip.frame_count / wall_s,
        "peak_mb": max(s["peak_memory_mb"] for s in stages),
        "cached_s": cached_s,
        "stages": {s["stage"]: {"wall_s": s["wall_time_s"], "peak_mb": s["peak_memory_mb"]} for s in stages},
        "quality": {s["stage"]: {q["key"]: q["value"] for q in s["qualities"]} for s in stages},
    }
    row["refinement"] = refinement(scene_dir, clip.fps)
    reference = media / "reference" / f"{name}_joints.npz"
    if reference.is_file():
        row["accuracy"] = accuracy(scene_dir, clip, reference)
    return row


def refinement(scene_dir: Path, fps: float) -> dict[str, dict[str, float]]:
    """Numbers of the main person's motion after humans, keyframes and refine, in the reconstructed scene."""
    scene = read_value(RefinedMotion, stage_folder(scene_dir, "refine")).scene
    found = {}
    for stage, kind in STEPS.items():
        motion = read_value(kind, stage_folder(scene_dir, stage)).people[0]
        span = measured_span(motion)
        if span is not None:
            numbers = motion_quality(motion, scene, span, fps).numbers
            found[stage] = {number.name: number.value for number in numbers if number.name in REFINEMENT}
    return found


def run(command: list[str]) -> None:
    """Run a command; on failure exit with its error output."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")


def accuracy(scene_dir: Path, clip: VideoClip, reference: Path) -> dict[str, float]:
    """Errors of stage humans and of raw landmarks against the reference frames nearest in time."""
    with np.load(reference, allow_pickle=False) as archive:
        nearest = np.abs(archive["frame_time_s"][None] - clip.frame_time_s[:, None]).argmin(1)
        truth = archive["landmarks_camera_m"][nearest][:, LANDMARKS]
    camera = json.loads(reference.with_name(reference.name.replace("_joints.npz", ".json")).read_text())
    motion = read_motion(stage_folder(scene_dir, "humans") / "motion.npz")
    track = read_value(PersonTracks, stage_folder(scene_dir, "track")).selected()[0]
    raw = track.whole(clip.frame_count).landmarks_m[:, LANDMARKS]
    fitted = motion.joints_camera_m[:, JOINTS]
    truth[~motion.valid] = np.nan
    up_camera = motion.T_world_camera[0, 1, :3]
    true_up = np.array(camera["R_camera_world"])[:, 2]
    root_error_m = np.linalg.norm((fitted - truth)[:, HIPS].mean(1), axis=-1)
    found = {
        "focal_error_percent": 100 * abs(motion.intrinsics.fx_px / camera["fx"] - 1),
        "up_error_deg": float(np.degrees(np.arccos(np.clip(up_camera @ true_up, -1, 1)))),
        "root_error_m": float(np.nanmedian(root_error_m)),
        "compared_joints": int(np.isfinite(truth[..., 0]).sum()),
    }
    for label, joints in (("fit", fitted), ("raw", raw)):
        found[f"pa_mpjpe_mm_{label}"] = pa_mpjpe_mm(joints, truth)
        found[f"root_relative_mpjpe_mm_{label}"] = 1000 * float(
            np.nanmean(np.linalg.norm(centered(joints) - centered(truth), axis=-1))
        )
        found[f"acceleration_error_m_s2_{label}"] = acceleration_error(centered(joints), centered(truth), clip.fps)
    return found


def pa_mpjpe_mm(joints_m: np.ndarray, truth_m: np.ndarray) -> float:
    """Mean over frames of the error after a similarity alignment of the joints that the reference has."""
    errors = []
    for joints, truth in zip(joints_m, truth_m, strict=True):
        seen = np.isfinite(truth[:, 0])
        if seen.sum() >= 4:
            aligned = align_similarity(joints[seen], truth[seen], with_scale=True)(joints[seen])
            errors.append(np.linalg.norm(aligned - truth[seen], axis=-1).mean())
    return 1000 * float(np.mean(errors))


def centered(joints_m: np.ndarray) -> np.ndarray:
    """Joints relative to the center of the hips."""
    return joints_m - joints_m[:, HIPS].mean(1, keepdims=True)


def acceleration_error(joints_m: np.ndarray, truth_m: np.ndarray, fps: float) -> float:
    """Mean norm of the difference of accelerations; frames with a missing joint are left out."""
    difference = (np.diff(joints_m, 2, axis=0) - np.diff(truth_m, 2, axis=0)) * fps**2
    return float(np.nanmean(np.linalg.norm(difference, axis=-1)))


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
    lines += ["", "| clip | PA-MPJPE (raw) | root-relative MPJPE (raw) | root | focal | up | acceleration (raw) |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for r in rows:  # type: ignore[attr-defined]
        if "accuracy" in r:
            a = r["accuracy"]
            lines.append(
                f"| {r['clip']} | {a['pa_mpjpe_mm_fit']:.1f} ({a['pa_mpjpe_mm_raw']:.1f}) mm | "
                f"{a['root_relative_mpjpe_mm_fit']:.1f} ({a['root_relative_mpjpe_mm_raw']:.1f}) mm | "
                f"{a['root_error_m']:.2f} m | {a['focal_error_percent']:.1f} % | {a['up_error_deg']:.1f} deg | "
                f"{a['acceleration_error_m_s2_fit']:.1f} ({a['acceleration_error_m_s2_raw']:.1f}) m/s2 |"
            )
    lines += ["", "| clip | motion | " + " | ".join(REFINEMENT) + " |", "|---" * (2 + len(REFINEMENT)) + "|"]
    for r in rows:  # type: ignore[attr-defined]
        for label, numbers in r["refinement"].items():
            lines.append(f"| {r['clip']} | {label} | " + " | ".join(f"{numbers[n]:.3g}" for n in REFINEMENT) + " |")
    stages = list(rows[0]["stages"])  # type: ignore[index]
    lines += ["", "| stage | " + " | ".join(r["clip"] for r in rows) + " |", "|---" * (len(rows) + 1) + "|"]  # type: ignore[attr-defined]
    for stage in stages:
        lines.append(f"| {stage} | " + " | ".join(f"{r['stages'][stage]['wall_s']:.1f} s" for r in rows) + " |")  # type: ignore[attr-defined]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
