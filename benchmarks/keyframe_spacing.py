"""Spacing and noise level of the prior's keyframes: stage refine on scene folders with several settings.

    video2anim synth --preset bench --count 5 --seed 9001 --motion cmu.npz --out dev_work/truth
    python benchmarks/keyframe_spacing.py --truth dev_work/truth --work dev_work/scenes
    python benchmarks/keyframe_spacing.py --media ../shared/media --work real_work --clips ocv_sts ocv_walk

Scene folders must be finished up to stage keyframes (with --truth they are run). Errors of the main person: W-MPJPE
(`--media`: root path after rigid alignment over the clip), PA-MPJPE, acceleration error, ratio of jerk to true jerk
(`--media`: jerk). Writes Markdown and JSON.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
from real_clips import against_truth

from scenemi import metrics
from stages.refine import RefineConfig, refine_motion
from video2anim.artifacts.motion_io import read_motion
from video2anim.lab.eval.results import SceneResult
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, BodyTracks, KeyframedMotion, MetricDepth, SceneModel

SETTINGS = {
    "no prior": RefineConfig(prior="interpolation"),
    "every 15th (paper)": RefineConfig(keyframe_interval_frames=15),
    "every 10th": RefineConfig(keyframe_interval_frames=10),
    "every 5th": RefineConfig(keyframe_interval_frames=5),
    "every 5th, 3 degrees, 2 cm": RefineConfig(keyframe_noise_deg=3.0, keyframe_noise_cm=2.0),
    "every 5th, 10 degrees, 5 cm": RefineConfig(keyframe_noise_deg=10.0, keyframe_noise_cm=5.0),
    "every frame": RefineConfig(keyframe_interval_frames=1),
}
COLUMNS = ("path_mm", "pa_mm", "acceleration", "jerk")


def main() -> None:
    """Run stage refine with each setting, compare, write the report."""
    options = arguments()
    if options.truth is None:
        clips = {options.work / name: None for name in options.clips}
    else:
        truths = sorted(path.parent for path in options.truth.glob("*/meta.json"))
        clips = {finished(options.work / truth.name, truth): truth for truth in truths}
    rows = []
    for scene, truth in clips.items():
        result = SceneResult(scene)
        bodies, keyframed, model = result.get(BodyTracks), result.get(KeyframedMotion), result.get(SceneModel)
        depth = result.get(MetricDepth)
        assert bodies is not None
        assert depth is not None
        assert keyframed is not None
        assert model is not None
        motions = {"stage humans": bodies.people[0]}
        for name, config in SETTINGS.items():
            ctx = StageContext(options.work)
            motions[name] = refine_motion(bodies, depth, keyframed, model, config, ctx).people[0]
        for name, motion in motions.items():
            numbers = against_media(scene.name, motion, options.media) if truth is None else against_clip(motion, truth)
            rows.append({"clip": scene.name, "setting": name} | dict(zip(COLUMNS, numbers, strict=True)))
            print(rows[-1], flush=True)
    print(table(rows))
    date = datetime.date.today().isoformat()
    found = {"date": date, "machine": f"{platform.machine()}, Python {platform.python_version()}", "rows": rows}
    options.out.mkdir(parents=True, exist_ok=True)
    kind = "real" if options.truth is None else "synthetic"
    path = options.out / f"keyframe_spacing-{kind}-{date}.json"
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def finished(scene: Path, truth: Path) -> Path:
    """The scene folder of a synthetic clip, run to stage keyframes."""
    words = ["run", str(truth / "video.mp4"), "--out", str(scene), "--until", "keyframes"]
    subprocess.run([sys.executable, "-m", "video2anim.cli.main", *words], check=True, stdout=subprocess.DEVNULL)
    return scene


def against_clip(motion: BodyMotion, truth: Path) -> tuple[float, ...]:
    """Errors against a synthetic clip, from the first to the last common frame."""
    true = read_motion(truth / "truth.npz")
    both = np.flatnonzero(motion.valid & true.valid[: motion.frame_count])
    span = slice(both[0], both[-1] + 1)
    estimated_m, true_m = motion.joints_world_m[span], true.joints_world_m[span]
    return (
        1000 * metrics.w_mpjpe(estimated_m, true_m), 1000 * metrics.pa_mpjpe(estimated_m, true_m),
        metrics.acceleration_error_m_s2(estimated_m, true_m, 30.0),
        metrics.jerk_m_s3(estimated_m, 30.0) / metrics.jerk_m_s3(true_m, 30.0),
    )  # fmt: skip


def against_media(clip: str, motion: BodyMotion, media: Path) -> tuple[float, ...]:
    """Errors against motion capture or triangulation."""
    pa_mm, _, root_mm, acceleration, _, _ = against_truth(clip, motion, media)
    return root_mm, pa_mm, acceleration, metrics.jerk_m_s3(motion.measured_joints_m, 30.0)


def table(rows: list[dict[str, float | str]]) -> str:
    """Means over the clips, Markdown."""
    lines = [f"| | {' | '.join(COLUMNS)} |", "|---" * (1 + len(COLUMNS)) + "|"]
    for name in ("stage humans", *SETTINGS):
        own = [row for row in rows if row["setting"] == name]
        means = [float(np.mean([float(row[key]) for row in own])) for key in COLUMNS]
        lines.append(f"| {name} | " + " | ".join(f"{value:.2f}" for value in means) + " |")
    return "\n".join(lines)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of scene folders")
    parser.add_argument("--truth", type=Path, help="folder of synthetic clips")
    parser.add_argument("--media", type=Path, help="folder of real clips with their references")
    parser.add_argument("--clips", nargs="*", default=[], help="with --media: scene folders in --work")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    return parser.parse_args()


if __name__ == "__main__":
    main()
