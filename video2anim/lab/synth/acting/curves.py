"""Timing and smoothing: eased moves, least-squares tracks, pendulum balance, slow noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import spsolve

from video2anim.types.clip import FPS

GRAVITY_M_S2 = 9.81
_HOLD = 1e5
"""Weight of a least-squares row that acts as an equality constraint."""


def ease(u: np.ndarray | float) -> np.ndarray:
    """Minimum-jerk progress: 0 at u <= 0, 1 at u >= 1, no speed or acceleration at the ends (Flash and Hogan 1985)."""
    x = np.clip(u, 0.0, 1.0)
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))


def steady(u: np.ndarray, ramp: float = 0.2) -> np.ndarray:
    """Progress from 0 to 1 at constant speed, but for a share `ramp` of speeding up and of slowing down."""
    x = np.clip(u, 0.0, 1.0)
    y = np.minimum(x, 1.0 - x)
    half = np.where(y < ramp, 0.5 * y * y / ramp, y - 0.5 * ramp) / (1.0 - ramp)
    return np.where(x < 0.5, half, 1.0 - half)


def window(t: np.ndarray, rise: float, full: float, leave: float, end: float) -> Float[np.ndarray, "frames"]:
    """0 before `rise`, 1 from `full` to `leave`, 0 after `end`, with minimum-jerk ramps; all in the unit of `t`."""
    up = ease((t - rise) / max(full - rise, 1e-6))
    return up * (1.0 - ease((t - leave) / max(end - leave, 1e-6)))


def hermite(u: np.ndarray, start: tuple, stop: tuple, span_s: float) -> np.ndarray:
    """Quintic polynomial between two pairs (value, rate per second) without acceleration at the ends.

    `u` (frames,) runs from 0 to 1 in `span_s`; values may be vectors (then the result is (frames, n)).
    """
    (a, va), (b, vb) = start, stop
    scalar = np.ndim(a) == 0
    u = np.asarray(u, float) if scalar else np.asarray(u, float)[:, None]
    s = ease(u)
    first = u - 6 * u**3 + 8 * u**4 - 3 * u**5
    last = -4 * u**3 + 7 * u**4 - 3 * u**5
    return np.asarray(a) * (1 - s) + np.asarray(b) * s + span_s * (np.asarray(va) * first + np.asarray(vb) * last)


def _third_difference(count: int) -> sparse.dia_array:
    offsets: Any = range(4)  # the stubs know one diagonal only
    return sparse.diags_array([-1.0, 3.0, -3.0, 1.0], offsets=offsets, shape=(count - 3, count))


def smooth_track(
    target: Float[np.ndarray, "frames *axes"], weight: Float[np.ndarray, "frames"] | float, width_s: float
) -> Float[np.ndarray, "frames *axes"]:
    """Weighted least-squares fit to `target` with a penalty on the third difference; removes details under
    `width_s`."""
    count = len(target)
    weights = sparse.diags_array(np.broadcast_to(np.asarray(weight, float), (count,)).copy())
    jerk = _third_difference(count)
    stiffness = (width_s * FPS / np.pi) ** 6
    system = (weights + stiffness * (jerk.T @ jerk) + 1e-9 * sparse.eye_array(count)).tocsc()
    flat = weights @ target.reshape(count, -1)
    return np.asarray(spsolve(system, flat)).reshape(target.shape)


def smooth_lift(deficit_m: Float[np.ndarray, "frames"], width_s: float = 0.4) -> Float[np.ndarray, "frames"]:
    """A smooth track that is nowhere below the positive part of `deficit_m`."""
    need = np.maximum(deficit_m, 0.0)
    if need.max() <= 0:
        return need
    half = round(0.5 * width_s * FPS)
    padded = np.pad(need, half, mode="edge")
    grown = np.array([padded[k : k + 2 * half + 1].max() for k in range(len(need))])
    return np.maximum(smooth_track(grown, 1.0, 0.7 * width_s), need)


def smooth_track_below(
    wanted: Float[np.ndarray, "frames"],
    weight: Float[np.ndarray, "frames"],
    ceiling: Float[np.ndarray, "frames"],
    width_s: float,
) -> Float[np.ndarray, "frames"]:
    """Smooth track near `wanted` and below `ceiling`: targets of frames above it are lowered until none is left."""
    target, pull = np.minimum(wanted, ceiling), weight.copy()
    goal, track = target.copy(), target
    for _ in range(12):
        track = smooth_track(goal, pull, width_s)
        over = track - ceiling
        if over.max() < 5e-4:
            break
        goal = goal - np.maximum(over, 0.0) * 1.3
        pull = np.where(over > 0, np.maximum(pull, 1.0) * 1.5, pull)
    return np.minimum(track, ceiling)


def balance(
    pressure_m: Float[np.ndarray, "frames 2"],
    pressure_weight: Float[np.ndarray, "frames"],
    hold_m: Float[np.ndarray, "frames 2"],
    hold_weight: Float[np.ndarray, "frames"],
    height_m: float,
) -> Float[np.ndarray, "frames 2"]:
    """Ground-plane path of the center of mass as an inverted pendulum whose center of pressure is in the feet.

    Least squares over the whole clip: center of pressure = x - (height / g) x'' (Kajita et al. 2003), small third
    difference, and held positions. The fit sees the future, so weight shifts before a step.

    Args:
        pressure_m: Wanted center of pressure (world x, z).
        pressure_weight: Weight of each frame.
        hold_m: Positions (world x, z) where the pelvis is held, as on a seat.
        hold_weight: 1 in held frames, 0 in free ones.
        height_m: Height of the center of mass.
    """
    count = len(pressure_m)
    gain = height_m / GRAVITY_M_S2 * FPS**2
    offsets: Any = (-1, 0, 1)
    pendulum = sparse.diags_array([-gain, 1.0 + 2.0 * gain, -gain], offsets=offsets, shape=(count, count)).tolil()
    pendulum[0, :] = pendulum[-1, :] = 0.0
    pendulum = pendulum.tocsr()
    weights = sparse.diags_array(pressure_weight)
    jerk = _third_difference(count)
    system = pendulum.T @ weights @ pendulum + 1.0 * (jerk.T @ jerk) * (FPS / 30.0) ** 6
    system = system + sparse.diags_array(0.02 * pressure_weight + _HOLD * hold_weight + 1e-9)
    right = pendulum.T @ (weights @ pressure_m) + (0.02 * pressure_weight)[:, None] * pressure_m
    return np.asarray(spsolve(system.tocsc(), right + _HOLD * hold_weight[:, None] * hold_m))


def slow_noise(
    rng: np.random.Generator, t: np.ndarray, channels: int, slowest_hz: float = 0.12, fastest_hz: float = 6.0
) -> Float[np.ndarray, "frames channels"]:
    """Sum of sines with amplitudes about 1/f and random phases; standard deviation about 1."""
    frequency = slowest_hz * (fastest_hz / slowest_hz) ** (np.arange(10) / 9.0)
    frequency = frequency[:, None] * rng.uniform(0.9, 1.1, (10, channels))
    phase = rng.uniform(0.0, 2 * np.pi, (10, channels))
    amplitude = frequency**-0.9
    amplitude = amplitude / np.sqrt(0.5 * (amplitude**2).sum(0))
    return (amplitude * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(1)


def yaw_rotation(yaw_rad: np.ndarray | float) -> np.ndarray:
    """Rotations (..., 3, 3) about +Y; they map +Z to (sin yaw, 0, cos yaw)."""
    return axis_rotation(1, yaw_rad)


def axis_rotation(axis: int, angle_rad: np.ndarray | float) -> np.ndarray:
    """Rotations (..., 3, 3) about a coordinate axis (0 = x, 1 = y, 2 = z)."""
    angle = np.asarray(angle_rad, float)
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((*angle.shape, 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[..., axis, axis] = 1.0
    out[..., i, i] = out[..., j, j] = c
    out[..., j, i], out[..., i, j] = s, -s
    return out
