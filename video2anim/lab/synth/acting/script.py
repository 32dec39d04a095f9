"""The plan of a procedural motion: foot plants, keyed posture, pelvis holds and hand goals on one time line."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.acting.curves import ease, window, yaw_rotation
from video2anim.lab.synth.acting.feet import FOREVER, Plant
from video2anim.lab.synth.acting.measure import BodyMeasure

CHANNELS: tuple[str, ...] = (
    "pelvis_pitch", "pelvis_roll", "pelvis_yaw", "spine_flex", "spine_side", "spine_twist",
    "neck_flex", "neck_side", "neck_twist",
    "l_flex", "l_abd", "l_twist", "l_elbow", "r_flex", "r_abd", "r_twist", "r_elbow", "l_lift", "r_lift", "crouch",
)  # fmt: skip
"""Angles in radians, positive: pitch and flex forward; roll and side to the right (right side down); yaw and twist to
the left; arms: flex forward, abd (abduction) outward, twist inward, elbow bent, lift raises the shoulder girdle.
`crouch` lowers the pelvis, as a share of the leg's length."""
NEUTRAL = {"l_abd": 0.14, "r_abd": 0.14, "l_elbow": 0.28, "r_elbow": 0.28, "l_flex": 0.02, "r_flex": 0.02}


@dataclass(slots=True)
class PelvisHold:
    """The pelvis leaves balance at `start_s`, rests from `settle_s` to `leave_s`, and balances again at `end_s`.
    World."""

    start_s: float
    settle_s: float
    leave_s: float
    end_s: float
    position_m: Float[np.ndarray, "3"]
    R_world: Float[np.ndarray, "3 3"] | None = None
    """Orientation while held; None = upright with the keyed posture."""
    contact: bool = True
    back_after_s: float = math.inf
    """The back rests from this long after `settle_s` until half a second before `leave_s`."""


@dataclass(slots=True)
class HandGoal:
    """A hand moves to a target from `start_s` to `touch_s`, stays until `leave_s`, and is free at `end_s`."""

    side: int
    start_s: float
    touch_s: float
    leave_s: float
    end_s: float
    offset_m: Float[np.ndarray, "3"]
    """Wrist: world position, or offset in the frame (thigh: along the thigh, up, outwards; body: heading at pelvis)."""
    frame: Literal["world", "thigh", "body"] = "world"
    R_hand: Float[np.ndarray, "3 3"] | None = None
    """Orientation of the wrist in the world, or in the heading frame for `thigh` and `body`; None = along the
    forearm."""
    elbow: tuple[float, float, float] = (0.5, -0.7, -0.5)
    """Direction of the elbow in the frame of the pelvis: outwards, up, ahead."""
    contact: bool = False
    still_s: tuple[float, float] | None = None
    """When the hand stands still (contact), if not all the time from touch to leave."""
    slide: tuple[float, float, Float[np.ndarray, "3"]] | None = None
    """For a world target that moves: start and end of the move (seconds) and the displacement (meters)."""


@dataclass(slots=True)
class FootHold:
    """A foot leaves its plant at `start_s`, rests elsewhere from `settle_s` to `leave_s`, is back at `end_s`. World."""

    side: int
    start_s: float
    settle_s: float
    leave_s: float
    end_s: float
    ankle_m: Float[np.ndarray, "3"]
    R_world: Float[np.ndarray, "3 3"]


@dataclass(slots=True)
class Keyed:
    """Channel values that change by eased steps. Steps that overlap add up."""

    value: dict[str, float]
    moves: list[tuple[float, float, str, float]] = field(default_factory=list)
    """Start (seconds), duration (seconds), channel, change (radians)."""

    def key(self, start_s: float, duration_s: float, **goal: float) -> None:
        """The named channels move to new values from `start_s` on. Calls must be in order of time per channel."""
        for name, value in goal.items():
            change = value - self.value.get(name, 0.0)
            if change:
                self.moves.append((start_s, max(duration_s, 0.1), name, change))
                self.value[name] = value

    def rest(self, start_s: float, duration_s: float, *names: str) -> None:
        """The named channels return to their `NEUTRAL` values."""
        self.key(start_s, duration_s, **{name: NEUTRAL.get(name, 0.0) for name in names})

    def tracks(self, t: Float[np.ndarray, "frames"]) -> dict[str, Float[np.ndarray, "frames"]]:
        out = {name: np.full(len(t), NEUTRAL.get(name, 0.0)) for name in CHANNELS}
        for start, duration, name, change in self.moves:
            out[name] += change * ease((t - start) / duration)
        return out


@dataclass(slots=True)
class Stride:
    """One step, from which the phase of the gait is computed."""

    side: int
    lift_s: float
    land_s: float
    length_m: float


