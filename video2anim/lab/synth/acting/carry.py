"""Moving objects: picking up, carrying, putting down, drinking, pulling a chair. The object is made for the hand.

An object that is held is rigid with the hand; where it is taken and put down it stands flat, because the hand is turned
against the heading there as it is while it carries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.lab.synth.acting.curves import axis_rotation, turned
from video2anim.lab.synth.acting.finish import cut, motion_of
from video2anim.lab.synth.acting.grip import Grip, Hands, bag_grip, expect_sane, object_in, side_grip, top_grip
from video2anim.lab.synth.acting.measure import measure
from video2anim.lab.synth.acting.perform import Performed, perform
from video2anim.lab.synth.acting.script import HandGoal, Script
from video2anim.lab.synth.acting.sit import approach, palm_down
from video2anim.lab.synth.acting.walking import bezier, random_pace, turn, walk
from video2anim.lab.synth.world import ProceduralMotion, Prop, SceneObject
from video2anim.types.clip import FPS

_BEFORE_S, _AFTER_S = 2.0, 1.6
"""What is kept of the motion before the object is grasped and after it is let go."""
_ABOVE_M = 0.1
"""Objects are lifted from, and lowered to, a table through a place so far above it."""
_BEFORE_KNEES_M = (0.06, 0.3)
"""From and to the floor through one so much farther ahead and higher."""
_REACHED_M = 0.0005
"""Most that a wrist may be off its goal where an object is grasped or let go."""
_EVENT_S = (2.0, 0.6)
"""Bending that begins so long before a grasp, and so long after it, belongs to it."""
_NEAR = 0.75
"""A shoulder is too near to the hand's goal at less than this share of the arm."""
_DEEPER = {"crouch": 1.15, "spine_flex": 1.06, "pelvis_pitch": 1.08}


@dataclass(frozen=True, slots=True, eq=False)
class _Spot:
    """A place where the object stands, world."""

    position_m: Float[np.ndarray, "3"]
    yaw_rad: float

    @property
    def T(self) -> Float[np.ndarray, "4 4"]:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turned(self.yaw_rad), self.position_m
        return T


def _spot(script: Script, aside_m: float, height_m: float, ahead_m: float) -> _Spot:
    place = script.center_m + turned(script.yaw_rad) @ np.array([aside_m, 0.0, ahead_m])
    return _Spot(np.array([place[0], height_m, place[2]]), script.yaw_rad)


def _bend(script: Script, wrist_height_m: float, start_s: float, span_s: float) -> None:
    """Bends and crouches, the more the lower the wrists must get; knees stay back, for the object passes before
    them."""
    low = float(np.clip((1.05 * script.size.scale - wrist_height_m) / (0.85 * script.size.scale), 0.15, 1.0))
    script.keyed.key(start_s, span_s, crouch=0.2 * low * low, pelvis_pitch=0.75 * low, spine_flex=0.65 * low)
    script.keyed.key(start_s, 0.8 * span_s, neck_flex=0.3)


def _straighten(script: Script, start_s: float, span_s: float) -> None:
    script.keyed.rest(start_s, span_s, "crouch", "pelvis_pitch", "spine_flex")
    script.keyed.rest(start_s + 0.2, 0.8, "neck_flex")


def _take(script: Script, hands: Hands, spot: _Spot, *, lower_m: float = 0.0) -> float:
    """Reaches for the object; gives the time of the grasp, which is the script's time afterwards.

    `lower_m`: bends as for something so much lower, so that the arm has something to give.
    """
    low = spot.position_m[1] < 0.3
    start, span = script.now_s + script.rng.uniform(0.0, 0.15), script.rng.uniform(1.0, 1.2) + 0.2 * low
    _bend(script, spot.position_m[1] + hands.wrist_over_m - lower_m, start, span)
    if not low:
        hands.beside(spot.T, start, start + 0.5 * span, out_m=0.09, up_m=0.16, back_m=0.14)
    hands.beside(spot.T, start + (0.0 if low else 0.3 * span), start + 0.75 * span, out_m=0.09, up_m=0.05)
    hands.at(spot.T, start + 0.6 * span, start + span)
    _other_hand(script, hands, low, start, start + span + 0.2)
    script.now_s = start + span + 0.15
    return script.now_s


