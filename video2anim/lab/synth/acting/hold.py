"""Motions that use the hands: picking objects up, leaning on tables and walls, reaching for shelves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.acting.finish import GAP_M, motion_of, probes
from video2anim.lab.synth.acting.perform import SolvedMotion, perform
from video2anim.lab.synth.acting.script import HandGoal, PelvisHold, Script
from video2anim.lab.synth.acting.sit import approach, leave, palm_down
from video2anim.lab.synth.acting.walking import step_to, turn
from video2anim.lab.synth.world import ProceduralMotion, Prop
from video2anim.types.clip import FPS

_WRIST_OVER_M = 0.12
_ITEM_HALF_M = 0.06
"""Half the height of an object that is picked up; the hand closes around its upper half."""


def act_pick_up(script: Script) -> ProceduralMotion:
    """Walk up to a small object, bend or crouch, grasp it, rise and carry it away."""
    size, rng = script.size, script.rng
    approach(script, rng.uniform(1.2, 1.9))
    side = int(rng.integers(2))
    on_table = rng.random() < 0.4
    height = float(rng.uniform(0.3, 0.5) if on_table else 0.0)
    step_to(
        script,
        1 - side,
        script.center_m + yaw_rotation(script.yaw_rad)[:, 2] * 0.24 * size.scale,
        script.yaw_rad,
        vigor=0.3,
    )
    bend, grasp, up = _bend_to(script, side, height, ahead_m=(0.44 if on_table else 0.3) * size.scale)
    item = script.hands[-1].offset_m
    item_at = np.array([item[0], height, item[2]])
    item_at += yaw_rotation(script.yaw_rad)[:, 2] * 0.09 * size.scale
    out, yaw = 1.0 if side == 0 else -1.0, script.yaw_rad
    carry = np.array([0.22 * out, rng.uniform(-0.02, 0.12), rng.uniform(0.18, 0.26)]) * size.scale
    script.hands.append(HandGoal(side, grasp, up + 0.1, 1e8, 1e9, carry, "body", palm_inward(side), (0.6, -0.7, -0.4)))
    script.now_s = up + 0.1
    if on_table:
        _turn_away(script)
    leave(script, 0.3 if on_table else 1.0)
    done, item_at = _grasping(script, side, grasp, item_at)
    pose = _carried(done, side, item_at, yaw, int(np.ceil(grasp * FPS)))
    frames = (int(bend * FPS), min(len(done.t) - 1, int(up * FPS)))
    place = (float(item_at[0]), height, float(item_at[2]))
    back = float(yaw + np.pi)
    props = [Prop("item", place, back, (0.1, 0.1), (frames[0], len(done.t) - 1))]
    if on_table:
        shift = yaw_rotation(yaw) @ np.array([0.0, 0.0, 0.08])
        props.append(Prop("table", (place[0] + shift[0], height, place[2] + shift[2]), back, (0.5, 0.3), frames))
    held = np.zeros((len(done.t), 2), bool)
    held[int(np.ceil(grasp * FPS)) :, side] = True
    return replace(motion_of("pick_up", done, tuple(props), pose), item_held=held)


def _grasping(
    script: Script, side: int, grasp_s: float, item_at: np.ndarray
) -> tuple[SolvedMotion, Float[np.ndarray, "3"]]:
    """Solves the script with deeper bends until the hand reaches its goal. Returns also where the item lies (world)."""
    goal = next(goal for goal in script.hands if goal.side == side)
    frame = int(np.ceil(grasp_s * FPS))
    done = perform(script)
    gap = done.joints_m[frame, 20 + side] - goal.offset_m
    for _ in range(8):
        if gap[1] < 0.02:
            break
        deepen = {"crouch": 1.12, "spine_flex": 1.03, "pelvis_pitch": 1.04}
        script.keyed.moves = [(t, d, name, change * deepen.get(name, 1.0)) for t, d, name, change in script.keyed.moves]
        done = perform(script)
        gap = done.joints_m[frame, 20 + side] - goal.offset_m
    return done, item_at + gap * np.array([1.0, 0.0, 1.0])


def _bend_to(script: Script, side: int, height: float, ahead_m: float) -> tuple[float, float, float]:
    """Bends or crouches so that the hand reaches a point ahead. Returns the times of bending, grasp and standing up."""
    size, rng, key = script.size, script.rng, script.keyed.key
    low = 1.0 - np.clip(height / (0.55 * size.scale), 0.0, 0.75)
    style = rng.uniform(0.0, 1.0)
    start = script.now_s + rng.uniform(0.0, 0.15)
    span = rng.uniform(0.95, 1.25) * (0.7 + 0.3 * low)
    crouch = (0.16 + 0.26 * style) * low
    key(start, span, crouch=crouch, pelvis_pitch=(0.75 - 0.2 * style) * (0.35 + 0.65 * low),
        spine_flex=(0.85 - 0.2 * style) * (0.35 + 0.65 * low))  # fmt: skip
    key(start, 0.8 * span, neck_flex=0.35)
    other = "rl"[side]
    key(start, span, **{f"{other}_flex": 0.1 * low, f"{other}_elbow": 0.5})
    out = 1.0 if side == 0 else -1.0
    hand = script.center_m + yaw_rotation(script.yaw_rad) @ np.array([out * 0.12 * size.scale, 0.0, ahead_m])
    hand[1] = height + _ITEM_HALF_M + _WRIST_OVER_M * size.scale
    grasp, leave_s = start + span, start + span + rng.uniform(0.15, 0.35)
    R = yaw_rotation(script.yaw_rad) @ palm_down(side, 0.2, 1.0)
    script.hands.append(
        HandGoal(side, start + 0.05, grasp, leave_s + 2.0, leave_s + 3.0, hand, "world", R, (0.6, -0.2, -0.5))
    )
    up = leave_s + rng.uniform(0.9, 1.15) * (0.7 + 0.3 * low)
    script.keyed.rest(leave_s, up - leave_s, "crouch", "pelvis_pitch", "spine_flex", f"{other}_flex", f"{other}_elbow")
    script.keyed.rest(leave_s + 0.2, 0.8, "neck_flex")
    return start, leave_s, up


def _carried(
    done: SolvedMotion, side: int, item_at: np.ndarray, yaw: float, grasp: int
) -> Float[np.ndarray, "frames 4 4"]:
    """The item rests until the grasp, then moves rigidly with the wrist."""
    wrist = 20 + side
    pose = np.broadcast_to(np.eye(4), (len(done.t), 4, 4)).copy()
    pose[:, :3, :3], pose[:, :3, 3] = yaw_rotation(yaw), item_at
    hand = np.broadcast_to(np.eye(4), (len(done.t), 4, 4)).copy()
    hand[:, :3, :3], hand[:, :3, 3] = done.R_world_joint[:, wrist], done.joints_m[:, wrist]
    pose[grasp:] = hand[grasp:] @ np.linalg.inv(hand[grasp]) @ pose[grasp]
    return pose


def palm_inward(side: int) -> Float[np.ndarray, "3 3"]:
    """Rotation of a hand in the heading frame: fingers ahead, a little down and in; palm to the body's center plane."""
    out = 1.0 if side == 0 else -1.0
    fingers = np.array([-0.25 * out, -0.3, 1.0])
    x = out * fingers / np.linalg.norm(fingers)
    z = np.cross(x, [out, 0.5, 0.0])
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], -1)


