"""What carries a body of which no part is said to touch anything: its lowest part, unless it falls.

The lifter's contacts are learnt from people who stand, walk, sit and reach. Of people on their hands, who dance or do
gymnastics, it says that nothing touches.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import savgol_filter

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import LIKELY, lowest_points
from video2anim.geometry.runs import runs
from video2anim.types import BodyMotion
from video2anim.types.skeleton import JOINT_INDEX, TOUCHING_PARTS

_SEGMENTS = (
    ("pelvis", "spine3", 0.43), ("neck", "head", 0.08),
    ("left_shoulder", "left_elbow", 0.028), ("right_shoulder", "right_elbow", 0.028),
    ("left_elbow", "left_wrist", 0.022), ("right_elbow", "right_wrist", 0.022),
    ("left_hip", "left_knee", 0.100), ("right_hip", "right_knee", 0.100),
    ("left_knee", "left_ankle", 0.061), ("right_knee", "right_ankle", 0.061),
)  # fmt: skip
"""Mass share of body segments (Winter 2009, table 4.1), each at the middle of its joints."""
_GRAVITY_M_S2 = 9.81
_FALLING = 0.25
"""Share of gravity by which a body that is carried may accelerate downward. Looked at on ten real clips: people who
walk, sit and squat stay below it in 95 % of the frames, and jumps are twice as fast or more."""
_HALF_WINDOW_S = 0.14
"""Acceleration is that of a parabola over this time before and after: with heights known to 1 cm, to 1 m/s2."""


def with_support(motion: BodyMotion, fps: float) -> Float[np.ndarray, "frames 22"]:
    """Contact probabilities in which the lowest part carries the body where nothing else does.

    A stretch without contact whose mean acceleration is that of a fall is a flight (jump, running step) and stays.
    """
    free = motion.valid & (motion.contact.max(1) <= LIKELY)
    down_m_s2 = -vertical_acceleration_m_s2(center_of_mass(motion.joints_world_m)[:, 1], fps)
    carried = np.zeros_like(free)
    for begin, end in runs(free):
        if down_m_s2[begin:end].mean() < _FALLING * _GRAVITY_M_S2:
            carried[begin:end] = down_m_s2[begin:end] < _FALLING * _GRAVITY_M_S2
    contact = motion.contact.copy()
    for part, own in _lowest_parts(motion, carried):
        contact[np.ix_(own, np.array(part))] = 1.0
    return contact


def center_of_mass(joints_m: Float[np.ndarray, "frames 22 3"]) -> Float[np.ndarray, "frames 3"]:
    """Whole-body center of mass from segment masses."""
    total = np.zeros((len(joints_m), 3))
    for start, end, share in _SEGMENTS:
        total += share * 0.5 * (joints_m[:, JOINT_INDEX[start]] + joints_m[:, JOINT_INDEX[end]])
    return total / sum(share for _, _, share in _SEGMENTS)


def vertical_acceleration_m_s2(height_m: Float[np.ndarray, "frames"], fps: float) -> Float[np.ndarray, "frames"]:
    """Second derivative of a parabola through the heights around each frame."""
    wanted = 2 * max(2, round(_HALF_WINDOW_S * fps)) + 1
    window = min(wanted, len(height_m) - 1 + len(height_m) % 2)
    if window <= 2:
        return np.zeros(len(height_m))
    return np.asarray(savgol_filter(height_m, window, polyorder=2, deriv=2, delta=1 / fps))


def _lowest_parts(
    motion: BodyMotion, carried: Bool[np.ndarray, "frames"]
) -> list[tuple[tuple[int, ...], Bool[np.ndarray, "frames"]]]:
    """Each touching part, and the frames in which it has the body's lowest point."""
    frames = np.flatnonzero(carried)
    if not len(frames):
        return []
    body = shaped_body(motion.shape)
    lowest = np.full(motion.frame_count, -1)
    lowest[frames] = body.vertex_part[lowest_points(motion, body, frames)[0]]
    return [(part, np.isin(lowest, part)) for part in TOUCHING_PARTS.values()]