def _lift(script: Script, hands: Hands, spot: _Spot, carry_m: Float[np.ndarray, "3"]) -> None:
    """Rises with the object to where it is carried: the wrist in the heading frame at the pelvis, left side."""
    grasp, low = script.now_s, spot.position_m[1] < 0.3
    up = script.rng.uniform(1.0, 1.2) + 0.3 * low
    _straighten(script, grasp + (0.2 if low else 0.1), up)
    hands.at(_above(spot, script.size.scale), grasp, grasp + 0.55 * up)
    hands.carry(carry_m, grasp + (0.35 if low else 0.2) * up, grasp + up)
    script.now_s = grasp + up


def _above(spot: _Spot, scale: float) -> Float[np.ndarray, "4 4"]:
    """On the way to and from a spot: clear of the table's top, or before the knees."""
    T = spot.T
    if spot.position_m[1] < 0.3:
        T[:3, 3] += scale * (_BEFORE_KNEES_M[0] * T[:3, 2] + _BEFORE_KNEES_M[1] * T[:3, 1])
    else:
        T[1, 3] += _ABOVE_M
    return T


def _put(script: Script, hands: Hands, spot: _Spot) -> float:
    """Puts the object down; gives the time at which it is let go."""
    low = spot.position_m[1] < 0.3
    start, span = script.now_s + script.rng.uniform(0.1, 0.25), script.rng.uniform(1.2, 1.4) + 0.3 * low
    # Who bends before the arms go down need not stretch them.
    _bend(script, spot.position_m[1] + hands.wrist_over_m, start, (0.85 if low else 1.0) * span)
    hands.at(_above(spot, script.size.scale), start + 0.1 * span, start + 0.7 * span)
    hands.at(spot.T, start + (0.5 if low else 0.4) * span, start + span)
    release = start + span + 0.15
    hands.beside(spot.T, release, release + 0.35, out_m=0.08, up_m=0.04)
    if not low:
        hands.beside(spot.T, release + 0.2, release + 0.65, out_m=0.09, up_m=0.16, back_m=0.14)
    hands.free(release + (0.3 if low else 0.6), release + 1.3)
    _other_hand(script, hands, low, start, release + 0.2)
    _straighten(script, release + 0.2, 1.0)
    script.now_s = release + 1.5
    return release


def _other_hand(script: Script, hands: Hands, low: bool, start_s: float, leave_s: float) -> None:
    """The free hand rests on the thigh in a deep bend, else hangs back, so that it meets neither floor nor table."""
    if len(hands.grips) == 2:
        return
    side = 1 - hands.grips[0].side
    if low:
        size = script.size
        offset = np.array([0.72 * size.thigh_m, 0.12 * size.scale, -0.01])
        R = palm_down(side, 0.3)
        goal = HandGoal(side, start_s, start_s + 0.8, leave_s, leave_s + 0.9, offset, "thigh", R, (0.55, -0.6, -0.6))
        script.hands.append(goal)
        return
    n = "lr"[side]
    script.keyed.key(start_s, leave_s - start_s - 0.3, **{f"{n}_flex": -0.3, f"{n}_elbow": 0.2})
    script.keyed.rest(leave_s, 0.9, f"{n}_flex", f"{n}_elbow")


def _walk_to(script: Script, bearing_rad: float, distance_m: float, turn_rad: float) -> None:
    """Walks in a bow: the goal lies at a bearing against the heading, and is reached with another heading."""
    yaw = script.yaw_rad
    goal = script.center_m + turned(yaw + bearing_rad) @ np.array([0.0, 0.0, distance_m])
    path = bezier(script.center_m, yaw, goal, yaw + turn_rad)
    walk(script, path, random_pace(script))


