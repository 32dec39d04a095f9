"""Foot plants and the motion of the feet between them: heel strike, flat, heel off, swing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from video2anim.lab.synth.acting.curves import axis_rotation, ease, hermite, yaw_rotation
from video2anim.lab.synth.acting.measure import SINK_ANGLES_RAD, BodyMeasure

FOREVER = math.inf
_EPSILON_S = 1e-3
_MAX_TOE_RAD = 0.85
_SINK_ALLOWED_M = 0.004
SOLE_GAP_M = 0.001
"""Gap between sole and surface, so that rounding puts no vertex below the surface."""


@dataclass(slots=True)
class Plant:
    """A foot on the ground from touch-down to toe-off. World frame; side 0 is left, 1 is right."""

    side: int
    start_s: float
    stop_s: float
    position_m: Float[np.ndarray, "3"]
    """Point of the surface under the ankle while the foot is flat."""
    yaw_rad: float
    strike_rad: float = 0.3
    """Pitch of the foot at touch-down, toes up."""
    push_rad: float = 0.6
    """Pitch of the foot at toe-off, heel up."""
    strike_s: float = 0.12
    push_s: float = 0.28

    @property
    def flat_s(self) -> tuple[float, float]:
        """Start and end of the time, in seconds, in which the whole sole rests."""
        return self.start_s + self.strike_s, self.stop_s - self.push_s


@dataclass(frozen=True, slots=True, eq=False)
class FootTrack:
    """Motion of one foot over the clip, world frame."""

    ankle_m: Float[np.ndarray, "frames 3"]
    R_world_foot: Float[np.ndarray, "frames 3 3"]
    """Orientation of the ankle joint."""
    toe_rad: Float[np.ndarray, "frames"]
    """Bend of the toes, negative = up against the foot."""
    yaw_rad: Float[np.ndarray, "frames"]
    heel_down: Bool[np.ndarray, "frames"]
    ball_down: Bool[np.ndarray, "frames"]
    load: Float[np.ndarray, "frames"]
    """1 on the ground, 0 in the air."""
    pressure_m: Float[np.ndarray, "frames 3"]
    """Center of pressure under the foot: moves from heel to ball during a plant."""


def foot_track(plants: list[Plant], t: Float[np.ndarray, "frames"], size: BodyMeasure) -> FootTrack:
    """The foot's motion through its plants (in order of time; the last one has no end). `t` in seconds."""
    count = len(t)
    ankle, pitch, toe, yaw = np.zeros((count, 3)), np.zeros(count), np.zeros(count), np.zeros(count)
    heel_down, ball_down, load = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count)
    for index, plant in enumerate(plants):
        on = (t >= plant.start_s) & (t <= plant.stop_s)
        ankle[on], pitch[on] = _stance(plant, t[on], size)
        toe[on], yaw[on], load[on] = -np.clip(pitch[on], 0.0, _MAX_TOE_RAD), plant.yaw_rad, 1.0
        first, last = plant.flat_s
        heel_down |= (t >= first) & (t <= last)
        ball_down |= (t >= first) & (t <= plant.stop_s - 0.06)
        if index + 1 < len(plants):
            after = plants[index + 1]
            off = (t > plant.stop_s) & (t < after.start_s)
            if off.any():
                ankle[off], pitch[off], toe[off], yaw[off] = _swing(plant, after, t[off], size)
    R = yaw_rotation(yaw) @ axis_rotation(0, pitch)
    return FootTrack(ankle, R, toe, yaw, heel_down, ball_down, load, _pressure(plants, t, size))


def _stance(plant: Plant, t: np.ndarray, size: BodyMeasure) -> tuple[np.ndarray, np.ndarray]:
    """Ankle (world, meters) and pitch (positive = heel up) during a plant: the foot rolls over the heel, then the
    ball."""
    strike = plant.strike_rad * np.clip(1.0 - (t - plant.start_s) / plant.strike_s, 0.0, None) ** 2
    push = plant.push_rad * np.clip(1.0 - (plant.stop_s - t) / plant.push_s, 0.0, None) ** 2
    flat = plant.position_m + np.array([0.0, size.ankle_height_m + SOLE_GAP_M, 0.0])
    R = yaw_rotation(plant.yaw_rad)
    about_heel = (np.eye(3) - axis_rotation(0, -strike)) @ size.heel_m
    about_ball = (np.eye(3) - axis_rotation(0, push)) @ size.ball_m[plant.side]
    ankle = flat + (about_heel + about_ball) @ R.T
    ankle[:, 1] += np.maximum(np.interp(push, SINK_ANGLES_RAD, size.sink_m[plant.side]) - _SINK_ALLOWED_M, 0.0)
    return ankle, push - strike


