"""BVH: the skeleton and its motion for animation tools.

Centimeters (what the field's retargeting tools expect of BVH), +Y up, 30 fps. OFFSETs are the T-pose; the root has six
channels, the others three. Rotation channels are `Zrotation Yrotation Xrotation`: R = Rz Ry Rx, in degrees. BVH has
no place for missing measurements: such frames hold the held or interpolated pose of the motion.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from video2anim.export.character import Character
from video2anim.export.frames import CENTIMETERS_PER_METER
from video2anim.types import BodyMotion
from video2anim.types.skeleton import JOINT_NAMES, PARENTS


def write_bvh(path: Path, character: Character) -> None:
    """Write one person's motion.

    End sites are the tips of the mesh beyond head, hands and toes.
    """
    motion = character.motion
    offsets_cm = character.joint_offsets_m * CENTIMETERS_PER_METER
    tips_cm = character.tips_m * CENTIMETERS_PER_METER
    lines = ["HIERARCHY", *_joint_lines(0, offsets_cm, tips_cm, depth=0), "MOTION"]
    lines += [f"Frames: {motion.frame_count}", f"Frame Time: {_frame_time_s(motion):.8f}"]
    order = _depth_first(0)
    euler_deg = np.degrees(continuous_euler_zyx(motion.R_parent_joint))[:, order]
    # The root's OFFSET and its position channels add up.
    root_cm = character.root_translation_m * CENTIMETERS_PER_METER - offsets_cm[0]
    values = np.concatenate([root_cm, euler_deg.reshape(motion.frame_count, -1)], axis=1)
    lines += [" ".join(f"{value:.6f}" for value in row) for row in values.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def continuous_euler_zyx(
    R_a_b: Float[np.ndarray, "frames joints 3 3"],
) -> Float[np.ndarray, "frames joints 3"]:
    """Angles (z, y, x) in radians with R = Rz Ry Rx, chosen near those of the frame before.

    Every rotation has two such triples, each up to full turns; at a gimbal lock (y = +-90 degrees) x is 0.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock")
        angles = Rotation.from_matrix(R_a_b.reshape(-1, 3, 3)).as_euler("ZYX").reshape(R_a_b.shape[:-1])
    z, y, x = np.moveaxis(angles, -1, 0)
    turned = np.stack([z + np.pi, np.pi - y, x + np.pi], -1)
    for frame in range(1, len(angles)):
        before = angles[frame - 1]
        first, second = (_nearest_turn(choice[frame], before) for choice in (angles, turned))
        nearer = np.abs(first - before).max(-1) <= np.abs(second - before).max(-1)
        angles[frame] = np.where(nearer[..., None], first, second)
    return angles


def _nearest_turn(angle_rad: np.ndarray, reference_rad: np.ndarray) -> np.ndarray:
    return angle_rad + 2.0 * np.pi * np.round((reference_rad - angle_rad) / (2.0 * np.pi))


def _frame_time_s(motion: BodyMotion) -> float:
    if motion.frame_count < 2:
        return 1.0 / 30.0
    return float((motion.frame_time_s[-1] - motion.frame_time_s[0]) / (motion.frame_count - 1))


def _children(joint: int) -> list[int]:
    return np.flatnonzero(joint == PARENTS).tolist()


def _depth_first(joint: int) -> list[int]:
    return [joint, *(below for child in _children(joint) for below in _depth_first(child))]


def _joint_lines(joint: int, offsets_cm: np.ndarray, tips_cm: np.ndarray, depth: int) -> list[str]:
    pad = "\t" * depth
    position = "Xposition Yposition Zposition " if depth == 0 else ""
    lines = [
        f"{pad}{'ROOT' if depth == 0 else 'JOINT'} {JOINT_NAMES[joint]}",
        f"{pad}{{",
        f"{pad}\tOFFSET {_triple(offsets_cm[joint])}",
        f"{pad}\tCHANNELS {6 if depth == 0 else 3} {position}Zrotation Yrotation Xrotation",
    ]
    children = _children(joint)
    for child in children:
        lines += _joint_lines(child, offsets_cm, tips_cm, depth + 1)
    if not children:
        lines += [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {_triple(tips_cm[joint])}", f"{pad}\t}}"]
    return [*lines, f"{pad}}}"]


def _triple(vector: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in vector.tolist())