def _solved(script: Script, hands: Hands, times_s: tuple[float, ...]) -> Performed:
    """Solves, bending deeper (or less, where the shoulder is too near) until the wrists are at their goals at the
    given times."""
    done = perform(script)
    for _ in range(20):
        off = [hands.off_m(done, int(np.ceil(t * FPS))) for t in times_s]
        if max(off, default=0.0) <= _REACHED_M:
            return done
        for at_s, off_m in zip(times_s, off, strict=True):
            if off_m > _REACHED_M:
                less = hands.nearness(done, int(np.ceil(at_s * FPS))) < _NEAR
                near = (at_s - _EVENT_S[0], at_s + _EVENT_S[1])
                script.keyed.moves = [
                    (
                        t,
                        d,
                        name,
                        change * _DEEPER.get(name, 1.0) ** (-1 if less else 1) if near[0] < t < near[1] else change,
                    )
                    for t, d, name, change in script.keyed.moves
                ]
        done = perform(script)
    worst = max(hands.off_m(done, int(np.ceil(t * FPS))) for t in times_s)
    raise InputError(f"a hand stays {100 * worst:.1f} cm from what it is to grasp; act the motion again")


def _finished(
    script: Script, kind: str, obj: SceneObject, hands: Hands, first: tuple[float | None, _Spot | None],
    last: tuple[float | None, _Spot | None], props: tuple[Prop, ...] = (),
) -> ProceduralMotion:  # fmt: skip
    """Solves the script: the object rests at a spot until a time, is held, and rests at another spot from a time on.

    No time and spot: it is held from the start, or to the end.
    """
    times = tuple(t for t, _ in (first, last) if t is not None)
    done = _solved(script, hands, times)
    count = len(done.t)
    grasp = 0 if first[0] is None else int(np.ceil(first[0] * FPS))
    release = count - 1 if last[0] is None else int(np.ceil(last[0] * FPS))
    pose = object_in(done, hands, slice(0, count))
    if first[1] is not None:
        # What the solver is off by goes into the grip, so that nothing jumps when the hand closes.
        pose = pose @ np.linalg.inv(pose[grasp]) @ first[1].T
        pose[: grasp + 1] = first[1].T
    if last[1] is not None:
        end = _flat(pose[release], last[1].position_m[1])
        if np.abs(end - pose[release]).max() > 2 * _REACHED_M:
            raise InputError(f"{obj.label} would be let go askew; act the motion again")
        pose[release + 1 :] = end
    expect_sane(script, done, hands, obj, pose, range(grasp, release + 1))
    held = np.zeros((count, 2), bool)
    held[grasp : release + 1, [grip.side for grip in hands.grips]] = True
    motion = replace(motion_of(kind, done, props), item_pose=pose, item_held=held, item=obj)
    begin = max(0, grasp - round(_BEFORE_S * FPS)) if first[0] is not None else 0
    stop = min(count, release + round(_AFTER_S * FPS)) if last[0] is not None else count
    return cut(motion, begin, stop)


def _flat(T: Float[np.ndarray, "4 4"], height_m: float) -> Float[np.ndarray, "4 4"]:
    """The pose upright, at a height."""
    out = np.eye(4)
    out[:3, :3] = turned(np.arctan2(T[0, 2], T[2, 2]))
    out[:3, 3] = T[0, 3], height_m, T[2, 3]
    return out


def _table(spot: _Spot, until: tuple[int, int], scale: float) -> Prop:
    """A table under a spot, its edge a hand's breadth before it; the person comes from there."""
    place = spot.position_m + turned(spot.yaw_rad)[:, 2] * 0.095 * scale
    x, y, z = (float(value) for value in place)
    return Prop("table", (x, y, z), float(spot.yaw_rad + np.pi), (0.5, 0.3), until)


def _side(script: Script) -> int:
    return int(script.rng.integers(2))


def carry_from_floor(script: Script) -> ProceduralMotion:
    """Walk up to a small object on the floor, pick it up, walk on with it and stand."""
    size, side = script.size, _side(script)
    out = 1.0 - 2.0 * side
    obj = Grip.furniture_piece(script.rng, ("vase", "box"), (0.17, 0.17))
    hands = Hands(script, (side_grip(size, side, obj, inward_rad=0.15, droop_rad=0.65),))
    approach(script, script.rng.uniform(1.6, 2.0))
    spot = _spot(script, out * 0.13 * size.scale, 0.0, 0.37 * size.scale)
    grasp = _take(script, hands, spot)
    _lift(script, hands, spot, hands.off_shoulder(0.1, -0.85, 0.5, 0.8))
    bearing = script.rng.choice([-1.0, 1.0]) * script.rng.uniform(0.7, 1.0)
    _walk_to(script, 0.7 * bearing, script.rng.uniform(2.0, 2.5), 1.4 * bearing)
    script.wait(1.0)
    return _finished(script, "carry_from_floor", obj, hands, (grasp, spot), (None, None))


