"""Motion of kind `sit`: walking up to a seat, turning, sitting down, staying, rising, walking off."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.acting.finish import GAP_M, at_height, motion_of, over, probes
from video2anim.lab.synth.acting.perform import SolvedMotion, perform
from video2anim.lab.synth.acting.script import HandGoal, PelvisHold, Script
from video2anim.lab.synth.acting.walking import bezier, random_pace, turn, walk
from video2anim.lab.synth.world import ProceduralMotion, Prop
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_INDEX

_ON_SEAT = [JOINT_INDEX[name] for name in ("pelvis", "left_hip", "right_hip", "spine1")]
"""Body parts that may rest on a seat: pelvis, thighs, lower back."""


def approach(script: Script, distance_m: float) -> None:
    """Walks along a gentle curve to a point about `distance_m` ahead and stops."""
    rng = script.rng
    goal = script.center_m + yaw_rotation(script.yaw_rad + rng.uniform(-0.4, 0.4)) @ np.array([0.0, 0.0, distance_m])
    yaw = script.yaw_rad + rng.uniform(-0.5, 0.5)
    walk(script, bezier(script.center_m, script.yaw_rad, goal, yaw), random_pace(script))


def leave(script: Script, spread_rad: float = 0.7) -> None:
    """Walks off, and is still walking at the end."""
    rng = script.rng
    yaw = script.yaw_rad + rng.uniform(-spread_rad, spread_rad)
    goal = script.center_m + yaw_rotation(yaw) @ np.array([0.0, 0.0, 1.7 * script.size.scale])
    walk(script, bezier(script.center_m, script.yaw_rad, goal, yaw), random_pace(script), close=False)


def take_seat(script: Script, height_m: float, reach_m: float, *, deep_m: float = 0.0) -> PelvisHold:
    """Sits down behind the standing feet: `reach_m` from the ankles back to the pelvis. The hold has no end yet."""
    size, rng = script.size, script.rng
    forward = yaw_rotation(script.yaw_rad) @ np.array([0.0, 0.0, 1.0])
    begin = script.now_s + rng.uniform(0.05, 0.25)
    span = rng.uniform(1.3, 1.65) * size.scale**0.5
    seat = script.center_m - forward * (reach_m + deep_m)
    seat[1] = height_m + 0.115 * size.scale
    hold = PelvisHold(begin, begin + span, 1e9, 1e9, seat)
    script.holds.append(hold)
    key = script.keyed.key
    key(begin - 0.1, 0.62 * span, pelvis_pitch=rng.uniform(0.42, 0.6), spine_flex=rng.uniform(0.28, 0.42))
    key(begin + 0.5 * span, 0.62 * span, pelvis_pitch=rng.uniform(-0.2, -0.02), spine_flex=rng.uniform(0.02, 0.2))
    script.now_s = begin + span + 0.3
    return hold


def palm_down(side: int, inward: float, droop: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """Rotation of a hand in the heading frame, palm down: fingers ahead, turned by `inward`, tips down by `droop`
    (rad)."""
    out = 1.0 if side == 0 else -1.0
    fingers = np.array([-out * np.sin(inward), -np.sin(droop), np.cos(inward) * np.cos(droop)])
    fingers /= np.linalg.norm(fingers)
    x = out * fingers
    z = np.cross(x, [0.0, 1.0, 0.0])
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], -1)


def hands_on_thighs(script: Script, hold: PelvisHold, until_s: float, start_s: float | None = None) -> None:
    """The hands go to the thighs while the body sits down (or from `start_s` on) and leave them after `until_s`."""
    start = hold.start_s - 0.25 if start_s is None else start_s
    size, rng = script.size, script.rng
    along = rng.uniform(0.52, 0.7)
    for side in (0, 1):
        lag = rng.uniform(0.0, 0.15)
        offset = np.array([(along + rng.uniform(-0.05, 0.05)) * size.thigh_m, 0.12 * size.scale, -0.01])
        script.hands.append(
            HandGoal(side, start + lag, start + 0.8 + lag, until_s + 0.35 - lag, until_s + 1.1,
                     offset, "thigh", palm_down(side, rng.uniform(0.1, 0.5)), (0.55, -0.6, -0.6), contact=True,
                     still_s=(max(hold.settle_s, start + 0.8 + lag), until_s))
        )  # fmt: skip


def fidget(script: Script, start_s: float, stop_s: float) -> None:
    """Small movements between two times: turns the head and shifts the trunk."""
    rng, t = script.rng, start_s
    while t < stop_s - 0.9:
        script.keyed.key(t, rng.uniform(0.5, 0.9), neck_twist=rng.uniform(-0.6, 0.6), neck_flex=rng.uniform(-0.1, 0.25))
        script.keyed.key(t + 0.1, rng.uniform(0.7, 1.1), spine_twist=rng.uniform(-0.12, 0.12),
                         spine_side=rng.uniform(-0.05, 0.05))  # fmt: skip
        t += rng.uniform(0.9, 1.6)
    script.keyed.rest(stop_s - 0.4, 0.7, "neck_twist", "neck_flex", "spine_twist", "spine_side")


def rise(script: Script, hold: PelvisHold) -> None:
    """Leans forward and stands up from a hold."""
    rng, key = script.rng, script.keyed.key
    span = rng.uniform(1.15, 1.4) * script.size.scale**0.5
    hold.leave_s = script.now_s
    hold.end_s = hold.leave_s + span
    key(hold.leave_s - 0.4, 0.85, pelvis_pitch=rng.uniform(0.5, 0.65), spine_flex=rng.uniform(0.3, 0.42))
    script.keyed.rest(hold.leave_s + 0.35, 1.05, "pelvis_pitch", "spine_flex")
    script.now_s = hold.end_s + 0.05


def act_sit(script: Script) -> ProceduralMotion:
    """Walk up to a seat, turn, sit down, stay with small movements, rise and walk off."""
    size, rng = script.size, script.rng
    height = float(np.clip(rng.uniform(0.84, 0.96) * size.knee_height_m, 0.33, 0.55))
    approach(script, rng.uniform(1.2, 1.9))
    angle = rng.choice([-1.0, 1.0]) * rng.uniform(0.58 * np.pi, 0.95 * np.pi)
    yaw = script.yaw_rad + angle
    forward = yaw_rotation(yaw) @ np.array([0.0, 0.0, 1.0])
    turn(script, yaw, script.center_m - 0.24 * size.scale * forward)
    hold = take_seat(script, height, rng.uniform(0.86, 1.02) * size.thigh_m)
    stay = rng.uniform(1.6, 2.6)
    hands_on_thighs(script, hold, script.now_s + stay)
    fidget(script, script.now_s, script.now_s + stay - 0.4)
    script.now_s += stay
    rise(script, hold)
    leave(script)
    done = perform(script)
    return motion_of("sit", done, (seat_prop(script, done, hold),))


def seat_prop(script: Script, done: SolvedMotion, hold: PelvisHold, width_m: float = 0.44) -> Prop:
    """The seat under a hold: its top below the lowest skin above it at any time, its front edge behind the calves."""
    size = script.size
    frames = (int(np.ceil(hold.settle_s * FPS)), int(hold.leave_s * FPS))
    yaw = float(done.heading_rad[frames[0] : frames[1]].mean())
    forward = yaw_rotation(yaw) @ np.array([0.0, 0.0, 1.0])
    near = slice(max(0, int(hold.start_s * FPS) - 10), int(hold.end_s * FPS) + 5)
    skin = np.flatnonzero(np.isin(size.body.vertex_part, _ON_SEAT))
    resting = size.body.vertices(done.R_world_joint[near], done.joints_m[near], skin).astype(float)
    points, legs = probes(done, size), ~np.isin(size.probe_part, _ON_SEAT)
    half_back, front = 0.17 * size.scale, 0.26 * size.scale
    while True:
        center = hold.position_m + forward * 0.5 * (front - half_back)
        prop = Prop("seat", (float(center[0]), 0.0, float(center[2])), yaw, (width_m, half_back + front), frames)
        height = np.where(over(resting, prop), resting[..., 1], np.inf).min() - GAP_M
        prop = at_height(prop, height)
        below = over(points, prop, 0.01) & (points[..., 1] < height) & legs
        if not below.any() or front < 0.1 * size.scale:
            return prop
        front -= 0.01
