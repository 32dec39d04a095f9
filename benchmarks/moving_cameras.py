"""Path of the camera and motion in the world on six synthetic clips whose camera moves.

    python benchmarks/moving_cameras.py --work moving_work --motion ../shared/motion/cmu.npz

Makes the clips of `video2anim synth --preset moving` in `<work>/truth`, runs the pipeline into `<work>/results`
(finished results are kept), and compares with the truth:

- turn: largest angle of the true camera from its first frame, and between true and estimated rotation, degrees;
- path: largest distance of the true camera from its first position, m; path error: mean distance of the estimated one
  from it, in the first camera's axes; the same if the estimated scene had the true scale (height of the camera above
  the floor), which the body height of people decides;
- W-MPJPE of the result, and of the same motion relative to the camera if the camera is taken as fixed (mm).

Writes `benchmarks/results/moving_cameras-<date>.json`.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from v2a_bench import call, number

from scenemi import metrics
from video2anim.geometry.projection import invert_rigid
from video2anim.lab.eval.alignment import match_frames, match_people
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import read_truth
from video2anim.types import CameraEstimate, RefinedMotion

SEED = 9301


@dataclass(frozen=True, slots=True)
class Row:
    """One clip."""

    clip: str
    turn_deg: float
    turn_error_deg: float
    path_m: float
    path_error_m: float
    path_error_at_scale_m: float
    w_mpjpe_mm: float
    w_mpjpe_fixed_mm: float
    pa_mpjpe_mm: float


def main() -> None:
    """Make the clips, run the pipeline, compare, write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("moving_work"), help="clips and scene folders, kept")
    parser.add_argument("--motion", type=Path, nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--seed", type=int, default=SEED, help="seed of the clips; the published table has 9301")
    options = parser.parse_args()
    truth = options.work / "truth"
    motion = [word for path in options.motion for word in ("--motion", str(path))]
    call("synth", "--preset", "moving", "--seed", str(options.seed), "--out", str(truth), *motion)
    rows = []
    for clip in json.loads((truth / "set.json").read_text())["clips"]:
        name = clip["name"]
        scene_dir = options.work / "results" / name
        call("run", str(truth / name / "video.mp4"), "--out", str(scene_dir))
        rows.append(of_clip(scene_dir, truth / name))
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": options.seed,
        "clips": [asdict(row) for row in rows],
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"moving_cameras-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(f"{table(rows)}\n{target}\n")


def of_clip(scene_dir: Path, truth_dir: Path) -> Row:
    """The errors of one clip."""
    result, truth = SceneResult(scene_dir), read_truth(truth_dir)
    camera, refined = result.get(CameraEstimate), result.get(RefinedMotion)
    if camera is None or refined is None:
        raise SystemExit(f"{scene_dir}: {result.why(CameraEstimate, RefinedMotion)}")
    frames = match_frames(result.clip, truth)
    pairs = match_people(refined.people, truth, frames)
    if not pairs:
        raise SystemExit(f"{scene_dir}: nobody is the person of the truth")
    motion, true_person = refined.people[pairs[0].estimate], truth.people[pairs[0].truth]
    used = frames.known & motion.valid & true_person.valid[frames.true_index]
    T_true, T = true_person.T_world_camera[frames.true_index], motion.T_world_camera
    own, true = (invert_rigid(poses[0]) @ poses for poses in (T, T_true))
    scale = T[0, 1, 3] / T_true[0, 1, 3]
    off = np.swapaxes(true[:, :3, :3], 1, 2) @ own[:, :3, :3]
    fixed = motion.in_world(np.broadcast_to(T[0], T.shape))
    true_m = true_person.joints_world_m[frames.true_index][used]
    return Row(
        truth.name,
        float(np.rad2deg(Rotation.from_matrix(true[:, :3, :3]).magnitude()).max()),
        float(np.rad2deg(Rotation.from_matrix(off).magnitude()).max()),
        float(np.linalg.norm(true[:, :3, 3], axis=1).max()),
        float(np.linalg.norm(own[:, :3, 3] - true[:, :3, 3], axis=1).mean()),
        float(np.linalg.norm(own[:, :3, 3] / scale - true[:, :3, 3], axis=1).mean()),
        1000 * metrics.w_mpjpe(motion.joints_world_m[used], true_m),
        1000 * metrics.w_mpjpe(fixed.joints_world_m[used], true_m),
        1000 * metrics.pa_mpjpe(motion.joints_world_m[used], true_m),
    )


def table(rows: list[Row]) -> str:
    """Markdown: one row per clip, then the means."""
    heads = [
        "clip", "turn, deg", "its error", "path, m", "its error, m", "at true scale", "W-MPJPE, mm", "camera fixed",
        "PA-MPJPE, mm",
    ]  # fmt: skip
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in rows:
        name, *values = asdict(row).values()
        lines.append(f"| {name} | " + " | ".join(number(value) for value in values) + " |")
    means = np.mean([list(asdict(row).values())[1:] for row in rows], axis=0)
    return "\n".join([*lines, "| mean | " + " | ".join(number(value) for value in means) + " |"])


if __name__ == "__main__":
    main()