def act_lean(script: Script) -> ProceduralMotion:
    """Walk up to a table or a wall and rest a hand or the back on it for a while."""
    return _lean_on_table(script) if script.rng.random() < 0.5 else _lean_on_wall(script)


def _lean_on_table(script: Script) -> ProceduralMotion:
    size, rng, key = script.size, script.rng, script.keyed.key
    approach(script, rng.uniform(1.2, 1.9))
    side = int(rng.integers(2))
    out = 1.0 if side == 0 else -1.0
    yaw = script.yaw_rad
    height = float(rng.uniform(0.72, 0.92)) * size.scale
    ahead = rng.uniform(0.33, 0.41) * size.scale
    hand = script.center_m + yaw_rotation(yaw) @ np.array([out * 0.24 * size.scale, 0.0, ahead])
    hand[1] = height + size.hand_below_m + GAP_M
    start = script.now_s - 0.2
    stay = rng.uniform(2.2, 3.2)
    R = yaw_rotation(yaw) @ palm_down(side, rng.uniform(-0.2, 0.5))
    low = max(0.0, 0.95 * size.scale - height)
    key(start, 1.0, spine_side=-out * 0.13, spine_flex=0.16 + 0.5 * low, pelvis_pitch=0.12 + 0.5 * low)
    times = (start, start + 0.95, start + stay, start + stay + 0.8)
    _touch(script, side, times, hand, R, elbow=(0.7, -0.4, -0.6), back_m=0.1)
    fidget_from = start + 1.1
    _look(script, fidget_from, start + stay)
    script.keyed.rest(start + stay - 0.1, 0.9, "spine_side", "spine_flex", "pelvis_pitch")
    script.now_s = start + stay + 0.5
    _turn_away(script)
    leave(script, 0.3)
    done = perform(script)
    frames = (int(np.ceil((start + 0.95) * FPS)), int((start + stay) * FPS))
    points = probes(done, size, slice(*frames))
    at_hand = size.probe_part == 20 + side
    top = float(points[:, at_hand, 1].min()) - GAP_M
    place = hand + yaw_rotation(yaw)[:, 2] * (0.13 + 0.025 * size.scale)
    prop = Prop("table", (float(place[0]), top, float(place[2])), float(yaw + np.pi), (0.4, 0.26), frames)
    return motion_of("lean", done, (prop,))


