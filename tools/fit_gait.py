"""Fits the walking styles of `video2anim/lab/synth/acting/gait.npz`.

Input: walks of the CMU Graphics Lab motion capture database in the training split. Output: pelvis, spine and arm angles
as Fourier series over the phase of the gait (0 = left heel strike, pi = right). Only coefficients are stored.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from
NSF EIA-0196217. It is free for research and commercial use.

    python tools/fit_gait.py MOTION_FOLDER OUT.npz
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from scenemi.data.container import MotionArchive, read_split
from video2anim.types.skeleton import JOINT_INDEX

HARMONICS = 4
CHANNELS = (
    "pelvis_yaw", "pelvis_roll", "spine_twist", "spine_side", "spine_flex",
    "l_flex", "r_flex", "l_abd", "r_abd", "l_elbow", "r_elbow",
)  # fmt: skip
_MIN_CYCLES = 2
_MIN_SPEED_M_S = 0.6
_SMOOTH_S = 0.5


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def walking_angles(joints_m: Float[np.ndarray, "frames 22 3"], fps: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Channel angles, and the phase of the gait (NaN outside full cycles)."""
    J = {name: joints_m[:, index] for name, index in JOINT_INDEX.items()}
    hips, shoulders = unit(J["left_hip"] - J["right_hip"]), unit(J["left_shoulder"] - J["right_shoulder"])
    hip_yaw = np.unwrap(np.arctan2(-hips[:, 2], hips[:, 0]))
    shoulder_yaw = np.unwrap(np.arctan2(-shoulders[:, 2], shoulders[:, 0]))
    shoulder_yaw += 2 * np.pi * np.round((hip_yaw - shoulder_yaw).mean() / (2 * np.pi))
    heading = gaussian_filter1d(0.5 * (hip_yaw + shoulder_yaw), _SMOOTH_S * fps, mode="nearest")
    ahead = np.stack([np.sin(heading), np.zeros(len(heading)), np.cos(heading)], -1)
    trunk = unit(J["neck"] - 0.5 * (J["left_hip"] + J["right_hip"]))
    angles = {
        "pelvis_yaw": hip_yaw - heading,
        "pelvis_roll": np.arcsin(hips[:, 1]),
        "spine_twist": shoulder_yaw - hip_yaw,
        "spine_side": np.arcsin(shoulders[:, 1]) - np.arcsin(hips[:, 1]),
        "spine_flex": np.arcsin((trunk * ahead).sum(1)),
    }
    front = unit(np.cross(shoulders, trunk))
    up = np.cross(front, shoulders)
    for name, side, out in (("l", "left", 1.0), ("r", "right", -1.0)):
        upper = unit(J[f"{side}_elbow"] - J[f"{side}_shoulder"])
        fore = unit(J[f"{side}_wrist"] - J[f"{side}_elbow"])
        angles[f"{name}_flex"] = np.arctan2((upper * front).sum(1), -(upper * up).sum(1))
        angles[f"{name}_abd"] = np.arcsin(np.clip(out * (upper * shoulders).sum(1), -1, 1))
        angles[f"{name}_elbow"] = np.arccos(np.clip((upper * fore).sum(1), -1, 1))
    knots = []
    for side, offset in (("left", 0.0), ("right", np.pi)):
        reach = ((J[f"{side}_ankle"] - J["pelvis"]) * ahead).sum(1)
        peaks, _ = find_peaks(reach, distance=round(0.7 * fps), prominence=0.1)
        knots += [(int(p), offset) for p in peaks]
    return angles, _phase(sorted(knots), len(heading))


def _phase(knots: list[tuple[int, float]], count: int) -> Float[np.ndarray, "frames"]:
    phase = np.full(count, np.nan)
    for (a, start), (b, stop) in itertools.pairwise(knots):
        if start != stop:
            phase[a : b + 1] = start + np.linspace(0.0, np.pi, b - a + 1)
    return phase


def fit(angles: dict[str, np.ndarray], phase: np.ndarray) -> Float[np.ndarray, "channels coefficients"]:
    """Least-squares mean, then cosine and sine of each harmonic, per channel."""
    known = np.isfinite(phase)
    columns = [np.ones(known.sum())]
    for k in range(1, HARMONICS + 1):
        columns += [np.cos(k * phase[known]), np.sin(k * phase[known])]
    table = np.stack(columns, -1)
    return np.stack([np.linalg.lstsq(table, angles[name][known], rcond=None)[0] for name in CHANNELS])


def main(folder: Path, out: Path) -> None:
    archive, train = MotionArchive.read(folder / "cmu.npz"), set(read_split(folder / "split.json")["train"])
    styles, names = [], []
    for name, kind in zip(archive.names, archive.kinds, strict=True):
        if kind != "walk" or name not in train:
            continue
        clip = archive.clip(name)
        joints = clip.smpl_joints_m()
        if not np.isfinite(joints).all() or "humanoid" in clip.source:
            continue
        path = joints[:, 0][:, [0, 2]]
        speed = np.linalg.norm(path[-1] - path[0]) / len(path) * clip.fps
        angles, phase = walking_angles(joints, clip.fps)
        if speed < _MIN_SPEED_M_S or np.isfinite(phase).sum() < _MIN_CYCLES * clip.fps:
            continue
        coefficients = fit(angles, phase)
        styles.append(coefficients)
        names.append(name)
    np.savez_compressed(
        out, channels=np.array(CHANNELS), clips=np.array(names), coefficients=np.array(styles, np.float32),
        source=np.array("mocap.cs.cmu.edu, created with funding from NSF EIA-0196217"),
    )  # fmt: skip


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
