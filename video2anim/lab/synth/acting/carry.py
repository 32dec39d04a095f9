"""Motions with an object: picking up, carrying, putting down, drinking, pulling a chair.

A held object is rigid with the hand. It stands flat where it is picked up and put down, because the hand then has the
same orientation relative to the heading as while it carries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import InputError
from video2anim.lab.synth.acting.curves import axis_rotation, yaw_rotation
from video2anim.lab.synth.acting.finish import cut, motion_of
from video2anim.lab.synth.acting.grip import Grip, Hands, bag_grip, expect_plausible, object_in, side_grip, top_grip
from video2anim.lab.synth.acting.measure import measure
from video2anim.lab.synth.acting.perform import SolvedMotion, perform
from video2anim.lab.synth.acting.script import HandGoal, Script
from video2anim.lab.synth.acting.sit import approach, palm_down
from video2anim.lab.synth.acting.walking import bezier, random_pace, turn, walk
from video2anim.lab.synth.world import ProceduralMotion, Prop, SceneObject
from video2anim.types.clip import FPS

_BEFORE_S, _AFTER_S = 2.0, 1.6
"""Time that the clip keeps before the grasp and after the release."""
_ABOVE_M = 0.1
"""Objects are lifted from and lowered to a table through a point at this height above their place."""
_BEFORE_KNEES_M = (0.06, 0.3)
"""Objects on the floor pass through a point this far ahead of and above their place, so that they clear the knees."""
_REACHED_M = 0.0005
"""Largest distance of a wrist to its goal at the grasp and at the release."""
_BEND_TIME_S = (2.0, 0.6)
"""Posture moves that start within this time before and after a grasp are those that bend for it."""
_MIN_REACH_RATIO = 0.75
"""The body bends less if the goal is nearer to the shoulder than this share of the arm's length."""
_BEND_FACTOR = {"crouch": 1.15, "spine_flex": 1.06, "pelvis_pitch": 1.08}
"""Factor on each posture channel per iteration that bends deeper."""


@dataclass(frozen=True, slots=True, eq=False)
class _Spot:
    """A place where the object stands, in the world frame."""

    position_m: Float[np.ndarray, "3"]
    yaw_rad: float

    @property
    def T(self) -> Float[np.ndarray, "4 4"]:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = yaw_rotation(self.yaw_rad), self.position_m
        return T


def _spot(script: Script, aside_m: float, height_m: float, ahead_m: float) -> _Spot:
    place = script.center_m + yaw_rotation(script.yaw_rad) @ np.array([aside_m, 0.0, ahead_m])
    return _Spot(np.array([place[0], height_m, place[2]]), script.yaw_rad)


def _bend(script: Script, wrist_height_m: float, start_s: float, span_s: float) -> None:
    """Bends and crouches, more for lower wrists. Knees stay back because the object passes in front of them."""
    low = float(np.clip((1.05 * script.size.scale - wrist_height_m) / (0.85 * script.size.scale), 0.15, 1.0))
    script.keyed.key(start_s, span_s, crouch=0.2 * low * low, pelvis_pitch=0.75 * low, spine_flex=0.65 * low)
    script.keyed.key(start_s, 0.8 * span_s, neck_flex=0.3)


def _straighten(script: Script, start_s: float, span_s: float) -> None:
    script.keyed.rest(start_s, span_s, "crouch", "pelvis_pitch", "spine_flex")
    script.keyed.rest(start_s + 0.2, 0.8, "neck_flex")


def _take(script: Script, hands: Hands, spot: _Spot, *, lower_m: float = 0.0) -> float:
    """Reaches for the object. Returns the time of the grasp in seconds; the script continues from there.

    `lower_m`: the body bends as for an object this much lower, so that the arm is not straight.
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
    """Rises with the object. `carry_m`: left wrist relative to the pelvis in the heading frame (mirrored for the
    right)."""
    grasp, low = script.now_s, spot.position_m[1] < 0.3
    up = script.rng.uniform(1.0, 1.2) + 0.3 * low
    _straighten(script, grasp + (0.2 if low else 0.1), up)
    hands.at(_approach_pose(spot, script.size.scale), grasp, grasp + 0.55 * up)
    hands.carry(carry_m, grasp + (0.35 if low else 0.2) * up, grasp + up)
    script.now_s = grasp + up


def _approach_pose(spot: _Spot, scale: float) -> Float[np.ndarray, "4 4"]:
    """World pose of the object on its way to and from a spot: above the table's top, or ahead of the knees."""
    T = spot.T
    if spot.position_m[1] < 0.3:
        T[:3, 3] += scale * (_BEFORE_KNEES_M[0] * T[:3, 2] + _BEFORE_KNEES_M[1] * T[:3, 1])
    else:
        T[1, 3] += _ABOVE_M
    return T


