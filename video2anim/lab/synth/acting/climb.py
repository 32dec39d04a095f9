"""Stepping up onto a high step or a small flight of stairs, turning on top, stepping down."""

from __future__ import annotations

import numpy as np

from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.acting.finish import motion_of
from video2anim.lab.synth.acting.perform import perform
from video2anim.lab.synth.acting.script import Script
from video2anim.lab.synth.acting.sit import approach, leave
from video2anim.lab.synth.acting.walking import turn
from video2anim.lab.synth.world import ProceduralMotion, Prop

_MIN_STAIR_SCALE = 0.8
"""Bodies with a smaller leg length relative to an average adult get a single step instead of stairs."""


def act_step_up(script: Script) -> ProceduralMotion:
    """Walk up to a step or a small flight of stairs, climb it, turn on top and come down."""
    size, rng = script.size, script.rng
    approach(script, rng.uniform(0.5, 0.8))
    count = int(rng.choice([1, 1, 2, 3])) if size.scale > _MIN_STAIR_SCALE else 1
    tread = 0.31 * size.scale if count > 1 else 0.0
    rise = rng.uniform(0.15, 0.19) if count > 1 else rng.uniform(0.15, min(0.45, 0.46 * size.leg_m))
    top = 0.62 * size.scale
    yaw, begin = script.yaw_rad, script.center_m
    forward = yaw_rotation(yaw) @ np.array([0.0, 0.0, 1.0])
    edge = 0.32 * size.scale
    frames_from = script.now_s
    side = int(rng.integers(2))
    landings = []
    for k in range(count):
        inner = 0.08 * size.scale if k < count - 1 else 0.3 * size.scale
        center = begin + forward * (edge + k * tread + inner) + np.array([0.0, (k + 1) * rise, 0.0])
        landings.append(center)
        _climb(script, side, center, yaw, rise, first=k == 0)
        side = 1 - side
    _climb(script, side, landings[-1], yaw, rise, first=False)
    script.wait(rng.uniform(0.6, 0.8))
    down_yaw = yaw + (rng.choice([-1.0, 1.0]) * np.pi)
    near_edge = begin + forward * (edge + (count - 1) * tread + 0.21 * size.scale) + np.array([0.0, count * rise, 0.0])
    turn(script, down_yaw, near_edge, max_rad=1.6)
    side = int(rng.integers(2))
    for k in range(count - 2, -1, -1):
        center = begin + forward * (edge + (k + 0.62) * tread) + np.array([0.0, (k + 1) * rise, 0.0])
        _descend(script, side, center, down_yaw, rise)
        side = 1 - side
    floor = begin + forward * (edge - 0.15 * size.scale)
    _descend(script, side, floor, down_yaw, rise)
    _descend(script, 1 - side, floor, down_yaw, 0.5 * rise)
    leave(script, 0.4)
    done = perform(script)
    props = []
    frames = (int(frames_from * 30), min(len(done.t) - 1, int(script.strides[-3].land_s * 30)))
    for k in range(count):
        depth = tread if k < count - 1 else top
        middle = begin + forward * (edge + k * tread + 0.5 * depth)
        place = (float(middle[0]), (k + 1) * float(rise), float(middle[2]))
        props.append(Prop("step", place, float(yaw + np.pi), (float(0.7 * size.scale), float(depth)), frames))
    return motion_of("step_up", done, tuple(props))


def _climb(script: Script, side: int, center: np.ndarray, yaw: float, rise: float, *, first: bool) -> None:
    lean = 0.12 + 0.45 * rise
    script.keyed.key(script.now_s - 0.1, 0.6, pelvis_pitch=0.5 * lean, spine_flex=0.5 * lean, neck_flex=0.25)
    slow = 1.0 + 1.6 * rise
    seconds = script.size.scale**0.5 * slow
    place, heading = script.spot(center, yaw, side)
    script.step(side, place, heading, swing_s=0.45 * seconds, double_s=(0.28 if first else 0.16) * seconds, vigor=0.3)
    script.plants[side][-1].strike_rad = 0.03
    script.keyed.rest(script.now_s + 0.2, 0.9, "pelvis_pitch", "spine_flex", "neck_flex")


def _descend(script: Script, side: int, center: np.ndarray, yaw: float, rise: float) -> None:
    script.keyed.key(script.now_s - 0.1, 0.5, spine_flex=0.14, neck_flex=0.3)
    seconds = script.size.scale**0.5 * (1.0 + 1.7 * rise)
    place, heading = script.spot(center, yaw, side)
    script.step(side, place, heading, swing_s=0.45 * seconds, double_s=0.18 * seconds, vigor=0.3)
    script.plants[side][-1].strike_rad = 0.03
    script.keyed.rest(script.now_s + 0.2, 0.8, "spine_flex", "neck_flex")
