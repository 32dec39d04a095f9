"""Minutes of walking through a furnished room, in-betweened: seams, drift, collisions, time.

    python benchmarks/scenemi/room_walk.py [--minutes 5] [--intervals 30 60] [--weights small]

Somebody walks laps of a figure of eight in a furnished room of the synthetic world (procedural motion; furniture comes
within a hand's width of the body). Every 30th or 60th frame is a keyframe; the rest is made as by `scenemi sample`.
`drift` is the error in the last minute over that in the first; `inside` the share of frames with skin over 1 cm inside
furniture or walls; `seams` and `keyframes` are jerk there over the median of the motion. Writes `room_walk.json`.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenemi.cli.sample_motion import sample_motion
from scenemi.data.files import write_json
from scenemi.data.keyframes import Keyframes
from scenemi.evaluation.seams import seam_jerk
from scenemi.longmotion import KeyframeMotion
from scenemi.metrics import foot_skating_gmd
from scenemi.model.choice import INTERPOLATION, load_prior_by_name
from scenemi.scene.geometry import SceneGeometry
from scenemi.windows import select_keyframes
from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.lab.synth.acting.measure import measure
from video2anim.lab.synth.acting.perform import SolvedMotion, perform
from video2anim.lab.synth.acting.script import Script
from video2anim.lab.synth.acting.walking import random_pace, walk
from video2anim.lab.synth.compose import draw_shape
from video2anim.lab.synth.rooms import build_room
from video2anim.types import Mesh
from video2anim.types.clip import FPS
from video2anim.types.skeleton import forward_kinematics

HALF_M = (3.0, 1.6)
"""Half the extent of the figure of eight: two loops that furniture fits into."""
SKIN_STRIDE, FRAME_STRIDE = 8, 3
"""Points of the skin and frames that are tested against the room."""


def main() -> None:
    """Walk, fill, measure, write."""
    options = arguments()
    rng = np.random.default_rng(options.seed)
    body = shaped_body(draw_shape(rng))
    truth = laps(body, rng, options.minutes)
    frames = len(truth.t)
    meshes = furniture(body, truth, rng)
    scene = SceneGeometry(
        sum((SceneGeometry.from_mesh(one.vertices_m, one.faces, fill=True).parts for one in meshes), ())
        + SceneGeometry.floor().parts
    )
    field = distances(meshes)
    rows: list[dict[str, Any]] = [{"row": "truth", **seen(truth.translation_m, truth.R_parent_joint, body, field)}]
    for interval in options.intervals:
        keys = select_keyframes(frames, interval)
        given = Keyframes(keys, truth.R_parent_joint[keys], truth.translation_m[keys], body.rest_joints_m, body.shape)
        for name in (INTERPOLATION, options.weights):
            prior = load_prior_by_name(name)
            begin = time.perf_counter()
            made = sample_motion(given, prior, scene=scene, length=frames).motion
            took_s = time.perf_counter() - begin
            row = {"row": f"{name}, r = {interval}", "minutes": took_s / 60}
            row |= seen(made.translation_world_m, made.R_parent_joint, body, field)
            row |= against(made.translation_world_m, made.R_parent_joint, truth, body)
            is_key = np.zeros(frames, bool)
            is_key[keys] = True
            jerk = seam_jerk(
                KeyframeMotion(truth.R_parent_joint, truth.translation_m, is_key, body.rest_joints_m), made
            )
            row |= {"keyframes": float(np.median(jerk.at_keyframes))}
            row |= {"seams": float(np.median(jerk.at_seams))} if len(jerk.at_seams) else {}
            row["keyframe error, m"] = float(np.abs((made.translation_world_m - truth.translation_m)[keys]).max())
            rows.append(row)
            sys.stderr.write(f"{row}\n")
    report = {
        "date": datetime.date.today().isoformat(), "seed": options.seed, "frames": frames, "solids": len(meshes),
        "way, m": float(np.linalg.norm(np.diff(truth.translation_m[:, [0, 2]], axis=0), axis=1).sum()),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads", "rows": rows,
    }  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "room_walk.json", report)


def laps(body: ShapedBody, rng: np.random.Generator, minutes: float) -> SolvedMotion:
    """Laps of a figure of eight, as many as fit into the time."""
    script = Script.standing(measure(body), rng)
    pace = random_pace(script)
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    lap = np.stack([HALF_M[0] * np.sin(angle), np.zeros(len(angle)), HALF_M[1] * np.sin(2 * angle)], -1)
    length_m = float(np.linalg.norm(np.diff(lap, axis=0, append=lap[:1]), axis=1).sum())
    count = max(1, int(60 * minutes * pace.step_m / pace.step_s / length_m))
    # It begins where the body stands, in its direction.
    ahead, yaw = lap[1] - lap[0], script.yaw_rad
    turn = yaw - np.arctan2(ahead[0], ahead[2])
    c, s = np.cos(turn), np.sin(turn)
    path = np.tile(lap, (count, 1)) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + script.center_m
    walk(script, path, pace)
    return perform(script)


def furniture(body: ShapedBody, truth: SolvedMotion, rng: np.random.Generator) -> list[Mesh]:
    """Furniture and walls around the motion, one mesh each."""
    frames = slice(None, None, 6)
    swept_m = body.vertices(truth.R_world_joint[frames], truth.joints_m[frames])[:, ::40].reshape(-1, 3)
    room = build_room(rng, swept_m=swept_m.astype(np.float64), clutter=0.9)
    merged = [one.merged() for one in room.objects if one.label != "floor"]
    return [Mesh(vertices, faces, np.zeros(vertices.shape, np.uint8)) for vertices, faces in merged]


def distances(meshes: list[Mesh]) -> SdfGrid:
    """Signed distances in the room, without the floor."""
    points_m = np.concatenate([mesh.vertices_m for mesh in meshes])
    bounds_m = np.stack([points_m.min(0) - 0.1, np.minimum(points_m.max(0) + 0.1, [np.inf, 2.2, np.inf])])
    return build_sdf_grid(meshes, bounds_m, 0.04, floor_y_m=None)


def seen(translation_m: np.ndarray, R_parent_joint: np.ndarray, body: ShapedBody, field: SdfGrid) -> dict[str, float]:
    """Collisions and skating of a motion."""
    joints_m, R_world_joint = forward_kinematics(R_parent_joint, translation_m, body.rest_joints_m)
    deepest_m = []
    for start in range(0, len(joints_m), 100 * FRAME_STRIDE):
        some = slice(start, start + 100 * FRAME_STRIDE, FRAME_STRIDE)
        skin_m = body.vertices(R_world_joint[some], joints_m[some])[:, ::SKIN_STRIDE]
        deepest_m += (-field.sample(skin_m.reshape(-1, 3)).reshape(len(skin_m), -1).min(1)).tolist()
    return {
        "inside": float((np.array(deepest_m) > 0.01).mean()), "deepest, m": float(max(deepest_m)),
        "skating": float(foot_skating_gmd(joints_m, FPS)),
    }  # fmt: skip


def against(
    translation_m: np.ndarray, R_parent_joint: np.ndarray, truth: SolvedMotion, body: ShapedBody
) -> dict[str, float]:
    """Error of the joints, and how it grows with time."""
    joints_m, _ = forward_kinematics(R_parent_joint, translation_m, body.rest_joints_m)
    error_m = np.linalg.norm(joints_m - truth.joints_m, axis=-1).mean(1)
    minute = min(round(60 * FPS), len(error_m) // 2)
    return {"error, m": float(error_m.mean()), "drift": float(error_m[-minute:].mean() / error_m[:minute].mean())}


def arguments() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--intervals", type=int, nargs="+", default=[30, 60])
    parser.add_argument("--weights", default="small")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/scenemi/results"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