def carry_between(script: Script) -> ProceduralMotion:
    """Take an object from a table, carry it to another table or to the floor elsewhere, and put it down."""
    size, rng, side = script.size, script.rng, _side(script)
    out = 1.0 - 2.0 * side
    obj = Grip.furniture_piece(rng, ("vase", "box"), (0.16, 0.16))
    hands = Hands(script, (side_grip(size, side, obj, inward_rad=0.3, droop_rad=0.45),))
    approach(script, rng.uniform(1.6, 2.0))
    spot = _spot(script, out * 0.12 * size.scale, float(rng.uniform(0.7, 0.8)) * size.scale, 0.46 * size.scale)
    grasp = _take(script, hands, spot)
    _lift(script, hands, spot, hands.off_shoulder(0.08, -0.8, 0.55, 0.8))
    lifted = script.now_s
    back = script.center_m - turned(script.yaw_rad)[:, 2] * 0.2 * size.scale
    turn(script, script.yaw_rad + rng.choice([-1.0, 1.0]) * rng.uniform(1.7, 2.2), back)
    _walk_to(script, rng.uniform(-0.25, 0.25), rng.uniform(1.5, 1.9), rng.uniform(-0.4, 0.4))
    on_floor = rng.random() < 0.35
    height = 0.0 if on_floor else float(rng.uniform(0.68, 0.8)) * size.scale
    goal = _spot(script, out * 0.12 * size.scale, height, 0.4 * size.scale if on_floor else 0.46 * size.scale)
    arrived = script.now_s
    release = _put(script, hands, goal)
    props = [_table(spot, (0, int(lifted * FPS)), size.scale)]
    if not on_floor:
        props.append(_table(goal, (int(arrived * FPS), int(release * FPS)), size.scale))
    return _finished(script, "carry_between", obj, hands, (grasp, spot), (release, goal), tuple(props))


def carry_box(script: Script) -> ProceduralMotion:
    """Lift a box from the floor with both hands, carry it elsewhere and set it down."""
    size, rng = script.size, script.rng
    obj = Grip.furniture_piece(
        rng, ("box",), (rng.uniform(0.32, 0.38), rng.uniform(0.24, 0.28)), rng.uniform(0.19, 0.23)
    )
    grips = tuple(side_grip(size, side, obj, inward_rad=0.0, droop_rad=0.6, flat=True) for side in (0, 1))
    hands = Hands(script, grips)
    approach(script, rng.uniform(1.5, 1.9))
    spot = _spot(script, 0.0, 0.0, 0.44 * size.scale)
    grasp = _take(script, hands, spot)
    carry = hands.off_shoulder(0.0, -0.68, 0.72, 0.8)
    carry[0] = hands.grips[0].offset_m[0]
    _lift(script, hands, spot, carry)
    bearing = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 0.8)
    _walk_to(script, bearing, rng.uniform(1.8, 2.3), 1.6 * bearing)
    goal = _spot(script, 0.0, 0.0, 0.44 * size.scale)
    release = _put(script, hands, goal)
    return _finished(script, "carry_box", obj, hands, (grasp, spot), (release, goal))


