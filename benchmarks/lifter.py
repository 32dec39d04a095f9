"""Body estimates from landmarks to result, on every clip that has truth: raw, lifter, humans, result.

    python benchmarks/lifter.py --scenes real_work bench_work/results --media ../shared/media --truth bench_work/truth

`--scenes` takes folders of scene folders, as `real_clips.py` and `v2a_bench.py` leave them; clips without truth are
left out. Rows, main person, 12 limb joints:

- raw: BlazePose's 3D landmarks;
- lifter: its output alone, for the track and camera of the scene (`--lifter FILE`: other weights);
- humans, result: stages humans and refine.

PA-MPJPE, root-relative MPJPE (hips at one place in each frame), acceleration error of the joints relative to the hips.
The `ocv` clips (markers) are scored by `eval_mocap.py` of the media, whose root-relative error allows one heading for
the clip; Pose2Sim (triangulated BlazePose landmarks, a bias that all rows share) and V2A-Bench in the camera.
Writes JSON and prints Markdown.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from real_clips import HIPS, LANDMARKS, LIMBS, mocap_report

from scenemi.metrics import align_similarity
from video2anim.body.anny_body import shaped_body
from video2anim.digest import file_digest
from video2anim.humans.lifting import lift
from video2anim.humans.observe import at_frame_times, observations
from video2anim.lab.eval.alignment import match_frames, match_people
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import read_truth
from video2anim.networks.fetch import model_path
from video2anim.networks.lifter import Lifter
from video2anim.networks.table import find_model
from video2anim.types import BodyTracks, CameraEstimate, PersonTracks, RefinedMotion
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_NAMES, forward_kinematics

NAMES = [JOINT_NAMES[joint] for joint in LIMBS]
ROWS = ("raw", "lifter", "humans", "result")
NUMBERS = ("PA", "root-relative", "acceleration")


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Limb joints of one row in the camera, and when."""

    joints_m: np.ndarray
    """(frames, 12, 3), NaN where there are none."""
    time_s: np.ndarray
    R_world_camera: np.ndarray
    """(frames, 3, 3), world +Y up."""


Score = Callable[[Estimate], tuple[float, ...]]