def _turn_away(script: Script) -> None:
    """Turns away with half a step back, so that no swinging arm hits what is ahead."""
    back = yaw_rotation(script.yaw_rad)[:, 2] * 0.2 * script.size.scale
    yaw = script.yaw_rad + script.rng.choice([-1.0, 1.0]) * script.rng.uniform(2.1, 2.8)
    turn(script, yaw, script.center_m - back)


def _touch(
    script: Script, side: int, times: tuple[float, float, float, float], hand_m: np.ndarray, R: np.ndarray, *,
    elbow: tuple[float, float, float], back_m: float, up_m: float = 0.13,
) -> None:  # fmt: skip
    """A hand comes down on a surface from above its front edge and returns the same way.

    Args:
        times: Start, touch, leave and end, in seconds.
        hand_m: World position of the wrist on the surface.
        R: World orientation of the hand.
        elbow: Direction of the elbow (see `HandGoal.elbow`).
        back_m: Distance in front of `hand_m` at which the hand passes the edge.
        up_m: Height above `hand_m` at which it does, for an average adult.
    """
    start, touch, off, end = times
    above = (
        hand_m
        - yaw_rotation(script.yaw_rad)[:, 2] * back_m * script.size.scale
        + np.array([0.0, up_m * script.size.scale, 0.0])
    )
    down, up = touch - start, end - off
    script.hands.append(HandGoal(side, start, start + 0.55 * down, off + 0.45 * up, end, above, "world", R, elbow))
    script.hands.append(
        HandGoal(side, start + 0.52 * down, touch, off, off + 0.48 * up, hand_m, "world", R, elbow, contact=True)
    )


def _look(script: Script, start_s: float, stop_s: float) -> None:
    rng, t = script.rng, start_s
    while t < stop_s - 0.6:
        script.keyed.key(t, rng.uniform(0.5, 0.8), neck_twist=rng.uniform(-0.6, 0.6), neck_flex=rng.uniform(-0.05, 0.2))
        t += rng.uniform(0.9, 1.4)
    script.keyed.rest(stop_s - 0.2, 0.6, "neck_twist", "neck_flex")