def drink(script: Script) -> ProceduralMotion:
    """Lift a cup from a table, drink, and put it back."""
    size, rng, side = script.size, script.rng, _side(script)
    out = 1.0 - 2.0 * side
    obj = Grip.furniture_piece(rng, ("cup",), (0.12, 0.12))
    inward = 0.6
    grip = side_grip(size, side, obj, inward_rad=inward, droop_rad=0.1, above_m=0.055)
    hands = Hands(script, (grip,))
    approach(script, rng.uniform(1.6, 2.0))
    spot = _spot(script, out * 0.06 * size.scale, float(rng.uniform(0.72, 0.82)) * size.scale, 0.46 * size.scale)
    grasp = _take(script, hands, spot)
    start, up = grasp, rng.uniform(1.0, 1.2)
    _straighten(script, grasp, up)
    lips = size.rest_m[15] + np.array([0.0, 0.012, 0.14]) * size.scale
    cup = obj.merged()[0]
    rim = np.array([0.0, cup[:, 1].max(), -0.8 * np.abs(cup[:, 2]).max()])
    R = axis_rotation(0, -0.55) @ turned(-out * (1.15 - inward))
    level = turned(-out * (1.15 - inward))
    near = lips + np.array([0.0, -0.05, 0.05]) - level @ rim
    hands.hold(level, near, start, start + up)
    tip = start + up - 0.25
    hands.hold(R, lips - axis_rotation(0, -0.55) @ rim, tip, tip + 0.6)
    script.keyed.key(tip + 0.1, 0.6, neck_flex=-0.16)
    sip = tip + 0.6 + rng.uniform(0.9, 1.3)
    hands.hold(level, near, sip, sip + 0.5)
    script.keyed.rest(sip, 0.6, "neck_flex")
    script.now_s = sip + 0.3
    release = _put(script, hands, spot)
    prop = _table(spot, (0, int(release * FPS)), size.scale)
    return _finished(script, "drink", obj, hands, (grasp, spot), (release, spot), (prop,))


def pull_chair(script: Script) -> ProceduralMotion:
    """Walk up behind a chair, take its back, pull it along while stepping backward, and let it stand."""
    size, rng, side = script.size, script.rng, _side(script)
    out = 1.0 - 2.0 * side
    obj = Grip.furniture_piece(rng, ("chair",), (0.44, 0.43))
    grip = top_grip(size, side, obj)
    hands = Hands(script, (grip,))
    approach(script, rng.uniform(1.6, 2.0))
    rear = float(obj.merged()[0][:, 2].min())
    spot = _spot(script, out * 0.14 * size.scale, 0.0, 0.36 * size.scale - rear)
    grasp = _take(script, hands, spot, lower_m=0.2 * size.scale)
    move = -turned(script.yaw_rad)[:, 2] * rng.uniform(0.6, 0.85)
    steps, center = 3, script.center_m
    begin = script.now_s
    for k in range(1, steps + 1):
        turn(script, script.yaw_rad, center + move * k / steps)
    hands.slide(begin, script.now_s, move)
    release = script.now_s + 0.3
    goal = _Spot(spot.position_m + move, spot.yaw_rad)
    hands.beside(goal.T, release, release + 0.4, out_m=0.02, up_m=0.1)
    hands.free(release + 0.3, release + 1.1)
    _straighten(script, release + 0.1, 1.0)
    script.now_s = release + 1.5
    motion = _finished(script, "pull_chair", obj, hands, (grasp, spot), (release, goal))
    assert motion.item_pose is not None
    off_floor_m = float(np.abs(motion.item_pose[:, 1, 3]).max())
    if off_floor_m > 2 * _REACHED_M:
        raise InputError(f"the chair leaves the floor by {1000 * off_floor_m:.0f} mm; act the motion again")
    return motion


def carry_bag(script: Script) -> ProceduralMotion:
    """Walk about with a bag in one hand that never rests."""
    size, rng, side = script.size, script.rng, _side(script)
    obj = Grip.furniture_piece(rng, ("bag",), (0.36, 0.14))
    hands = Hands(script, (bag_grip(size, side, obj),))
    hands.carry(hands.off_shoulder(0.36, -0.92, 0.04, 0.92), -2.0, -1.0)
    for _ in range(2):
        bearing = rng.uniform(-0.6, 0.6)
        _walk_to(script, bearing, rng.uniform(1.8, 2.4), bearing + rng.uniform(-0.5, 0.5))
        script.wait(rng.uniform(0.5, 0.8))
    return _finished(script, "carry_bag", obj, hands, (None, None), (None, None))


CARRIES: dict[str, Callable[[Script], ProceduralMotion]] = {
    "carry_from_floor": carry_from_floor,
    "carry_between": carry_between,
    "carry_box": carry_box,
    "drink": drink,
    "pull_chair": pull_chair,
    "carry_bag": carry_bag,
}


def act_carry(kind: str, body: ShapedBody, rng: np.random.Generator) -> ProceduralMotion:
    """A motion of one of the kinds `CARRIES`, with the object that it moves.

    Raises:
        InputError: a hand does not get to the object; other draws may.
    """
    return CARRIES[kind](Script.standing(measure(body), rng))
