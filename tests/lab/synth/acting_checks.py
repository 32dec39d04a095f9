"""Numbers of a procedural motion that several tests look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenemi.metrics import jerk_m_s3
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.rotations import axis_angle_from_matrix
from video2anim.lab.synth.acting.measure import measure
from video2anim.lab.synth.world import ProceduralMotion
from video2anim.types.motion import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

FPS = 30.0
_FEET = (7, 8, 10, 11)


def adult(height: float, **other: float) -> ShapedBody:
    return shaped_body(BodyShape("anny", {**ADULT, "height": height, **other}))


@dataclass(frozen=True)
class Numbers:
    jerk_m_s3: float
    peak_jerk_m_s3: float
    slide_m: float
    """Largest motion per frame of a joint in contact."""
    sole_lowest_m: float
    knee_deg: tuple[float, float]
    """Least and most flexion; negative would be backwards."""
    elbow_deg: tuple[float, float]
    ankle_deg: float
    """Largest turn of the foot against the shin."""
    wrist_deg: float
    neck_deg: float
    hip_deg: float
    root_speed_m_s: float
    off_balance_m: float
    """Largest distance of the mass center from the feet's middle line, when both feet stand and nothing moves."""


def numbers(motion: ProceduralMotion, body: ShapedBody) -> Numbers:
    R = motion.R_parent_joint
    joints, world = forward_kinematics(R, motion.translation_m, body.rest_joints_m)
    step = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    both = motion.contact[1:] & motion.contact[:-1]
    third = np.linalg.norm(np.diff(joints, n=3, axis=0), axis=-1) * FPS**3
    soles = np.flatnonzero(np.isin(body.vertex_part, _FEET))
    lowest = body.vertices(world, joints, soles)[..., 1].min()
    angle = np.degrees(axis_angle_from_matrix(R))
    size = np.linalg.norm(angle, axis=-1)
    knee, elbow = angle[:, 4:6, 0], size[:, [JOINT_INDEX["left_elbow"], JOINT_INDEX["right_elbow"]]]
    mass = measure(body).mass
    center = np.einsum("tjc,j->tc", joints, mass)
    middle = joints[:, _FEET].mean(1)
    still = motion.contact[:, _FEET].all(1) & ~motion.contact[:, [0, 9, 20, 21]].any(1)
    slow = np.zeros(len(still), bool)
    slow[1:] = np.linalg.norm(np.diff(center, axis=0), axis=1) * FPS < 0.06
    off = np.linalg.norm((center - middle)[:, [0, 2]], axis=1)[still & slow]
    return Numbers(
        jerk_m_s3(joints, FPS), float(third.max()), float((step * both).max()), float(lowest),
        (float(knee.min()), float(knee.max())), (float(elbow.min()), float(elbow.max())), float(size[:, 7:9].max()),
        float(size[:, 20:22].max()), float(size[:, [12, 15]].max()), float(size[:, 1:3].max()),
        float(step[:, 0].max() * FPS), float(off.max(initial=0.0)),
    )  # fmt: skip