@dataclass(slots=True)
class Script:
    """Everything planned so far; `now_s` is the time of the last touch-down or of the end of the last wait."""

    size: BodyMeasure
    rng: np.random.Generator
    plants: tuple[list[Plant], list[Plant]]
    half_width_m: float
    toe_out_rad: float
    now_s: float = 0.6
    keyed: Keyed = field(default_factory=lambda: Keyed(dict(NEUTRAL)))
    holds: list[PelvisHold] = field(default_factory=list)
    hands: list[HandGoal] = field(default_factory=list)
    feet: list[FootHold] = field(default_factory=list)
    strides: list[Stride] = field(default_factory=list)
    hand_lift_m: dict[int, Float[np.ndarray, "frames"]] = field(default_factory=dict)
    """How much a wrist is raised so that the hand stays out of furniture, by side."""
    noise_seed: int = 0

    def noise(self) -> np.random.Generator:
        """The same generator at every call, so that a script can be solved again after a change."""
        return np.random.default_rng(self.noise_seed)

    @classmethod
    def standing(cls, size: BodyMeasure, rng: np.random.Generator) -> Script:
        """Both feet on the floor at the origin, facing +Z."""
        half = float(abs(size.rest_m[1, 0]) * rng.uniform(0.75, 1.0))
        script = cls(size, rng, ([], []), half, float(rng.uniform(0.05, 0.16)))
        script.noise_seed = int(rng.integers(2**31))
        for side in (0, 1):
            position, yaw = script.spot(np.zeros(3), 0.0, side)
            script.plants[side].append(Plant(side, -1.0, FOREVER, position, yaw))
        return script

    def spot(self, center_m: np.ndarray, yaw_rad: float, side: int, wider: float = 1.0) -> tuple[np.ndarray, float]:
        """World position and heading of one foot of a body that stands over `center_m`; `wider` scales the stance."""
        out = 1.0 if side == 0 else -1.0
        across = yaw_rotation(yaw_rad) @ np.array([out * self.half_width_m * wider, 0.0, 0.0])
        return np.asarray(center_m, float) + across, yaw_rad + out * self.toe_out_rad

    @property
    def center_m(self) -> Float[np.ndarray, "3"]:
        """World point between the feet after the last step."""
        return 0.5 * (self.plants[0][-1].position_m + self.plants[1][-1].position_m)

    @property
    def yaw_rad(self) -> float:
        """Mean heading of the feet after the last step."""
        left, right = self.plants[0][-1].yaw_rad, self.plants[1][-1].yaw_rad
        return left + 0.5 * ((right - left + np.pi) % (2 * np.pi) - np.pi)

    def step(
        self, side: int, position_m: np.ndarray, yaw_rad: float, *, swing_s: float, double_s: float, vigor: float
    ) -> None:
        """The foot leaves the ground `double_s` after the last event and lands `swing_s` later.

        `vigor` 1 = heel strike and push-off of a full walking step, 0 = a flat shuffle.
        """
        last = self.plants[side][-1]
        lift = max(self.now_s + double_s, last.start_s + last.strike_s + 0.15)
        land = lift + swing_s
        last.stop_s = lift
        stood = lift - max(last.start_s + last.strike_s, 0.0)
        last.push_rad = (0.18 + 0.5 * vigor) * min(1.0, stood / 0.35)
        last.push_s = min(0.2 + 0.12 * vigor, 0.7 * stood)
        self.plants[side].append(
            Plant(side, land, FOREVER, np.asarray(position_m, float).copy(), yaw_rad, 0.04 + 0.26 * vigor)
        )
        self.strides.append(Stride(side, lift, land, float(np.linalg.norm((position_m - last.position_m)[[0, 2]]))))
        self.now_s = land

    def loose(self, t: Float[np.ndarray, "frames"], channel: str) -> Float[np.ndarray, "frames"]:
        """Share of the free arm swing at times `t`: 0 while the hand has a goal, else 1."""
        out = np.ones(len(t))
        for goal in self.hands:
            if channel[:2] == ("l_", "r_")[goal.side]:
                out *= 1.0 - window(t, goal.start_s, goal.touch_s, goal.leave_s, goal.end_s)
        return out

    def wait(self, seconds: float) -> None:
        """Both feet stay where they are."""
        self.now_s += seconds

    def lift_side(self, goal_m: np.ndarray, yaw_rad: float) -> int:
        """The foot to step with first (0 left, 1 right): the one that did not just land; else, in a turn, the one on
        its side; else the one farther from the goal."""
        if self.strides and self.now_s - self.strides[-1].land_s < 0.3:
            return 1 - self.strides[-1].side
        turn = (yaw_rad - self.yaw_rad + np.pi) % (2 * np.pi) - np.pi
        if abs(turn) > 0.25:
            return 0 if turn > 0 else 1
        gaps = [np.linalg.norm(self.plants[side][-1].position_m - goal_m) for side in (0, 1)]
        if abs(gaps[0] - gaps[1]) < 0.03:
            return int(self.rng.integers(2))
        return int(gaps[1] > gaps[0])
