"""Where a foot stands: orientation and path of one ankle such that sole and joints rest while they touch.

While heel and ball are down the foot lies flat and still. While only the ball is down the toe joint stays and the heel
rises about it; while only the heel is down the ankle stays over its place and the toes come down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from scenemi.data.fading import envelope, faded
from scenemi.data.foot_mesh import Sole
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from video2anim.geometry.runs import runs

_MAX_ROLL_RAD = 0.7
"""Sideways, 40 degrees: beyond, a foot lies on its edge (not measured)."""
_PITCH_RAD = (-0.9, 1.4)
"""Attitudes in which a foot can stand at all; toes down is positive. A lying foot is left alone."""
_FLAT_PITCH_RAD = 0.10
"""Beyond this a foot whose ball is down has its heel up, and one whose heel is down its toes."""
_PITCH_FADE_FRAMES = 5
"""Frames beside flat ones in which the pitch fades, a sixth of a second (not measured)."""
_TOE_BEND = 1.5
"""Toe bend for each radian the heel rises: the mesh's toes follow the toe joint by half."""
_MAX_TOE_BEND_RAD = 0.95
"""Toes bend by 55 degrees at most (not measured)."""
_SLACK = 0.01
"""Share of the leg: so short of straight a leg counts half as much as a straight one (not measured)."""
_LIFT_FRAMES = 4
"""Frames in which a foot is lifted ahead of where the floor asks for it (not measured)."""


@dataclass(frozen=True, slots=True, eq=False)
class FootPose:
    """How one foot is turned in every frame."""

    R_world_ankle: Float[np.ndarray, "frames 3 3"]
    toe_bend_rad: Float[np.ndarray, "frames"]
    contact: Bool[np.ndarray, "frames 2"]
    """Heel, ball."""
    lowest_m: Float[np.ndarray, "frames"]
    """Lowest point of the skin relative to the ankle joint."""

    @property
    def stance(self) -> Bool[np.ndarray, "frames"]:
        return self.contact[:, 0] | self.contact[:, 1]


def turned_about(axis: int, angle_rad: np.ndarray) -> Float[np.ndarray, "frames 3 3"]:
    """Rotations about a coordinate axis."""
    vector = np.zeros((*np.shape(angle_rad), 3))
    vector[..., axis] = angle_rad
    return matrix_from_axis_angle(vector)


def pose_foot(
    R_world_ankle: Float[np.ndarray, "frames 3 3"],
    contact: Bool[np.ndarray, "frames 2"],
    sole: Sole,
    blend: int,
    *,
    has_floor: bool,
) -> FootPose:
    """The source's foot orientation, flattened while the sole touches; corrections fade out within `blend` frames.

    Without a floor the orientation is the source's, held still while heel and ball are down.
    """
    yaw, pitch, roll = _attitude(R_world_ankle)
    contact = contact.copy()
    if has_floor:
        contact &= ((np.abs(roll) < _MAX_ROLL_RAD) & (pitch > _PITCH_RAD[0]) & (pitch < _PITCH_RAD[1]))[:, None]
        contact[:, 0] &= pitch < _FLAT_PITCH_RAD
        contact[:, 1] &= pitch > -_FLAT_PITCH_RAD
    stance = contact[:, 0] | contact[:, 1]
    correction = np.zeros((len(yaw), 3))
    for start, stop in runs(stance):
        span = slice(start, stop)
        flat = contact[span, 0] & contact[span, 1]
        goal_yaw = yaw[span] + _held(yaw[span], flat)
        if has_floor:
            goal_pitch = _grounded_pitch(pitch[span], contact[span])
            goal = turned_about(1, goal_yaw) @ turned_about(0, goal_pitch)
        else:
            goal_pitch, goal_roll = (angle + _held(angle, flat) for angle in (pitch[span], roll[span]))
            goal = turned_about(1, goal_yaw) @ turned_about(0, goal_pitch) @ turned_about(2, goal_roll)
        correction[span] = axis_angle_from_matrix(goal @ np.swapaxes(R_world_ankle[span], -1, -2))
    R_posed = matrix_from_axis_angle(faded(correction, stance, blend)) @ R_world_ankle
    ball = faded(np.ones((len(yaw), 1)), contact[:, 1], 4)[:, 0] if has_floor else np.zeros(len(yaw))
    bend = np.clip(ball, 0, 1) * np.clip(_TOE_BEND * _attitude(R_posed)[1], 0.0, _MAX_TOE_BEND_RAD)
    return FootPose(R_posed, bend, contact, sole.lowest_m(R_posed, R_posed @ turned_about(0, -bend)))