def _lean_on_wall(script: Script) -> ProceduralMotion:
    size, rng, key = script.size, script.rng, script.keyed.key
    approach(script, rng.uniform(1.2, 1.8))
    yaw = script.yaw_rad + rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.0) * np.pi
    forward = yaw_rotation(yaw)[:, 2]
    turn(script, yaw, script.center_m - 0.28 * size.scale * forward)
    begin, span, stay = script.now_s + 0.1, rng.uniform(0.8, 1.1), rng.uniform(2.0, 3.0)
    at = script.center_m - forward * rng.uniform(0.12, 0.2) * size.scale
    at[1] = size.stand_m - 0.03 * size.scale
    hold = PelvisHold(begin, begin + span, begin + span + stay, begin + span + stay + 0.9, at, contact=False,
                      back_after_s=0.1)  # fmt: skip
    ahead = PelvisHold(hold.leave_s, hold.leave_s + 0.6, hold.leave_s + 0.62, hold.leave_s + 1.3,
                       at + forward * 0.13 * size.scale, contact=False)  # fmt: skip
    hold.end_s = ahead.settle_s
    script.holds += [hold, ahead]
    key(begin, span + 0.05, pelvis_pitch=-0.06, spine_flex=-0.06, neck_flex=0.1)
    key(begin, span, l_flex=-0.12, r_flex=-0.12, l_elbow=0.35, r_elbow=0.35)
    _look(script, begin + span, begin + span + stay)
    script.keyed.rest(hold.leave_s - 0.3, 0.9, "pelvis_pitch", "spine_flex", "l_flex", "r_flex", "l_elbow", "r_elbow")
    script.now_s = ahead.end_s
    leave(script, 0.5)
    done = perform(script)
    near = slice(max(0, int((begin - 0.2) * FPS)), int(ahead.end_s * FPS))
    points = probes(done, size, near)
    plane = float((points @ forward).min()) - GAP_M
    rest = slice(int(np.ceil(hold.settle_s * FPS)), int(hold.leave_s * FPS))
    touch = at + forward * (plane - at @ forward)
    touch[1] = float(done.joints_m[rest, 9, 1].mean())
    prop = Prop("wall", (float(touch[0]), float(touch[1]), float(touch[2])), float(yaw), (0.9, 0.1),
                (rest.start, rest.stop))  # fmt: skip
    return motion_of("lean", done, (prop,))


def act_reach(script: Script) -> ProceduralMotion:
    """Walk up to a shelf and reach for one of its boards, high or low."""
    size, rng, key = script.size, script.rng, script.keyed.key
    approach(script, rng.uniform(1.3, 2.0))
    side = int(rng.integers(2))
    out = 1.0 if side == 0 else -1.0
    yaw = script.yaw_rad
    high = rng.random() < 0.65
    n, start = "lr"[side], script.now_s - 0.1
    if high:
        shoulder = size.stand_m + float(size.rest_m[16, 1])
        height = shoulder * float(rng.uniform(0.88, 1.24))
        ahead = np.sqrt(max((0.86 * size.arm_m) ** 2 - (height - shoulder) ** 2, (0.26 * size.scale) ** 2))
        span, stay = rng.uniform(1.1, 1.3), rng.uniform(0.4, 0.9)
        hand = script.center_m + yaw_rotation(yaw) @ np.array([out * 0.16 * size.scale, 0.0, ahead])
        hand[1] = height + size.hand_below_m
        key(start, span, spine_side=-0.1 * out, spine_flex=-0.04, neck_flex=-0.3, **{f"{n}_lift": 0.25})
        times = (start, start + span, start + span + stay, start + 2 * span + stay)
        _touch(
            script,
            side,
            times,
            hand,
            yaw_rotation(yaw) @ palm_down(side, 0.0),
            elbow=(0.8, -0.6, 0.2),
            back_m=0.3,
            up_m=0.14,
        )
        script.keyed.rest(start + span + stay, span, "spine_side", "spine_flex", "neck_flex", f"{n}_lift")
        touch, end = start + span, start + span + stay
        script.now_s = start + 2 * span + stay - 0.2
    else:
        height = float(rng.uniform(0.25, 0.55)) * size.scale
        start, end, up = _bend_to(script, side, height, ahead_m=0.42 * size.scale)
        goal = script.hands.pop()
        hand, touch = goal.offset_m, goal.touch_s
        R = yaw_rotation(yaw) @ palm_down(side, 0.1, 0.15)
        _touch(script, side, (start, touch, end, up), hand, R, elbow=(0.6, -0.2, -0.5), back_m=0.12)
        script.now_s = up
    _turn_away(script)
    leave(script, 0.3)
    done = perform(script)
    frames = (int(np.ceil(touch * FPS)), int(end * FPS))
    points = probes(done, size, slice(*frames))
    top = float(points[:, size.probe_part == 20 + side, 1].min()) - GAP_M
    depth = 0.2 if high else 0.26  # fingers only lie on a high shelf
    place = hand + yaw_rotation(yaw)[:, 2] * (0.5 * depth + (0.115 if high else 0.025) * size.scale)
    prop = Prop("table", (float(place[0]), top, float(place[2])), float(yaw + np.pi), (0.4, depth), frames)
    return motion_of("reach", done, (prop,))
