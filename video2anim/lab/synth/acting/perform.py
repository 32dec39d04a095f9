"""From a script to joint rotations: balance, pelvis height, spine, and inverse kinematics of legs and arms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    slerp,
)
from video2anim.lab.synth.acting.arms import place_hands
from video2anim.lab.synth.acting.curves import (
    FPS,
    axis_rotation,
    balance,
    ease,
    slow_noise,
    smooth_track,
    smooth_track_below,
    window,
    yaw_rotation,
)
from video2anim.lab.synth.acting.feet import FootTrack, foot_track
from video2anim.lab.synth.acting.gait import gait_channels
from video2anim.lab.synth.acting.limbs import keyed_arm, leg_rotations
from video2anim.lab.synth.acting.measure import ARM, LEG
from video2anim.lab.synth.acting.script import FootHold, Script
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

_SPINE = tuple(JOINT_INDEX[n] for n in ("spine1", "spine2", "spine3"))
_SPINE_SHARE = (0.3, 0.35, 0.35)
_REACH = 0.996
"""Largest hip-to-ankle distance as a share of the leg's length."""
_LEAD_S = 0.3
"""The head turns to the heading that the body will have this much later."""
_PASSES = 3
_TREMOR = {"neck_flex": 0.005, "neck_side": 0.003, "neck_twist": 0.006, "l_flex": 0.006, "r_flex": 0.006,
           "l_elbow": 0.008, "r_elbow": 0.008, "l_abd": 0.004, "r_abd": 0.004}  # fmt: skip
"""Unsteadiness between 2.5 and 6 Hz, radians (standard deviation)."""
_IMPACT_M, _IMPACT_HZ, _IMPACT_S = 0.0045, 5.5, 0.1
"""Damped oscillation of the pelvis at a heel strike: amplitude, frequency, decay time."""
_STILL_M = 0.0009
"""A joint has contact only while it moves less than this per frame."""


@dataclass(frozen=True, slots=True, eq=False)
class SolvedMotion:
    """A solved script: time in seconds, rotations, world joints, contacts and heading of every frame."""

    t: Float[np.ndarray, "frames"]
    translation_m: Float[np.ndarray, "frames 3"]
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    contact: Bool[np.ndarray, "frames 22"]
    joints_m: Float[np.ndarray, "frames 22 3"]
    R_world_joint: Float[np.ndarray, "frames 22 3 3"]
    heading_rad: Float[np.ndarray, "frames"]


def perform(script: Script, lift_m: Float[np.ndarray, "frames"] | None = None) -> SolvedMotion:
    """Solves the script up to its last time. `lift_m` raises the pelvis, to keep the body out of furniture."""
    size = script.size
    t = np.arange(round(script.now_s * FPS) + 1) / FPS
    feet = [foot_track(script.plants[side], t, size) for side in (0, 1)]
    heading = _heading(feet)
    channels = _channels(script, t)
    R_pelvis = _pelvis_orientation(script, t, heading, channels)
    R_local = _upper_body(channels, heading, t)
    R_local[:, 0] = R_pelvis
    feet_pose = [_held_foot(script, side, feet[side], t) for side in (0, 1)]
    pressure = _pressure(script, feet, t)
    offset, pelvis = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for _ in range(_PASSES):
        pelvis = _pelvis_path(script, t, feet, feet_pose, pressure, offset, R_pelvis, channels)
        if lift_m is not None:
            pelvis[:, 1] += lift_m
        R_local = _legs(script, pelvis, R_local, feet_pose, feet)
        joints, R_world = forward_kinematics(R_local, pelvis, size.rest_m)
        offset = np.einsum("tjc,j->tc", joints, size.mass) - pelvis
    R_local = place_hands(script, t, pelvis, R_local, heading)
    joints, R_world = forward_kinematics(R_local, pelvis, size.rest_m)
    contact = _contacts(script, t, feet)
    step = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    moves = np.zeros(contact.shape, bool)
    moves[1:] |= step > _STILL_M
    moves[:-1] |= step > _STILL_M
    contact &= ~moves
    return SolvedMotion(t, pelvis, R_local, contact, joints, R_world, heading)


