"""Errors of the motion in intervals in which the person is hidden, on six synthetic clips, with and without the prior.

    python benchmarks/hidden_stretches.py --work hidden_work

Makes the clips of `video2anim synth --preset hidden --seed 0` in `<work>/truth`, runs the pipeline into
`<work>/results` (finished results are kept), and compares on every hidden interval of 0.3 s and more:

- refined: the result;
- without prior: the same solve without the prior, from the observed motion with bridged gaps;
- interpolation: joint rotations (slerp) and root (linear) of stage humans between the last visible frame before the
  interval and the first one after it.

W-MPJPE is aligned (similarity) by the last two visible frames before the interval, PA-MPJPE in every frame. Intervals
of 1 s and more are reported separately. If the tracker gives the person another ID after an interval (column `IDs`),
the pipeline fills nothing; the two tracks are then joined by the truth, and refine runs on the result. Intervals after
which the person is not found again are in no mean. Writes `benchmarks/results/hidden_stretches-<date>.json`.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from v2a_bench import call, number

from scenemi import metrics
from stages.refine import RefineConfig, refine_motion
from video2anim.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp
from video2anim.lab.eval.alignment import FrameMatch, match_frames, match_people
from video2anim.lab.eval.hidden import hidden_frames, hidden_stretches
from video2anim.lab.eval.results import SceneResult
from video2anim.lab.eval.truth import Truth, read_truth
from video2anim.pipeline.stage import StageContext
from video2anim.types import BodyMotion, BodyTracks, KeyframedMotion, MetricDepth, RefinedMotion, SceneModel

SEED = 0
LONG_S = 1.0
BAR = 0.6
"""Target: largest ratio of W-MPJPE of the result to that of interpolation, on intervals of `LONG_S` and more."""
METHODS = ("refined", "without prior", "interpolation")


@dataclass(frozen=True, slots=True)
class Stretch:
    """One hidden interval of one clip; errors in mm by method, empty if the person is not found again."""

    clip: str
    first_frame: int
    last_frame: int
    seconds: float
    measured: float
    """Share of its frames in which the tracker reports a person."""
    ids: int
    """Number of track IDs of the person."""
    prior: str
    w_mpjpe_mm: dict[str, float]
    pa_mpjpe_mm: dict[str, float]


def main() -> None:
    """Make the clips, run the pipeline, compare, write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("hidden_work"), help="clips and scene folders, kept")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--seed", type=int, default=SEED, help="seed of the clips; the published table has 0")
    options = parser.parse_args()
    truth = options.work / "truth"
    call("synth", "--preset", "hidden", "--seed", str(options.seed), "--out", str(truth))
    names = [clip["name"] for clip in json.loads((truth / "set.json").read_text())["clips"]]
    stretches: list[Stretch] = []
    for name in names:
        scene_dir = options.work / "results" / name
        call("run", str(truth / name / "video.mp4"), "--out", str(scene_dir), "--person", "all", "--until", "refine")
        stretches += of_clip(scene_dir, truth / name)
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "seed": options.seed,
        "stretches": [asdict(one) for one in stretches],
        "means": {"long": means(stretches, long=True), "short": means(stretches, long=False)},
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / f"hidden_stretches-{report['date']}.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    sys.stdout.write(f"{table(stretches)}\n{target}\n")


def of_clip(scene_dir: Path, truth_dir: Path) -> list[Stretch]:
    """The hidden intervals of one clip."""
    result, truth = SceneResult(scene_dir), read_truth(truth_dir)
    bodies, keyframed = result.get(BodyTracks), result.get(KeyframedMotion)
    scene, refined = result.get(SceneModel), result.get(RefinedMotion)
    depth = result.get(MetricDepth)
    if bodies is None or depth is None or keyframed is None or scene is None or refined is None:
        why = result.why(BodyTracks, MetricDepth, KeyframedMotion, SceneModel, RefinedMotion)
        raise SystemExit(f"{scene_dir}: {why}")
    frames = match_frames(result.clip, truth)
    same = [k for k, person in enumerate(bodies.people) if match_people([person], truth, frames)]
    if not same:
        raise SystemExit(f"{scene_dir}: nobody of stage humans is the person of the truth")
    raw, person = bodies.people[same[0]], same[0]
    if len(same) > 1:
        raw = joined([bodies.people[k] for k in same])
        given = KeyframedMotion((joined([keyframed.people[k] for k in same]),), (keyframed.keyframe_index[person],))
        ctx = StageContext(scene_dir)
        refined, person = refine_motion(BodyTracks((raw,)), depth, given, scene, RefineConfig(), ctx), 0
    motions = {"refined": refined.people[person], "without prior": refined.without_prior[person]}
    hidden = hidden_frames(truth)[frames.true_index]
    return [
        Stretch(
            truth.name, first, last, (last - first + 1) / truth.fps, float(raw.valid[first : last + 1].mean()),
            len(same), refined.prior[person], *errors(truth, frames, hidden, (first, last), raw, motions),
        )
        for first, last in hidden_stretches(hidden, truth.fps)
    ]  # fmt: skip