def main() -> None:
    """Score every clip, write the report."""
    options = arguments()
    file = options.lifter or model_path(find_model("lifter"))
    found = {}
    for folder in sorted(run.parent for root in options.scenes for run in root.glob("*/run.json")):
        score = scorer(folder, options)
        if score is not None:
            found[folder.name] = {row: score(one) for row, one in estimates(folder, Lifter(file)).items()}
            sys.stderr.write(f"{folder.name} {found[folder.name]}\n")
    report = {
        "date": datetime.date.today().isoformat(), "seed": 0,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "lifter": {"sha256": file_digest(file), "bytes": file.stat().st_size}, "numbers": NUMBERS, "clips": found,
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"lifter-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(markdown(found))


def estimates(folder: Path, network: Lifter) -> dict[str, Estimate]:
    """The four rows of a scene folder."""
    result = SceneResult(folder)
    tracks, camera = result.get(PersonTracks), result.get(CameraEstimate)
    bodies, refined = result.get(BodyTracks), result.get(RefinedMotion)
    if tracks is None or camera is None or bodies is None or refined is None:
        raise SystemExit(f"{folder}: {result.why(PersonTracks, CameraEstimate, BodyTracks, RefinedMotion)}")
    clip, motion = result.clip, refined.people[0]
    track = at_frame_times(tracks.selected()[0].whole(clip.frame_count), clip)
    lifted = lift(observations(track, clip.frame_time_s, camera.intrinsics, camera.up_in_frames), network)
    rest_m = shaped_body(bodies.people[0].shape).rest_joints_m
    lifted_m, _ = forward_kinematics(lifted.R_parent_joint, np.zeros((len(track.valid), 3)), rest_m)
    joints_m = {
        "raw": track.landmarks_m[:, LANDMARKS], "lifter": lifted_m[:, LIMBS],
        "humans": bodies.people[0].joints_camera_m[:, LIMBS], "result": motion.joints_camera_m[:, LIMBS],
    }  # fmt: skip
    valid = (track.valid & motion.valid)[:, None, None]
    R = motion.T_world_camera[:, :3, :3]
    return {row: Estimate(np.where(valid, one, np.nan), clip.frame_time_s, R) for row, one in joints_m.items()}


def scorer(folder: Path, options: argparse.Namespace) -> Score | None:
    """What scores the estimates of a scene folder; None without truth."""
    clip = folder.name
    if options.truth and (options.truth / clip / "meta.json").is_file():
        result, truth = SceneResult(folder), read_truth(options.truth / clip)
        bodies = result.get(BodyTracks)
        assert bodies is not None
        pairs = match_people(bodies.people[:1], truth, match_frames(result.clip, truth))
        if not pairs:
            return None
        person = truth.people[pairs[0].truth]
        return lambda one: in_camera(one, person.joints_camera_m[:, LIMBS], person.frame_time_s)
    reference = options.media / "reference" / f"{clip}_joints.npz" if options.media else None
    if reference is None or not reference.is_file():
        return None
    if clip.startswith("ocv_"):
        return lambda one: by_markers(one, clip, options.media)
    with np.load(reference) as data:
        true_m, time_s = data["landmarks_camera_m"][:, LANDMARKS], data["frame_time_s"]
    return lambda one: in_camera(one, true_m, time_s)


def in_camera(one: Estimate, true_m: np.ndarray, true_s: np.ndarray) -> tuple[float, ...]:
    """PA and root-relative MPJPE in mm, acceleration error in m/s2, in the frames that both have."""
    nearest = np.abs(true_s[None] - one.time_s[:, None]).argmin(1)
    there_m = np.where((np.abs(true_s[nearest] - one.time_s) < 0.5 / 60)[:, None, None], true_m[nearest], np.nan)
    off_m = one.joints_m - one.joints_m[:, HIPS].mean(1, keepdims=True) - there_m
    off_m += there_m[:, HIPS].mean(1, keepdims=True)
    pa = []
    for estimated, truth in zip(one.joints_m, there_m, strict=True):
        known = np.isfinite(estimated).all(1) & np.isfinite(truth).all(1)
        if known.sum() >= 8:
            fit = align_similarity(estimated[known], truth[known])
            pa.append(np.linalg.norm(fit(estimated[known]) - truth[known], axis=1).mean())
    acceleration = np.linalg.norm(np.diff(off_m, n=2, axis=0), axis=-1) * FPS**2
    relative = np.linalg.norm(off_m, axis=-1)
    return 1000 * float(np.mean(pa)), 1000 * float(np.nanmean(relative)), float(np.nanmean(acceleration))


def by_markers(one: Estimate, clip: str, media: Path) -> tuple[float, ...]:
    """The same by `eval_mocap.py`."""
    relative_m = one.joints_m - one.joints_m[:, HIPS].mean(1, keepdims=True)
    world_m = np.einsum("tab,tjb->tja", one.R_world_camera, relative_m)
    valid = np.isfinite(world_m).all((1, 2))
    with tempfile.TemporaryDirectory() as folder:
        motion = Path(folder) / "motion.npz"
        np.savez(motion, joints_world_m=world_m, frame_time_s=one.time_s, valid=valid, joint_names=NAMES)
        found = mocap_report(motion, clip, media)
    return found["pa_mpjpe_mm"], found["mpjpe_root_mm"], found["accel_error_m_s2"]


def markdown(found: dict[str, dict[str, tuple[float, ...]]]) -> str:
    """A line for each clip: every number of every row."""
    heads = " | ".join(f"{number}: {row}" for number in NUMBERS for row in ROWS)
    lines = [f"| | {heads} |", "|---" * (1 + len(NUMBERS) * len(ROWS)) + "|"]
    table = {clip: np.array([rows[row] for row in ROWS]) for clip, rows in found.items()}
    for clip, numbers in (table | {f"mean of {len(table)}": np.mean(list(table.values()), 0)}).items():
        lines.append(f"| {clip} | " + " | ".join(f"{value:.1f}" for value in numbers.T.ravel()) + " |")
    return "\n".join(lines) + "\n"


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", required=True)
    parser.add_argument("--media", type=Path, help="folder with reference/ and eval_mocap.py")
    parser.add_argument("--truth", type=Path, help="truth folders of V2A-Bench")
    parser.add_argument("--lifter", type=Path, help="ONNX file (default: the shipped weights)")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
