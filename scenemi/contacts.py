"""When the feet of a source clip stand on something: slow and low, with hysteresis, in measures of the clip itself.

Sources differ: Bandai's feet are locked to 1 mm, retargeted humanoids slide at 0.3 m/s in stance and float by
centimeters. So the speed that counts as slow, and the floor, are read from each clip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from scenemi.metrics import GMD_SPEED_M_S, KIMODO_SPEED_M_S
from video2anim.geometry.runs import runs, without_short_runs


@dataclass(frozen=True, slots=True)
class ContactConfig:
    """What counts as standing still on the ground."""

    speed_m_s: tuple[float, float] = (KIMODO_SPEED_M_S, GMD_SPEED_M_S)
    """Least and largest speed below which a contact begins, the two above which a foot is said to skate; between them
    it is `speed_factor` times the clip's own stance speed."""
    speed_factor: float = 2.5
    """A foot in stance is slower than so many times its usual (30th percentile) speed (not measured)."""
    release: float = 1.4
    """A contact ends where speed or height exceeds its limit this many times."""
    toe_height_m: float = 0.035
    """Height of the ball of the foot above the local floor at which a contact begins."""
    ankle_height_m: float = 0.025
    """The same for the ankle, above where it is when the sole lies flat."""
    floor_band_m: tuple[float, float] = (-0.04, 0.15)
    """How far the local floor may wander from the clip's (sources float and sink)."""
    floor_window_s: float = 1.5
    """Seconds in which the floor's height is sought: a foot stands at least once (not measured)."""
    shortest_s: float = 0.08
    """Shorter contacts are dropped, shorter gaps closed."""
    drift_m: float = 0.08
    """A contact in which the joint strays farther than this is cut where it moves fastest."""


def foot_contacts(
    ankle_m: Float[np.ndarray, "frames 3"],
    toe_m: Float[np.ndarray, "frames 3"],
    ankle_rise_m: float,
    fps: float,
    *,
    has_floor: bool,
    config: ContactConfig | None = None,
) -> Bool[np.ndarray, "frames 2"]:
    """Whether heel and ball of one foot stand still on the ground.

    Args:
        ankle_m: ankle joint in the world, +Y up, floor near y = 0.
        toe_m: ball of the foot (or tip of the toes).
        ankle_rise_m: how much higher than the toe joint the ankle lies when the sole is flat.
        fps: frames per second.
        has_floor: false for clips on ground that was not captured; then slow feet count as standing anywhere.
        config: limits.
    """
    config = config or ContactConfig()
    speeds = [_speed(joint_m, fps) for joint_m in (ankle_m, toe_m)]
    floor_m = _floor(toe_m[:, 1], speeds[1], fps, config)
    flags = []
    for joint_m, speed, rise_m, height_m in (
        (ankle_m, speeds[0], ankle_rise_m, config.ankle_height_m),
        (toe_m, speeds[1], 0.0, config.toe_height_m),
    ):
        above_m = joint_m[:, 1] - floor_m - rise_m if has_floor else np.zeros(len(joint_m))
        slow = _stance_speed(speed, above_m, config)
        flag = _hysteresis(
            (speed < slow) & (above_m < height_m),
            (speed < config.release * slow) & (above_m < config.release * height_m),
        )
        shortest = max(2, round(config.shortest_s * fps))
        flag = without_short_runs(flag, shortest)
        cut = _cut_where_it_strays(flag, joint_m, speed, config.drift_m)
        flags.append(without_short_runs(cut, shortest, close_gaps=False))
    return np.stack(flags, -1)


def _speed(joint_m: np.ndarray, fps: float) -> Float[np.ndarray, "frames"]:
    if len(joint_m) < 2:
        return np.zeros(len(joint_m))
    return np.linalg.norm(np.gradient(joint_m, axis=0), axis=-1) * fps


def _floor(height_m: np.ndarray, speed: np.ndarray, fps: float, config: ContactConfig) -> Float[np.ndarray, "frames"]:
    """Height of the toe joint on the ground around each frame."""
    slow = speed < config.speed_m_s[0]
    level_m = float(np.percentile(height_m[slow], 30) if slow.any() else np.percentile(height_m, 5))
    window = max(3, round(config.floor_window_s * fps))
    local_m = uniform_filter1d(minimum_filter1d(height_m, window), window // 2, mode="nearest")
    return np.clip(local_m, level_m + config.floor_band_m[0], level_m + config.floor_band_m[1])


def _stance_speed(speed: np.ndarray, above_m: np.ndarray, config: ContactConfig) -> float:
    low = above_m < config.toe_height_m
    usual = float(np.percentile(speed[low], 30)) if low.any() else 0.0
    return float(np.clip(config.speed_factor * usual, *config.speed_m_s))


def _hysteresis(enter: np.ndarray, stay: np.ndarray) -> Bool[np.ndarray, "frames"]:
    """Runs of `stay` that hold at least one frame of `enter`."""
    flag = np.zeros(len(enter), bool)
    for start, stop in runs(stay):
        flag[start:stop] = enter[start:stop].any()
    return flag


def _cut_where_it_strays(
    flag: np.ndarray, joint_m: np.ndarray, speed: np.ndarray, drift_m: float
) -> Bool[np.ndarray, "frames"]:
    """Contacts cut at their fastest inner frame until each piece stays within `drift_m`."""
    kept = flag.copy()
    waiting = runs(flag)
    while waiting:
        start, stop = waiting.pop()
        piece_m = joint_m[start:stop, ::2]
        if stop - start < 3 or np.linalg.norm(np.ptp(piece_m, axis=0)) <= drift_m:
            continue
        center = start + 1 + int(speed[start + 1 : stop - 1].argmax())
        first, last = max(start, center - 1), min(stop, center + 2)
        kept[first:last] = False
        waiting += [(start, first), (last, stop)]
    return kept