def joined(people: list[BodyMotion]) -> BodyMotion:
    """One motion from several tracks of one person, with the body shape of the first; later tracks where measured."""
    first = people[0]
    R, root_m = first.R_parent_joint.copy(), first.T_world_root[:, :3, 3].copy()
    contact, valid = first.contact.copy(), first.valid.copy()
    for other in people[1:]:
        own = other.valid & ~valid
        R[own], root_m[own], contact[own] = (
            other.R_parent_joint[own],
            other.T_world_root[own, :3, 3],
            other.contact[own],
        )
        valid |= own
    return replace(first, contact=contact, valid=valid).with_pose(translation_world_m=root_m, R_parent_joint=R)


def errors(
    truth: Truth, frames: FrameMatch, hidden: np.ndarray, span: tuple[int, int], raw: BodyMotion,
    motions: dict[str, BodyMotion],
) -> tuple[dict[str, float], dict[str, float]]:  # fmt: skip
    """W-MPJPE and PA-MPJPE of each method on one interval, in mm; empty if the person is not measured around it."""
    first, last = span
    in_sight = raw.valid & ~hidden
    before, after = np.flatnonzero(in_sight[:first])[-2:], last + 1 + np.flatnonzero(in_sight[last + 1 :])[:1]
    if len(before) < 2 or not len(after):
        return {}, {}
    rows = np.concatenate([before, np.arange(first, last + 1)])
    true_m = truth.main.joints_world_m[frames.true_index[rows]]
    made = {name: motion.joints_world_m[rows] for name, motion in motions.items()}
    made["interpolation"] = interpolated(raw, int(before[1]), int(after[0])).joints_world_m[rows]
    w = {name: 1000 * w_mpjpe_after(joints_m, true_m) for name, joints_m in made.items()}
    pa = {name: 1000 * metrics.pa_mpjpe(joints_m[2:], true_m[2:]) for name, joints_m in made.items()}
    return w, pa


def w_mpjpe_after(estimate_m: np.ndarray, true_m: np.ndarray) -> float:
    """Mean error in meters of all frames but the first two, by which the estimate is aligned (W-MPJPE)."""
    head = slice(0, metrics.W_ALIGN_FRAMES)
    align = metrics.align_similarity(estimate_m[head].reshape(-1, 3), true_m[head].reshape(-1, 3))
    return metrics.mpjpe(align(estimate_m[metrics.W_ALIGN_FRAMES :]), true_m[metrics.W_ALIGN_FRAMES :])


def interpolated(motion: BodyMotion, first: int, last: int) -> BodyMotion:
    """The motion with the frames between two others interpolated: slerp of rotations, linear root."""
    R, root_m = motion.R_parent_joint.copy(), motion.T_world_root[:, :3, 3].copy()
    share = np.linspace(0.0, 1.0, last - first + 1)
    ends = quaternion_from_matrix(R[[first, last]])
    R[first : last + 1] = matrix_from_quaternion(slerp(ends[[0]], ends[[1]], share[:, None, None]))
    root_m[first : last + 1] = root_m[first] + share[:, None] * (root_m[last] - root_m[first])
    return motion.with_pose(translation_world_m=root_m, R_parent_joint=R)


def means(stretches: list[Stretch], *, long: bool) -> dict[str, Any]:
    """Means over the intervals of 1 s and more, or over the shorter ones, and the ratio for `BAR`."""
    chosen = [one for one in stretches if (one.seconds >= LONG_S) == long and one.w_mpjpe_mm]
    if not chosen:
        return {"stretches": 0}
    w = {name: float(np.mean([one.w_mpjpe_mm[name] for one in chosen])) for name in METHODS}
    pa = {name: float(np.mean([one.pa_mpjpe_mm[name] for one in chosen])) for name in METHODS}
    ratio = w["refined"] / w["interpolation"]
    return {"stretches": len(chosen), "w_mpjpe_mm": w, "pa_mpjpe_mm": pa, "ratio": ratio}


def table(stretches: list[Stretch]) -> str:
    """Markdown: one row per interval, then the means."""
    heads = [
        "clip",
        "hidden, s",
        "claimed",
        "IDs",
        *(f"W, {name}" for name in METHODS),
        *(f"PA, {name}" for name in METHODS),
    ]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for one in stretches:
        cells = [number(part[name]) for part in (one.w_mpjpe_mm, one.pa_mpjpe_mm) for name in METHODS if part]
        texts = cells or ["not found again"]
        lines.append(f"| {one.clip} | {one.seconds:.2f} | {one.measured:.2f} | {one.ids} | " + " | ".join(texts) + " |")
    for long, title in ((True, "1 s and more"), (False, "shorter")):
        mean = means(stretches, long=long)
        if mean["stretches"]:
            cells = [number(mean[part][name]) for part in ("w_mpjpe_mm", "pa_mpjpe_mm") for name in METHODS]
            lines.append(f"| mean, {title} ({mean['stretches']}) | | | | " + " | ".join(cells) + " |")
    long = means(stretches, long=True)
    if long["stretches"]:
        lines += ["", f"W-MPJPE over interpolation's, 1 s and more: {long['ratio']:.2f} (bar: {BAR})"]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