def _put_down(script: Script, hands: Hands, spot: _Spot) -> float:
    """Puts the object down. Returns the time of the release in seconds."""
    low = spot.position_m[1] < 0.3
    start, span = script.now_s + script.rng.uniform(0.1, 0.25), script.rng.uniform(1.2, 1.4) + 0.3 * low
    # Bending starts before the arms go down, so that they need not stretch.
    _bend(script, spot.position_m[1] + hands.wrist_over_m, start, (0.85 if low else 1.0) * span)
    hands.at(_approach_pose(spot, script.size.scale), start + 0.1 * span, start + 0.7 * span)
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
    """The free hand rests on the thigh in a deep bend, else swings back: it must touch neither floor nor table."""
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
    """Walks along a curve to a goal at a bearing and distance; the heading changes by `turn_rad` on the way."""
    yaw = script.yaw_rad
    goal = script.center_m + yaw_rotation(yaw + bearing_rad) @ np.array([0.0, 0.0, distance_m])
    path = bezier(script.center_m, yaw, goal, yaw + turn_rad)
    walk(script, path, random_pace(script))


def _solve_with_bends(script: Script, hands: Hands, times_s: tuple[float, ...]) -> SolvedMotion:
    """Solves the script again with deeper bends (less deep where the shoulder is too near) until the wrists reach their
    goals at the given times.

    Raises:
        InputError: a wrist is still off its goal after 20 iterations.
    """
    done = perform(script)
    for _ in range(20):
        off = [hands.wrist_error_m(done, int(np.ceil(t * FPS))) for t in times_s]
        if max(off, default=0.0) <= _REACHED_M:
            return done
        for at_s, wrist_error_m in zip(times_s, off, strict=True):
            if wrist_error_m > _REACHED_M:
                less = hands.reach_ratio(done, int(np.ceil(at_s * FPS))) < _MIN_REACH_RATIO
                near = (at_s - _BEND_TIME_S[0], at_s + _BEND_TIME_S[1])
                script.keyed.moves = [
                    (
                        t,
                        d,
                        name,
                        change * _BEND_FACTOR.get(name, 1.0) ** (-1 if less else 1)
                        if near[0] < t < near[1]
                        else change,
                    )
                    for t, d, name, change in script.keyed.moves
                ]
        done = perform(script)
    worst = max(hands.wrist_error_m(done, int(np.ceil(t * FPS))) for t in times_s)
    raise InputError(f"a hand stays {100 * worst:.1f} cm away from the object that it grasps; draw the motion again")


def _solve_clip(
    script: Script, kind: str, obj: SceneObject, hands: Hands, first: tuple[float | None, _Spot | None],
    last: tuple[float | None, _Spot | None], props: tuple[Prop, ...] = (),
) -> ProceduralMotion:  # fmt: skip
    """Solves the script and cuts it to the part around the object's motion.

    Args:
        first: Time of the grasp in seconds and where the object rests before it; (None, None) if held from the start.
        last: Time of the release in seconds and where the object rests after it; (None, None) if held to the end.

    Raises:
        InputError: a hand does not reach its goal, the object is tilted at the release, a hand slips, or the object
            enters the body.
    """
    times = tuple(t for t, _ in (first, last) if t is not None)
    done = _solve_with_bends(script, hands, times)
    count = len(done.t)
    grasp = 0 if first[0] is None else int(np.ceil(first[0] * FPS))
    release = count - 1 if last[0] is None else int(np.ceil(last[0] * FPS))
    pose = object_in(done, hands, slice(0, count))
    if first[1] is not None:
        # The solver's residual becomes part of the grip, so that the object does not jump at the grasp.
        pose = pose @ np.linalg.inv(pose[grasp]) @ first[1].T
        pose[: grasp + 1] = first[1].T
    if last[1] is not None:
        end = _upright_pose(pose[release], last[1].position_m[1])
        if np.abs(end - pose[release]).max() > 2 * _REACHED_M:
            raise InputError(f"{obj.label} would be tilted at the release; draw the motion again")
        pose[release + 1 :] = end
    expect_plausible(script, done, hands, obj, pose, range(grasp, release + 1))
    held = np.zeros((count, 2), bool)
    held[grasp : release + 1, [grip.side for grip in hands.grips]] = True
    motion = replace(motion_of(kind, done, props), item_pose=pose, item_held=held, item=obj)
    begin = max(0, grasp - round(_BEFORE_S * FPS)) if first[0] is not None else 0
    stop = min(count, release + round(_AFTER_S * FPS)) if last[0] is not None else count
    return cut(motion, begin, stop)


def _upright_pose(T: Float[np.ndarray, "4 4"], height_m: float) -> Float[np.ndarray, "4 4"]:
    """The pose with its up axis vertical and its origin at `height_m`."""
    out = np.eye(4)
    out[:3, :3] = yaw_rotation(np.arctan2(T[0, 2], T[2, 2]))
    out[:3, 3] = T[0, 3], height_m, T[2, 3]
    return out