def _heading(feet: list[FootTrack]) -> Float[np.ndarray, "frames"]:
    """Unwrapped heading of the pelvis in radians: the smoothed mean heading of the feet."""
    left, right = np.unwrap(feet[0].yaw_rad), np.unwrap(feet[1].yaw_rad)
    right = right + 2 * np.pi * np.round((left[0] - right[0]) / (2 * np.pi))
    return smooth_track(0.5 * (left + right), 1.0, 0.5)


def _channels(script: Script, t: np.ndarray) -> dict[str, np.ndarray]:
    channels = script.keyed.tracks(t)
    for name, added in gait_channels(script, t).items():
        channels[name] = channels[name] + added * script.loose(t, name)
    names = ("spine_flex", "spine_side", "spine_twist", "neck_flex", "neck_side", "neck_twist",
             "l_flex", "r_flex", "l_elbow", "r_elbow", "l_abd", "r_abd")  # fmt: skip
    size = (0.008, 0.006, 0.012, 0.018, 0.012, 0.025, 0.015, 0.015, 0.02, 0.02, 0.008, 0.008)
    rng = script.noise()
    noise, tremor = slow_noise(rng, t, len(names)), slow_noise(rng, t, len(names), 2.5, 6.0)
    calm = np.ones(len(t))
    for hold in script.holds:
        if hold.back_after_s < 1e3:
            calm -= 0.8 * window(t, hold.start_s, hold.settle_s, hold.leave_s, hold.end_s)
    for k, name in enumerate(names):
        rough = _TREMOR.get(name, 0.002) * tremor[:, k]
        channels[name] = channels[name] + calm * (size[k] * noise[:, k] + rough)
    trunk = channels["pelvis_pitch"] + channels["spine_flex"]
    channels["neck_flex"] = channels["neck_flex"] - 0.45 * trunk
    for name in ("l_flex", "r_flex"):
        channels[name] = channels[name] + 0.8 * trunk
    return channels


def _pelvis_orientation(
    script: Script, t: np.ndarray, heading: np.ndarray, channels: dict[str, np.ndarray]
) -> Float[np.ndarray, "frames 3 3"]:
    upright = yaw_rotation(heading + channels["pelvis_yaw"]) @ axis_rotation(0, channels["pelvis_pitch"])
    quaternion = quaternion_from_matrix(upright @ axis_rotation(2, channels["pelvis_roll"]))
    for hold in script.holds:
        if hold.R_world is not None:
            weight = window(t, hold.start_s, hold.settle_s, hold.leave_s, hold.end_s)[:, None]
            goal = np.broadcast_to(quaternion_from_matrix(hold.R_world), quaternion.shape)
            quaternion = slerp(quaternion, goal, weight)
    return matrix_from_quaternion(quaternion)


