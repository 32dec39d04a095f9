"""Footsteps: along a curved path, turning on the spot, onto steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.acting.script import Script


@dataclass(frozen=True, slots=True)
class Pace:
    """Length and duration of a walker's steps."""

    step_m: float
    step_s: float

    @property
    def swing_s(self) -> float:
        return 0.74 * self.step_s

    @property
    def double_s(self) -> float:
        return 0.26 * self.step_s


def random_pace(script: Script, hurry: float = 1.0) -> Pace:
    """Indoor walking: 0.75 to 1.25 m/s for an average adult, slower cadence for longer legs."""
    step = script.rng.uniform(0.46, 0.62) * hurry
    seconds = (0.30 + 0.46 * step) * script.rng.uniform(0.96, 1.08)
    return Pace(step * script.size.scale, seconds * script.size.scale**0.5)


def bezier(
    start_m: np.ndarray, start_yaw: float, goal_m: np.ndarray, goal_yaw: float, bend: float = 0.4
) -> Float[np.ndarray, "points 3"]:
    """Points of a cubic Bezier curve between two positions and headings (world, meters, radians)."""
    reach = bend * np.linalg.norm(goal_m - start_m)
    ahead = np.array([0.0, 0.0, reach])
    p = [start_m, start_m + yaw_rotation(start_yaw) @ ahead, goal_m - yaw_rotation(goal_yaw) @ ahead, goal_m]
    u = np.linspace(0.0, 1.0, 200)[:, None]
    return (1 - u) ** 3 * p[0] + 3 * u * (1 - u) ** 2 * p[1] + 3 * u**2 * (1 - u) * p[2] + u**3 * p[3]


def walk(script: Script, path_m: Float[np.ndarray, "points 3"], pace: Pace, *, close: bool = True) -> None:
    """Steps along a path that begins where the body stands; with `close` the feet end side by side."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path_m, axis=0), axis=1))])
    tangent = np.gradient(path_m, axis=0)
    yaws = np.unwrap(np.arctan2(tangent[:, 0], tangent[:, 2]))
    count = max(1, round(lengths[-1] / pace.step_m))
    steps = [lengths[-1] * (k + 1) / count for k in range(count)] + ([lengths[-1]] if close else [])
    first = min(len(path_m) - 1, int(np.searchsorted(lengths, steps[0])))
    side = script.lift_side(path_m[first], float(yaws[first]))
    still = script.now_s - max(p[-1].start_s for p in script.plants) > 0.3
    for k, s in enumerate(steps):
        center = np.array([np.interp(s, lengths, path_m[:, i]) for i in range(3)])
        yaw = float(np.interp(s, lengths, yaws))
        jitter = script.rng.normal(0.0, 0.006, 2) * script.size.scale * (k < len(steps) - 2 or not close)
        center = center + np.array([jitter[0], 0.0, jitter[1]])
        place, heading = script.spot(center, yaw, side, 1.0 if close and k >= len(steps) - 2 else 0.7)
        travel = np.linalg.norm(place - script.plants[side][-1].position_m)
        vigor = float(np.clip(travel / (2 * pace.step_m), 0.15, 1.0))
        last = close and k == len(steps) - 1
        begin = 0.3 if k == 0 and still else 0.0
        script.step(
            side,
            place,
            heading,
            swing_s=pace.swing_s * (1.05 if last or begin else 1.0),
            double_s=pace.double_s + begin + (0.04 if last else 0.0),
            vigor=0.45 * vigor if last else vigor,
        )
        side = 1 - side


def turn(script: Script, yaw_rad: float, center_m: np.ndarray | None = None, max_rad: float = 0.9) -> None:
    """Turns on the spot by small steps until both feet stand at `center_m` (default: here) with heading `yaw_rad`."""
    goal = script.center_m if center_m is None else np.asarray(center_m, float)
    begin_yaw, begin = script.yaw_rad, script.center_m
    change = (yaw_rad - begin_yaw + np.pi) % (2 * np.pi) - np.pi
    count = max(1, int(np.ceil(abs(change) / max_rad)))
    side = script.lift_side(goal, yaw_rad)
    seconds = script.size.scale**0.5
    for k in range(1, count + 1):
        share = k / count
        yaw = begin_yaw + change * share
        center = begin + (goal - begin) * share
        for index in (side, 1 - side):
            place, heading = script.spot(center, yaw, index)
            script.step(
                index,
                place,
                heading,
                swing_s=script.rng.uniform(0.36, 0.42) * seconds,
                double_s=script.rng.uniform(0.12, 0.17) * seconds,
                vigor=0.12,
            )


def step_to(script: Script, side: int, center_m: np.ndarray, yaw_rad: float, *, vigor: float = 0.3) -> None:
    """One step of foot `side` to where it belongs if the body stands over `center_m`."""
    place, heading = script.spot(center_m, yaw_rad, side)
    seconds = script.size.scale**0.5
    script.step(side, place, heading, swing_s=0.45 * seconds, double_s=0.2 * seconds, vigor=vigor)