def place_foot(
    foot: FootPose,
    ankle_m: Float[np.ndarray, "frames 3"],
    reach: Float[np.ndarray, "frames"],
    sole: Sole,
    blend: int,
    *,
    has_floor: bool,
) -> Float[np.ndarray, "frames 3"]:
    """Path of the ankle: still in stance near where it was, sole on the floor, never below it in between.

    `reach` is the hip-ankle distance as a share of the leg: where a source slides in stance, the foot stands where the
    leg is longest, which has no slack to go elsewhere.
    """
    weight = 1.0 / (_SLACK + np.maximum(0.0, 1.0 - reach))
    toe_m = foot.R_world_ankle @ sole.toe_offset_m
    shift = np.zeros_like(ankle_m)
    for start, stop in runs(foot.stance):
        span = slice(start, stop)
        ball = foot.contact[span, 1]
        step = np.where((ball[1:] & ball[:-1])[:, None], -np.diff(toe_m[span], axis=0), 0.0)
        path = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
        path += np.average(ankle_m[span] - path, axis=0, weights=weight[span])
        if has_floor:
            path[:, 1] = -foot.lowest_m[span]
        shift[span] = path - ankle_m[span]
    placed = ankle_m + faded(shift, foot.stance, blend)
    if has_floor:
        placed[:, 1] += _lift(placed[:, 1] + foot.lowest_m, foot.stance)
    return placed


def _attitude(R_world_ankle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Yaw, pitch (toes down positive) and roll of a foot: R = Ry(yaw) Rx(pitch) Rz(roll); yaw is continuous."""
    R = R_world_ankle
    pitch = np.arcsin(np.clip(-R[:, 1, 2], -1, 1))
    # Beyond toes straight down (kneeling) the side axis still tells the heading.
    over = R[:, 1, 1] < 0
    yaw = np.where(over, np.arctan2(-R[:, 0, 2], -R[:, 2, 2]), np.arctan2(R[:, 0, 2], R[:, 2, 2]))
    pitch = np.where(over, np.sign(pitch) * np.pi - pitch, pitch)
    roll = np.arctan2(R[:, 1, 0], R[:, 1, 1])
    roll = np.where(over, np.arctan2(-R[:, 1, 0], -R[:, 1, 1]), roll)
    return np.unwrap(yaw), pitch, roll


def _held(angle: np.ndarray, flat: np.ndarray) -> Float[np.ndarray, "frames"]:
    """Offset that makes an angle constant in each flat run; between them linear, beyond them as at their end."""
    if not flat.any():
        return np.zeros(len(angle))
    offset = np.zeros(len(angle))
    for start, stop in runs(flat):
        offset[start:stop] = angle[start:stop].mean() - angle[start:stop]
    frames = np.arange(len(angle))
    return np.interp(frames, frames[flat], offset[flat])


def _grounded_pitch(pitch: np.ndarray, contact: np.ndarray) -> Float[np.ndarray, "frames"]:
    """Zero while flat; heel up only while the ball alone is down, toes up only while the heel alone is."""
    heel, ball = contact[:, 0], contact[:, 1]
    flat = heel & ball
    goal = pitch.copy()
    if flat.any():
        frames, flats = np.arange(len(pitch)), np.flatnonzero(flat)
        nearest = flats[np.abs(frames[:, None] - flats).argmin(axis=1)]
        fade = np.clip(1.0 - np.abs(frames - nearest) / _PITCH_FADE_FRAMES, 0.0, 1.0)
        goal -= pitch[nearest] * fade**2 * (3 - 2 * fade)
    goal = np.where(ball & ~heel, np.maximum(goal, 0.0), goal)
    goal = np.where(heel & ~ball, np.minimum(goal, 0.0), goal)
    return np.where(flat, 0.0, goal)


def _lift(clearance_m: np.ndarray, stance: np.ndarray) -> Float[np.ndarray, "frames"]:
    """Upward shift of swing frames that keeps the sole above the floor; it starts softly, away from stance."""
    least = np.where(stance, 0.0, np.maximum(0.0, -clearance_m))
    if not least.any() or not stance.any():
        return envelope(least, _LIFT_FRAMES)
    ramp = np.clip(np.asarray(distance_transform_edt(~stance)) / (_LIFT_FRAMES + 1), 0.0, 1.0)
    return np.maximum(least, ramp * envelope(least, _LIFT_FRAMES))