def _upper_body(channels: dict[str, np.ndarray], heading: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Local rotations of the joints above the pelvis; all others are the identity."""
    R = np.broadcast_to(np.eye(3), (len(t), 22, 3, 3)).copy()
    for joint, share in zip(_SPINE, _SPINE_SHARE, strict=True):
        R[:, joint] = (
            axis_rotation(1, share * channels["spine_twist"])
            @ axis_rotation(0, share * channels["spine_flex"])
            @ axis_rotation(2, share * channels["spine_side"])
        )
    ahead = np.interp(t + _LEAD_S, t, heading) - heading
    look = channels["neck_twist"] + 0.7 * np.tanh(ahead / 0.7) - 0.6 * channels["spine_twist"] - channels["pelvis_yaw"]
    for joint, share in ((JOINT_INDEX["neck"], 0.4), (JOINT_INDEX["head"], 0.6)):
        R[:, joint] = (
            axis_rotation(1, share * look)
            @ axis_rotation(0, share * channels["neck_flex"])
            @ axis_rotation(2, share * channels["neck_side"])
        )
    for side, (collar, shoulder, elbow, _) in enumerate(ARM):
        n = "lr"[side]
        flex, abd = channels[f"{n}_flex"], channels[f"{n}_abd"]
        R[:, collar] = axis_rotation(2, (1.0 - 2.0 * side) * channels[f"{n}_lift"])
        R[:, shoulder], R[:, elbow] = keyed_arm(flex, abd, channels[f"{n}_twist"], channels[f"{n}_elbow"], side)
    return R


def _held_foot(script: Script, side: int, track: FootTrack, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World ankle and foot orientation with foot holds applied; a foot rises, then moves sideways, then sinks."""
    ankle, R = track.ankle_m.copy(), track.R_world_foot
    for hold in script.feet:
        if hold.side != side:
            continue
        ankle[:, 1] += (hold.ankle_m[1] - ankle[:, 1]) * _held_share(hold, t, 0.0, 0.55)
        across = _held_share(hold, t, 0.33, 1.0)[:, None]
        ankle[:, [0, 2]] += (hold.ankle_m[[0, 2]] - ankle[:, [0, 2]]) * across
        goal = np.broadcast_to(quaternion_from_matrix(hold.R_world), (len(t), 4))
        R = matrix_from_quaternion(slerp(quaternion_from_matrix(R), goal, _held_share(hold, t, 0.1, 0.9)[:, None]))
    return ankle, R


def _held_share(hold: FootHold, t: np.ndarray, start: float, stop: float) -> Float[np.ndarray, "frames"]:
    """1 while held; rises between the shares `start` and `stop` of the way there, and falls mirrored on the way
    back."""
    up, down = hold.settle_s - hold.start_s, hold.end_s - hold.leave_s
    rise = ease((t - hold.start_s - start * up) / ((stop - start) * up))
    fall = ease((hold.end_s - start * down - t) / ((stop - start) * down))
    return np.where(t < 0.5 * (hold.settle_s + hold.leave_s), rise, fall)


def _pressure(script: Script, feet: list[FootTrack], t: np.ndarray) -> Float[np.ndarray, "frames 2"]:
    """Wanted center of pressure (world x, z): mean of the feet's, weighted by load, plus a little sway."""
    load = np.stack([track.load for track in feet], -1) + 1e-3
    share = load / load.sum(1, keepdims=True)
    point = sum(share[:, side, None] * feet[side].pressure_m[:, [0, 2]] for side in (0, 1))
    return np.asarray(point) + 0.005 * script.size.scale * slow_noise(script.noise(), t, 2, 0.15, 1.0)


def _pelvis_path(
    script: Script,
    t: np.ndarray,
    feet: list[FootTrack],
    feet_pose: list[tuple[np.ndarray, np.ndarray]],
    pressure: np.ndarray,
    offset: np.ndarray,
    R_pelvis: np.ndarray,
    channels: dict[str, np.ndarray],
) -> Float[np.ndarray, "frames 3"]:
    size = script.size
    free, held = np.ones(len(t)), np.zeros(len(t))
    hold_at = np.zeros((len(t), 3))
    for hold in script.holds:
        inside = (t > hold.start_s) & (t < hold.end_s)
        rest = (t >= hold.settle_s) & (t <= hold.leave_s)
        free[inside] = 0.0
        held[rest], hold_at[rest] = 1.0, hold.position_m
    slow = smooth_track(offset[:, [0, 2]], 1.0, 0.08)
    path = balance(pressure, free, hold_at[:, [0, 2]] + slow, held, 0.56 * 2 * size.stand_m * 0.98) - slow
    load = np.stack([track.load for track in feet], -1) + 1e-3
    ground = np.stack([track.pressure_m[:, 1] for track in feet], -1)
    support = smooth_track((ground * load).sum(1) / load.sum(1), 1.0, 0.4)
    wanted = support + size.stand_m - 0.012 * size.scale - channels["crouch"] * size.leg_m
    ceiling = np.full(len(t), np.inf)
    for side, (hip, _, _, _) in enumerate(LEG):
        hip_offset = R_pelvis @ size.rest_m[hip]
        across = path + hip_offset[:, [0, 2]] - feet_pose[side][0][:, [0, 2]]
        room = np.maximum((_REACH * size.leg_m) ** 2 - (across**2).sum(1), 0.01)
        ceiling = np.minimum(ceiling, feet_pose[side][0][:, 1] + np.sqrt(room) - hip_offset[:, 1])
    busy = held > 0
    wanted = np.where(busy, hold_at[:, 1], wanted)
    ceiling = np.where(busy, np.maximum(ceiling, wanted), ceiling)
    height = smooth_track_below(wanted, np.where(busy, 1e5, free), ceiling, 0.2)
    out = np.stack([path[:, 0], height, path[:, 1]], -1) + free[:, None] * _jolts(script, t)
    out[busy] = hold_at[busy]
    return out


def _jolts(script: Script, t: np.ndarray) -> Float[np.ndarray, "frames 3"]:
    """Damped oscillation of the pelvis after each heel strike, mostly vertical, a little backward; meters."""
    out = np.zeros((len(t), 3))
    for stride in script.strides:
        plant = next(p for p in script.plants[stride.side] if p.start_s == stride.land_s)
        since = np.maximum(t - stride.land_s, 0.0)
        wave = np.exp(-since / _IMPACT_S) * np.sin(2 * np.pi * _IMPACT_HZ * since)
        strength = _IMPACT_M * script.size.scale * min(1.0, 0.15 + plant.strike_rad / 0.3)
        ahead = np.array([-0.4 * np.sin(plant.yaw_rad), -1.0, -0.4 * np.cos(plant.yaw_rad)])
        out += strength * wave[:, None] * ahead
    return out


def _legs(
    script: Script, pelvis: np.ndarray, R_local: np.ndarray, pose: list[tuple[np.ndarray, np.ndarray]],
    feet: list[FootTrack],
) -> np.ndarray:  # fmt: skip
    """Rotations with legs solved to the ankles; knees point between pelvis and foot; toes bend as the feet roll."""
    size, R = script.size, R_local.copy()
    for side, (hip, knee, ankle, foot) in enumerate(LEG):
        ankle_m, R_foot = pose[side]
        hip_m = pelvis + R[:, 0] @ size.rest_m[hip]
        pole = R[:, 0, :, 2] + 0.8 * (yaw_rotation(feet[side].yaw_rad)[:, :, 2] if not script.feet else R_foot[:, :, 2])
        thigh, shin, _ = leg_rotations(hip_m, ankle_m, pole, size.thigh_m, size.shin_m)
        R[:, hip] = np.swapaxes(R[:, 0], -1, -2) @ thigh
        R[:, knee] = np.swapaxes(thigh, -1, -2) @ shin
        R[:, ankle] = np.swapaxes(shin, -1, -2) @ R_foot
        R[:, foot] = axis_rotation(0, feet[side].toe_rad)
    return R


def _contacts(script: Script, t: np.ndarray, feet: list[FootTrack]) -> Bool[np.ndarray, "frames 22"]:
    contact = np.zeros((len(t), 22), bool)
    for side, (_, _, ankle, foot) in enumerate(LEG):
        away = np.zeros(len(t), bool)
        for hold in script.feet:
            if hold.side == side:
                away |= (t > hold.start_s) & (t < hold.end_s)
        contact[:, ankle], contact[:, foot] = feet[side].heel_down & ~away, feet[side].ball_down & ~away
    for hold in script.holds:
        rest = (t >= hold.settle_s) & (t <= hold.leave_s)
        contact[:, 0] |= rest & hold.contact
        contact[:, JOINT_INDEX["spine3"]] |= (t >= hold.settle_s + hold.back_after_s) & (t <= hold.leave_s - 0.5)
    for goal in script.hands:
        if goal.contact:
            first, last = goal.still_s or (goal.touch_s, goal.leave_s)
            contact[:, ARM[goal.side][3]] |= (t >= first) & (t <= last)
    return contact
