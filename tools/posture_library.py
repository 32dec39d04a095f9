"""Choose the postures that `scenemi sample` puts at objects, from captured motion.

    python tools/posture_library.py --motion more.npz [--out scenemi/animation/postures.json]

A posture is a captured frame on the average adult, rotated to face +Z. It is the medoid (the frame whose joints are
nearest to those of all others) of the frames of some clips in which the body is still and sits or stands. The clips are
from the CMU Graphics Lab Motion Capture Database (free for any use) and ACCAD's Open Motion Project (CC BY 3.0).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from scenemi.data.container import MotionArchive
from scenemi.data.retarget import retarget
from scenemi.data.sources import attribution_of, license_of
from scenemi.features import canonical_frame
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

CLIPS = {
    "sit": ("cmudaz_14_28", "cmudaz_14_29"),
    "stand": ("accad_female1_A01_Stand", "accad_male1_A01_Stand", "accad_male2_A01_Stand"),
}
"""Clips of people who sit on a stool and rise, and of people who stand."""
STILL_M_S = 0.1
"""Largest mean speed of all joints; people who sit or stand sway with 0.03 to 0.08 m/s."""
LEGS_DEG = {"sit": ((60, 105), (60, 115)), "stand": ((0, 15), (0, 20))}
"""Ranges of the angle of the thighs from straight down, and of the knee flexion."""


def main() -> None:
    """Choose the postures and write them."""
    options = argparse.ArgumentParser()
    options.add_argument("--motion", type=Path, required=True)
    options.add_argument("--out", type=Path, default=Path("scenemi/animation/postures.json"))
    given = options.parse_args()
    archive = MotionArchive.read(given.motion)
    found = {posture: posture_of(archive, posture) for posture in CLIPS}
    sources = {archive.clip(name).source for names in CLIPS.values() for name in names}
    text = {
        "licenses": sorted({license_of(source) for source in sources}),
        "attribution": attribution_of(sorted(sources)).strip(),
        "made_by": "python tools/posture_library.py --motion more.npz", "postures": found,
    }  # fmt: skip
    given.out.write_text(json.dumps(text) + "\n")


def posture_of(archive: MotionArchive, posture: str) -> dict[str, Any]:
    """Clip, frame and pose of a posture."""
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    rows, poses, joints, fits = [], [], [], []
    for name in CLIPS[posture]:
        motion = retarget(archive.clip(name), body)
        joints_m, _ = forward_kinematics(motion.R_parent_joint, motion.translation_m, body.rest_joints_m)
        fit = 30 * np.linalg.norm(np.gradient(joints_m, axis=0), axis=-1).mean(1) < STILL_M_S
        for angle, (low, high) in zip(legs_deg(motion.R_parent_joint, joints_m), LEGS_DEG[posture], strict=True):
            fit &= (angle >= low).all(1) & (angle <= high).all(1)
        faced, posed_m = facing(motion.R_parent_joint, joints_m)
        rows += [(name, frame) for frame in range(len(joints_m))]
        poses.append(faced)
        joints.append(posed_m)
        fits.append(fit)
    number = medoid(np.concatenate(joints), np.concatenate(fits))
    axis_angle = axis_angle_from_matrix(np.concatenate(poses)[number])
    return {"clip": rows[number][0], "frame": rows[number][1], "axis_angle": np.round(axis_angle, 4).tolist()}


def legs_deg(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"], joints_m: Float[np.ndarray, "frames 22 3"]
) -> tuple[Float[np.ndarray, "frames 2"], Float[np.ndarray, "frames 2"]]:
    """Angle of each thigh from straight down, and bend of each knee."""
    hip, knee = ([JOINT_INDEX[f"{side}_{name}"] for side in ("left", "right")] for name in ("hip", "knee"))
    thigh_m = joints_m[:, knee] - joints_m[:, hip]
    down = np.arccos(np.clip(-thigh_m[..., 1] / np.linalg.norm(thigh_m, axis=-1), -1, 1))
    bend = np.linalg.norm(axis_angle_from_matrix(R_parent_joint[:, knee]), axis=-1)
    return np.degrees(down), np.degrees(bend)


def facing(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"], joints_m: Float[np.ndarray, "frames 22 3"]
) -> tuple[Float[np.ndarray, "frames 22 3 3"], Float[np.ndarray, "frames 22 3"]]:
    """Poses rotated to face +Z, and their joints relative to the pelvis."""
    faced, posed_m = R_parent_joint.copy(), joints_m - joints_m[:, :1]
    for frame, R in enumerate(R_parent_joint[:, 0]):
        R_canonical_world = canonical_frame(R, np.zeros(3))[:3, :3].T
        faced[frame, 0] = R_canonical_world @ R
        posed_m[frame] = posed_m[frame] @ R_canonical_world.T
    return faced, posed_m


def medoid(joints_m: Float[np.ndarray, "frames 22 3"], among: Bool[np.ndarray, "frames"]) -> int:
    """Index of the frame among those of the mask that is nearest to all the others."""
    rows = np.flatnonzero(among)
    rows = rows[:: max(1, len(rows) // 500)]
    apart = np.linalg.norm(joints_m[rows, None] - joints_m[None, rows], axis=-1).mean((1, 2))
    return int(rows[apart.argmin()])


if __name__ == "__main__":
    main()
