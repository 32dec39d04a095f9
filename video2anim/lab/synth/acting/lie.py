"""Motion of kind `lie`: sitting on the edge of a bed, lying down, rising again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from video2anim.lab.synth.acting.curves import axis_rotation, smooth_lift, yaw_rotation
from video2anim.lab.synth.acting.finish import GAP_M, at_height, motion_of, over, probes
from video2anim.lab.synth.acting.measure import BodyMeasure
from video2anim.lab.synth.acting.perform import SolvedMotion, perform
from video2anim.lab.synth.acting.script import FootHold, HandGoal, PelvisHold, Script
from video2anim.lab.synth.acting.sit import approach, hands_on_thighs, leave, rise, take_seat
from video2anim.lab.synth.acting.walking import turn
from video2anim.lab.synth.world import ProceduralMotion, Prop
from video2anim.types.clip import FPS

_MAX_DROP_M = 0.01
"""Largest amount by which the bed is lowered where a limb still enters it in motion."""


def act_lie(script: Script) -> ProceduralMotion:
    """Sit down on the edge of a bed, lie down, stay, and rise again."""
    size, rng = script.size, script.rng
    height = float(np.clip(rng.uniform(0.82, 0.95) * size.knee_height_m, 0.33, 0.56))
    approach(script, rng.uniform(0.9, 1.3))
    yaw = script.yaw_rad + rng.choice([-1.0, 1.0]) * rng.uniform(0.5 * np.pi, 0.8 * np.pi)
    frame = yaw_rotation(yaw)
    turn(script, yaw, script.center_m - 0.24 * size.scale * frame[:, 2])
    sit = take_seat(script, height, 0.9 * size.thigh_m, deep_m=0.03)
    head = float(rng.choice([-1.0, 1.0]))
    lie_down = script.now_s - 0.1
    sit.leave_s = lie_down
    span = rng.uniform(1.65, 1.95)
    stay = rng.uniform(1.2, 1.8)
    up = head * frame[:, 0]
    R_lie = np.stack([np.cross(up, [0.0, 1.0, 0.0]), up, np.array([0.0, 1.0, 0.0])], -1)
    place = sit.position_m - frame[:, 2] * 0.2 * size.scale - up * 0.05 * size.scale
    place[1] = height + 0.1 * size.scale
    lie = PelvisHold(lie_down, lie_down + span, lie_down + span + stay, lie_down + 2 * span + stay - 0.2, place, R_lie)
    sit.end_s = lie.settle_s
    again = PelvisHold(lie.leave_s, lie.end_s, 1e9, 1e9, sit.position_m.copy())
    script.holds += [lie, again]
    _legs_up(script, lie, R_lie, height)
    hands_on_thighs(script, sit, lie.start_s - 0.45)
    _arms(script, sit, lie, R_lie, height, head)
    key = script.keyed.key
    key(lie.start_s, span, pelvis_pitch=0.0, spine_flex=0.06, neck_flex=0.12)
    key(lie.start_s + 0.1, 0.5 * span, spine_side=-0.3 * head)
    key(lie.start_s + 0.55 * span, 0.5 * span, spine_side=0.0)
    key(lie.leave_s - 0.2, 0.55 * span, spine_side=-0.25 * head, spine_flex=0.4, neck_flex=0.3)
    key(lie.leave_s + 0.5 * span, 0.6 * span, spine_side=0.0, spine_flex=0.12, neck_flex=0.0, pelvis_pitch=-0.05)
    script.now_s = lie.end_s + rng.uniform(0.3, 0.5)
    hands_on_thighs(script, again, script.now_s, lie.end_s - 0.35)
    rise(script, again)
    leave(script)
    done, prop = _settled(script, (sit, lie, again), yaw, height)
    return motion_of("lie", done, (prop,))


def _legs_up(script: Script, lie: PelvisHold, R_lie: np.ndarray, height: float) -> None:
    size, rng = script.size, script.rng
    span = lie.settle_s - lie.start_s
    for side in (0, 1):
        out = 1.0 if side == 0 else -1.0
        hip = lie.position_m + R_lie @ size.rest_m[1 + side]
        ankle = hip - R_lie[:, 1] * size.leg_m * rng.uniform(0.95, 0.985) + R_lie[:, 0] * out * rng.uniform(0.0, 0.05)
        ankle[1] = height + 0.07 * size.scale
        R_foot = R_lie @ axis_rotation(1, out * rng.uniform(0.15, 0.45)) @ axis_rotation(0, rng.uniform(0.25, 0.5))
        lag = rng.uniform(0.0, 0.15)
        script.feet.append(
            FootHold(side, lie.start_s + 0.15 * span + lag, lie.settle_s, lie.leave_s - 0.05,
                     lie.end_s - 0.1 * span + lag - 0.15, ankle, R_foot)
        )  # fmt: skip


def _arms(script: Script, sit: PelvisHold, lie: PelvisHold, R_lie: np.ndarray, height: float, head: float) -> None:
    """One hand supports the body while it goes down and up; in between both lie beside the body or on the belly."""
    size, rng = script.size, script.rng
    near = 0 if head > 0 else 1
    up, span = R_lie[:, 1], lie.settle_s - lie.start_s
    prop_at = sit.position_m + up * 0.34 * size.scale - yaw_rotation(script.yaw_rad)[:, 2] * 0.08 * size.scale
    prop_at[1] = height + size.hand_below_m + 0.015
    x = up if near == 0 else -up
    flat = np.stack([x, np.array([0.0, 1.0, 0.0]), np.cross(x, [0.0, 1.0, 0.0])], -1)
    low = 0.35 * span
    script.hands.append(
        HandGoal(near, lie.start_s - 0.4, lie.start_s + 0.15, lie.start_s + low, lie.start_s + 0.75 * span, prop_at,
                 R_hand=flat, elbow=(0.2, 0.3, -1.0), contact=True)
    )  # fmt: skip
    belly = bool(rng.random() < 0.5)
    for side in (0, 1):
        out = 1.0 if side == 0 else -1.0
        if belly and side != near:
            at = lie.position_m + R_lie @ (np.array([0.04 * out, 0.13, 0.19]) * size.scale)
        else:
            at = lie.position_m + R_lie @ (np.array([0.31 * out, 0.02, 0.0]) * size.scale)
            at[1] = height + size.hand_below_m + 0.02
        script.hands.append(
            HandGoal(side, lie.start_s + 0.5 * span, lie.settle_s + 0.2, lie.leave_s - 0.1, lie.leave_s + 0.5 * span,
                     at, elbow=(1.0, 0.0, -0.3), contact=True)
        )  # fmt: skip
    script.hands.append(
        HandGoal(near, lie.leave_s, lie.leave_s + 0.5 * span, lie.end_s - 0.15 * span, lie.end_s + 0.4, prop_at,
                 R_hand=flat, elbow=(0.2, 0.3, -1.0), contact=True)
    )  # fmt: skip


def _settled(
    script: Script, holds: tuple[PelvisHold, PelvisHold, PelvisHold], yaw: float, height: float
) -> tuple[SolvedMotion, Prop]:
    """Solves until the sitting and the lying body rest at one height; lifts the body where it would sink in between."""
    size, (sit, lie, again) = script.size, holds
    forward = yaw_rotation(yaw)[:, 2]
    front, depth = 0.2 * size.scale, max(0.9, 0.95 * size.scale)
    center = sit.position_m + forward * (front - 0.5 * depth)
    length = max(2.0, 2.15 * size.scale)
    prop = Prop("bed", (float(center[0]), height, float(center[2])), yaw, (length, depth),
                (int(sit.settle_s * FPS), int(again.leave_s * FPS)))  # fmt: skip
    trunk = ~np.isin(size.probe_part, (4, 5, 7, 8, 10, 11, 18, 19, 20, 21))
    lift = np.zeros(0)
    done = perform(script)
    for attempt in range(4):
        points = probes(done, size)
        on_bed = over(points, prop)
        low = np.where(on_bed & trunk, points[..., 1], np.inf).min(1)
        if attempt < 2:
            for hold in holds:
                rest = low[int(np.ceil(hold.settle_s * FPS)) : int(hold.leave_s * FPS)]
                hold.position_m = hold.position_m + np.array([0.0, height + GAP_M - float(rest.min()), 0.0])
            legs = np.isin(size.probe_part, (4, 5, 7, 8, 10, 11))
            still = slice(int(np.ceil(lie.settle_s * FPS)), int(lie.leave_s * FPS))
            low_leg = np.where(legs, points[still, :, 1], np.inf).min()
            for foot in script.feet:
                foot.ankle_m = foot.ankle_m + np.array([0.0, height + GAP_M - float(low_leg), 0.0])
            done = perform(script)
            continue
        for side in (0, 1):
            hand = np.where(on_bed & (size.probe_part == 20 + side), points[..., 1], np.inf).min(1)
            more = smooth_lift(np.where(hand < height - 1e-3, height + GAP_M - hand, 0.0), 0.3)
            script.hand_lift_m[side] = script.hand_lift_m.get(side, 0.0) + more
        deficit = np.where(np.isfinite(low), height + GAP_M - low, 0.0)
        more = smooth_lift(np.where(deficit > 1e-4, deficit, 0.0))
        for hold in holds:
            more[(done.t >= hold.settle_s) & (done.t <= hold.leave_s)] *= 0.0
        lift = more if not len(lift) else lift + more
        done = perform(script, lift)
    prop = _edge_behind_legs(done, size, prop, forward)
    skin = size.body.vertices(done.R_world_joint, done.joints_m).astype(float)
    sunk = height - float(np.where(over(skin, prop), skin[..., 1], np.inf).min())
    return done, at_height(prop, height - float(np.clip(sunk + 0.001, 0.0, _MAX_DROP_M)))


def _edge_behind_legs(done: SolvedMotion, size: BodyMeasure, prop: Prop, forward: np.ndarray) -> Prop:
    """The bed with its front edge moved back until no leg enters it."""
    x, height, z = prop.position_m
    points, legs = probes(done, size), np.isin(size.probe_part, (1, 2, 4, 5, 7, 8, 10, 11))
    below, moved = points[legs & (points[..., 1] < height - 0.004)], prop
    for back in np.arange(0.0, 0.13, 0.01) * size.scale:
        place = (float(x - forward[0] * back), height, float(z - forward[2] * back))
        moved = replace(prop, position_m=place)
        if not over(below, moved).any():
            break
    return moved