def _table(spot: _Spot, until: tuple[int, int], scale: float) -> Prop:
    """A table under a spot. Its front edge, on the person's side, is 9.5 cm from the spot (average adult)."""
    place = spot.position_m + yaw_rotation(spot.yaw_rad)[:, 2] * 0.095 * scale
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
    return _solve_clip(script, "carry_from_floor", obj, hands, (grasp, spot), (None, None))


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
    back = script.center_m - yaw_rotation(script.yaw_rad)[:, 2] * 0.2 * size.scale
    turn(script, script.yaw_rad + rng.choice([-1.0, 1.0]) * rng.uniform(1.7, 2.2), back)
    _walk_to(script, rng.uniform(-0.25, 0.25), rng.uniform(1.5, 1.9), rng.uniform(-0.4, 0.4))
    on_floor = rng.random() < 0.35
    height = 0.0 if on_floor else float(rng.uniform(0.68, 0.8)) * size.scale
    goal = _spot(script, out * 0.12 * size.scale, height, 0.4 * size.scale if on_floor else 0.46 * size.scale)
    arrived = script.now_s
    release = _put_down(script, hands, goal)
    props = [_table(spot, (0, int(lifted * FPS)), size.scale)]
    if not on_floor:
        props.append(_table(goal, (int(arrived * FPS), int(release * FPS)), size.scale))
    return _solve_clip(script, "carry_between", obj, hands, (grasp, spot), (release, goal), tuple(props))


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
    release = _put_down(script, hands, goal)
    return _solve_clip(script, "carry_box", obj, hands, (grasp, spot), (release, goal))


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
    R = axis_rotation(0, -0.55) @ yaw_rotation(-out * (1.15 - inward))
    level = yaw_rotation(-out * (1.15 - inward))
    near = lips + np.array([0.0, -0.05, 0.05]) - level @ rim
    hands.hold(level, near, start, start + up)
    tip = start + up - 0.25
    hands.hold(R, lips - axis_rotation(0, -0.55) @ rim, tip, tip + 0.6)
    script.keyed.key(tip + 0.1, 0.6, neck_flex=-0.16)
    sip = tip + 0.6 + rng.uniform(0.9, 1.3)
    hands.hold(level, near, sip, sip + 0.5)
    script.keyed.rest(sip, 0.6, "neck_flex")
    script.now_s = sip + 0.3
    release = _put_down(script, hands, spot)
    prop = _table(spot, (0, int(release * FPS)), size.scale)
    return _solve_clip(script, "drink", obj, hands, (grasp, spot), (release, spot), (prop,))


def pull_chair(script: Script) -> ProceduralMotion:
    """Walk up behind a chair, grasp its back, pull it while stepping backward, and let go."""
    size, rng, side = script.size, script.rng, _side(script)
    out = 1.0 - 2.0 * side
    obj = Grip.furniture_piece(rng, ("chair",), (0.44, 0.43))
    grip = top_grip(size, side, obj)
    hands = Hands(script, (grip,))
    approach(script, rng.uniform(1.6, 2.0))
    rear = float(obj.merged()[0][:, 2].min())
    spot = _spot(script, out * 0.14 * size.scale, 0.0, 0.36 * size.scale - rear)
    grasp = _take(script, hands, spot, lower_m=0.2 * size.scale)
    move = -yaw_rotation(script.yaw_rad)[:, 2] * rng.uniform(0.6, 0.85)
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
    motion = _solve_clip(script, "pull_chair", obj, hands, (grasp, spot), (release, goal))
    assert motion.item_pose is not None
    off_floor_m = float(np.abs(motion.item_pose[:, 1, 3]).max())
    if off_floor_m > 2 * _REACHED_M:
        raise InputError(f"the chair leaves the floor by {1000 * off_floor_m:.0f} mm; draw the motion again")
    return motion


def carry_bag(script: Script) -> ProceduralMotion:
    """Walk about with a bag in one hand; it is never put down."""
    size, rng, side = script.size, script.rng, _side(script)
    obj = Grip.furniture_piece(rng, ("bag",), (0.36, 0.14))
    hands = Hands(script, (bag_grip(size, side, obj),))
    hands.carry(hands.off_shoulder(0.36, -0.92, 0.04, 0.92), -2.0, -1.0)
    for _ in range(2):
        bearing = rng.uniform(-0.6, 0.6)
        _walk_to(script, bearing, rng.uniform(1.8, 2.4), bearing + rng.uniform(-0.5, 0.5))
        script.wait(rng.uniform(0.5, 0.8))
    return _solve_clip(script, "carry_bag", obj, hands, (None, None), (None, None))


CARRIES: dict[str, Callable[[Script], ProceduralMotion]] = {
    "carry_from_floor": carry_from_floor,
    "carry_between": carry_between,
    "carry_box": carry_box,
    "drink": drink,
    "pull_chair": pull_chair,
    "carry_bag": carry_bag,
}


def act_carry(kind: str, body: ShapedBody, rng: np.random.Generator) -> ProceduralMotion:
    """A motion of one of the kinds in `CARRIES`, with the object that it moves.

    Raises:
        InputError: this draw does not work out (a hand does not reach the object, or it enters the body); try another.
    """
    return CARRIES[kind](Script.standing(measure(body), rng))