def _swing(
    before: Plant, after: Plant, t: np.ndarray, size: BodyMeasure
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ankle, pitch, toe bend and yaw between two plants; the sole stays above both surfaces."""
    span = after.start_s - before.stop_s
    u = (t - before.stop_s) / span
    ends = []
    for plant, when in ((before, before.stop_s), (after, after.start_s)):
        inner = when - _EPSILON_S if plant is before else when + _EPSILON_S
        position, pitch = _stance(plant, np.array([when, inner]), size)
        step = when - inner
        ends.append((position[0], (position[0] - position[1]) / step, pitch[0], (pitch[0] - pitch[1]) / step))
    (p0, v0, a0, w0), (p1, v1, a1, w1) = ends
    ankle = hermite(u, (p0, v0), (p1, v1), span)
    pitch = hermite(u, (a0, 0.6 * w0), (a1, w1), span)
    rise = float(after.position_m[1] - before.position_m[1])
    if abs(rise) > 0.03:
        ankle = ankle + _stair_shift(u, p0, p1, rise)
    toe = -np.clip(a0, 0.0, _MAX_TOE_RAD) * (1.0 - ease(u / 0.45))
    turn = (after.yaw_rad - before.yaw_rad + np.pi) % (2 * np.pi) - np.pi
    yaw = before.yaw_rad + turn * ease(u)
    lowest_ankle = ankle[:, 1].copy()
    lowest = ankle[:, 1] + _lowest_sole(pitch, toe, size)
    ground = np.where(rise > 0, before.position_m[1] + rise * ease((u - 0.0) / 0.45), before.position_m[1])
    if rise < 0:
        ground = before.position_m[1] + rise * ease((u - 0.55) / 0.4)
    clearance = 0.01 + 0.012 * np.sin(np.pi * u)
    bump = np.sin(np.pi * u) ** 2
    inside = (u > 0.25) & (u < 0.75)
    if inside.any():
        need = (ground + clearance - lowest)[inside] / bump[inside]
        ankle[:, 1] += np.clip(need.max(), 0.0, 0.12 if rise > -0.03 else 0.03) * bump
    sunk = np.maximum(ground + 0.002 - (ankle[:, 1] + lowest - lowest_ankle), 0.0)
    ankle[:, 1] += sunk
    return ankle, pitch, toe, before.yaw_rad + (yaw - before.yaw_rad)


def _stair_shift(u: np.ndarray, p0: np.ndarray, p1: np.ndarray, rise: float) -> np.ndarray:
    """Horizontal progress of the swing on stairs: late when it goes up, early when it goes down."""
    begin = 0.42 if rise > 0 else 0.12
    early, late = ease(u / 0.58) - ease(u), ease((u - begin) / (1.0 - begin)) - ease(u)
    shift = np.outer(late if rise > 0 else early, p1 - p0)
    shift[:, 1] = (early if rise > 0 else late) * rise
    return shift


def _lowest_sole(pitch: np.ndarray, toe: np.ndarray, size: BodyMeasure) -> np.ndarray:
    """Lowest of heel, ball and toe tip relative to the ankle, for foot pitch and toe bend."""
    R = axis_rotation(0, pitch)
    ball_sole = np.array([0.0, size.heel_m[1], size.ball_m[0][2]])
    tip = (R @ size.ball_m[0])[:, 1] + (R @ axis_rotation(0, toe) @ size.toe_m)[:, 1]
    return np.minimum.reduce([(R @ size.heel_m)[:, 1], (R @ ball_sole)[:, 1], tip])


def _pressure(plants: list[Plant], t: np.ndarray, size: BodyMeasure) -> Float[np.ndarray, "frames 3"]:
    """Center of pressure of the foot: behind the ankle at touch-down, near the ball at toe-off, mid-foot between."""
    out = np.zeros((len(t), 3))
    center = 0.33 * size.ball_m[0][2]
    for index, plant in enumerate(plants):
        begin = plants[index - 1].stop_s if index else -FOREVER
        chosen = (t > begin) & (t <= plant.stop_s)
        now = t[chosen]
        ahead = center - (center + 0.2 * size.ball_m[0][2]) * np.clip(1 - (now - plant.start_s) / 0.25, 0, 1)
        ahead = ahead + (0.75 * size.ball_m[0][2] - center) * np.clip(1 - (plant.stop_s - now) / 0.3, 0, 1)
        forward = np.array([np.sin(plant.yaw_rad), 0.0, np.cos(plant.yaw_rad)])
        out[chosen] = plant.position_m + ahead[:, None] * forward
    out[t > plants[-1].stop_s] = plants[-1].position_m
    return out
