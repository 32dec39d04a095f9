"""How a hand holds an object, and the goals that bring hands to it, move with it and leave it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.errors import InputError
from video2anim.lab.synth.acting.curves import yaw_rotation
from video2anim.lab.synth.acting.finish import probes
from video2anim.lab.synth.acting.measure import BodyMeasure
from video2anim.lab.synth.acting.perform import SolvedMotion
from video2anim.lab.synth.acting.script import HandGoal, Script
from video2anim.lab.synth.render.caster import RayCaster
from video2anim.lab.synth.rooms import make_furniture
from video2anim.lab.synth.rooms.clearance import penetration_m
from video2anim.lab.synth.rooms.decor import scaled_into
from video2anim.lab.synth.world import SceneObject

_PALM_M = (0.095, 0.034, 0.012)
"""Center of an average adult's palm from the wrist: along the fingers, out of the palm, towards the thumb."""
_FINGERS_M = 0.046
"""Distance from the wrist's plane, out of the palm, of a flat side that bent fingers rest on."""
_SLIP_M, _THROUGH_M = 0.0008, 0.01
"""Largest motion of a second hand relative to the object, and largest penetration of the object by the body."""
_SIDE_ELBOW = (0.7, -0.7, -0.4)


@dataclass(frozen=True, slots=True, eq=False)
class Grip:
    """Pose of the hand in the frame of the object, whose +Z is the person's heading."""

    side: int
    """0 left, 1 right."""
    R_hand: Float[np.ndarray, "3 3"]
    offset_m: Float[np.ndarray, "3"]
    """Wrist relative to the object's origin."""
    yaw_rad: float = 0.0
    """Heading of the object minus the person's while it is carried."""

    @property
    def T_hand_object(self) -> Float[np.ndarray, "4 4"]:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R_hand, self.offset_m
        return np.linalg.inv(T)

    @staticmethod
    def furniture_piece(
        rng: np.random.Generator, labels: tuple[str, ...], size_m: tuple[float, float], height_m: float | None = None
    ) -> SceneObject:
        """An object of one of the labels with about the footprint `size_m` (width, depth)."""
        label = labels[int(rng.integers(len(labels)))]
        if label == "box":
            return make_furniture("box", rng, size_m=size_m, surface_height_m=height_m or 1.1 * size_m[0])
        if label == "chair":
            return make_furniture("chair", rng, size_m=size_m)
        return scaled_into(make_furniture(label, rng), size_m)


def fingers(side: int, inward_rad: float, droop_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotation of a hand in the heading frame; the palm faces the body's center plane, fingers turned inward and
    down."""
    out = 1.0 - 2.0 * side
    level = np.cos(droop_rad)
    along = np.array([-out * np.sin(inward_rad) * level, -np.sin(droop_rad), np.cos(inward_rad) * level])
    back = out * np.cross([0.0, 1.0, 0.0], along)
    back /= np.linalg.norm(back)
    x = out * along
    return np.stack([x, back, np.cross(x, back)], -1)


def side_grip(
    size: BodyMeasure, side: int, obj: SceneObject, *, inward_rad: float, droop_rad: float,
    above_m: float | None = None, flat: bool = False,
) -> Grip:  # fmt: skip
    """The palm on a side of the object, `above_m` over its underside (0.6 of its height if None). `flat`: a large
    side."""
    R = fingers(side, inward_rad, droop_rad)
    vertices, faces = obj.merged()
    grip_m = 0.6 * float(np.ptp(vertices[:, 1])) if above_m is None else above_m
    grip_m = min(grip_m, 0.16)  # a vase is held below its flowers
    out = R[:, 1]
    far = np.array([0.0, grip_m, 0.0]) + out
    hit = RayCaster(vertices, faces).first_hits(far[None], -out[None])
    half_m = 1.0 - float(hit.distance[0])
    along, deep, thumb = np.array(_PALM_M) * size.scale
    deep = _FINGERS_M * size.scale if flat else deep
    palm = R @ np.array([(1.0 - 2.0 * side) * along, -deep, thumb])
    return Grip(side, R, np.array([0.0, grip_m, 0.0]) + out * half_m - palm)


def top_grip(size: BodyMeasure, side: int, obj: SceneObject) -> Grip:
    """The palm down on the top of a chair's back, near its center; the chair faces away from the person."""
    vertices, _ = obj.merged()
    out = 1.0 - 2.0 * side
    center = vertices[np.abs(vertices[:, 0]) < 0.1]
    center = vertices if len(center) == 0 else center
    top = center[center[:, 1] > center[:, 1].max() - 0.015]
    along = np.array([-out * 0.25, -0.35, 1.0])
    x = out * along / np.linalg.norm(along)
    z = np.cross(x, [0.0, 1.0, 0.0])
    z /= np.linalg.norm(z)
    R = np.stack([x, np.cross(z, x), z], -1)
    forth, deep, thumb = np.array(_PALM_M) * size.scale
    palm = R @ np.array([out * forth, -deep, thumb])
    return Grip(side, R, np.array([0.0, top[:, 1].max(), top[:, 2].mean()]) - palm)


def bag_grip(size: BodyMeasure, side: int, obj: SceneObject) -> Grip:
    """A bag's handle in the hanging hand; the bag's long side is parallel to the heading."""
    R = fingers(side, 0.0, 1.35)
    vertices, _ = obj.merged()
    out = 1.0 - 2.0 * side
    forth, deep, thumb = np.array((_PALM_M[0] + 0.05, _FINGERS_M - 0.006, _PALM_M[2])) * size.scale
    palm = R @ np.array([out * forth, -deep, thumb])
    quarter = yaw_rotation(-np.pi / 2)
    offset = np.array([0.0, float(vertices[:, 1].max()) - 0.008, 0.0]) - palm
    return Grip(side, quarter @ R, quarter @ offset, np.pi / 2)


class Hands:
    """The goals of the hands that hold one object, in order of time; each replaces the one before it. Times in
    seconds."""

    def __init__(self, script: Script, grips: tuple[Grip, ...]) -> None:
        self._script, self.grips = script, grips
        self._own_goals: list[HandGoal] = []

    @property
    def wrist_over_m(self) -> float:
        """Height of the wrists over the underside of the object."""
        return float(self.grips[0].offset_m[1])

    def at(self, T_world_object: Float[np.ndarray, "4 4"], start_s: float, full_s: float) -> None:
        """The hands hold an object at a world pose."""
        for grip in self.grips:
            wrist = T_world_object[:3, :3] @ grip.offset_m + T_world_object[:3, 3]
            self._add(grip.side, start_s, full_s, wrist, "world", T_world_object[:3, :3] @ grip.R_hand)

    def beside(
        self, T_world_object: Float[np.ndarray, "4 4"], start_s: float, full_s: float, *, out_m: float, up_m: float,
        back_m: float = 0.0,
    ) -> None:  # fmt: skip
        """As `at`, but the palm is `out_m` off the object, `up_m` higher and `back_m` nearer to the body."""
        scale = self._script.size.scale
        for grip in self.grips:
            R = T_world_object[:3, :3] @ grip.R_hand
            wrist = T_world_object[:3, :3] @ grip.offset_m + T_world_object[:3, 3]
            away = out_m * R[:, 1] * (1.0, 0.3, 1.0) + np.array([0.0, up_m, 0.0])
            away -= back_m * T_world_object[:3, 2]
            self._add(grip.side, start_s, full_s, wrist + scale * away, "world", R)

    def off_shoulder(self, out: float, up: float, ahead: float, share: float) -> Float[np.ndarray, "3"]:
        """Left wrist relative to the pelvis in the heading frame: `share` of the arm's length from the shoulder."""
        size = self._script.size
        aim = np.array([out, up, ahead])
        return size.rest_m[16] + share * size.arm_m * aim / np.linalg.norm(aim)

    def carry(self, left_wrist_m: Float[np.ndarray, "3"], start_s: float, full_s: float) -> None:
        """The hands carry the object. `left_wrist_m`: left wrist relative to the pelvis in the heading frame."""
        for grip in self.grips:
            wrist = left_wrist_m * (1.0 - 2.0 * grip.side, 1.0, 1.0)
            self._add(grip.side, start_s, full_s, wrist, "body", yaw_rotation(grip.yaw_rad) @ grip.R_hand)

    def hold(
        self,
        R_heading_object: Float[np.ndarray, "3 3"],
        object_m: Float[np.ndarray, "3"],
        start_s: float,
        full_s: float,
    ) -> None:
        """The hands hold the object at this pose relative to the pelvis in the heading frame."""
        for grip in self.grips:
            wrist = R_heading_object @ grip.offset_m + object_m
            self._add(grip.side, start_s, full_s, wrist, "body", R_heading_object @ grip.R_hand)

    def slide(self, start_s: float, end_s: float, move_m: Float[np.ndarray, "3"]) -> None:
        """The last goal moves by `move_m` (world) between two times."""
        for goal in self._own_goals[-len(self.grips) :]:
            goal.slide = (start_s, end_s, move_m)

    def free(self, leave_s: float, end_s: float) -> None:
        """The last goals fade out between two times; the goals before them end a moment earlier."""
        last = self._own_goals[-len(self.grips) :]
        for goal in self._own_goals:
            goal.leave_s, goal.end_s = (leave_s, end_s) if goal in last else (last[0].touch_s, last[0].touch_s + 0.02)

    def wrist_error_m(self, done: SolvedMotion, frame: int) -> float:
        """Largest distance of a wrist to its goal at a frame, meters."""
        return max(
            float(np.linalg.norm(done.joints_m[frame, 20 + side] - goal)) for side, goal in self._goals(done, frame)
        )

    def reach_ratio(self, done: SolvedMotion, frame: int) -> float:
        """Largest distance of a goal to its shoulder at a frame, over the length of the arm."""
        arm_m = self._script.size.arm_m
        return max(
            float(np.linalg.norm(done.joints_m[frame, 16 + side] - goal)) / arm_m
            for side, goal in self._goals(done, frame)
        )

    def _goals(self, done: SolvedMotion, frame: int) -> list[tuple[int, Float[np.ndarray, "3"]]]:
        """Side and world position of the last world goal of each wrist that has begun by a frame."""
        at_s, out = done.t[frame], []
        for grip in self.grips:
            goal = [g for g in self._own_goals if g.side == grip.side and g.touch_s <= at_s and g.frame == "world"][-1]
            moved = goal.slide is not None and at_s >= goal.slide[1]
            out.append((grip.side, goal.offset_m + goal.slide[2] if goal.slide and moved else goal.offset_m))
        return out

    def _add(self, side: int, start_s: float, full_s: float, wrist: np.ndarray, frame: str, R: np.ndarray) -> None:
        goal = HandGoal(side, start_s, full_s, 1e8, 1e9, wrist, frame, R, _SIDE_ELBOW)  # pyright: ignore[reportArgumentType]
        self._own_goals.append(goal)
        self._script.hands.append(goal)


def object_in(done: SolvedMotion, hands: Hands, frames: slice) -> Float[np.ndarray, "frames 4 4"]:
    """World poses of an object that is rigid with the first of the hands."""
    grip = hands.grips[0]
    wrist = 20 + grip.side
    T = np.broadcast_to(np.eye(4), (len(done.t[frames]), 4, 4)).copy()
    T[:, :3, :3], T[:, :3, 3] = done.R_world_joint[frames, wrist], done.joints_m[frames, wrist]
    return T @ grip.T_hand_object


def expect_plausible(
    script: Script, done: SolvedMotion, hands: Hands, obj: SceneObject, pose: Float[np.ndarray, "frames 4 4"],
    held: range,
) -> None:  # fmt: skip
    """Check that no hand slips on the object and that the object does not enter the body in the frames `held`.

    Raises:
        InputError: a hand slips by more than 0.8 mm, or the object is more than 1 cm inside the body.
    """
    for grip in hands.grips[1:]:
        wrist_m = done.joints_m[held.start : held.stop, 20 + grip.side]
        own = pose[held.start : held.stop, :3, :3] @ grip.offset_m + pose[held.start : held.stop, :3, 3] - wrist_m
        slip_m = float(np.linalg.norm(own, axis=1).max())
        if slip_m > _SLIP_M:
            raise InputError(f"a hand slips by {1000 * slip_m:.1f} mm on the {obj.label}; draw the motion again")
    frames = np.arange(0, len(pose), 4)
    body = ~np.isin(script.size.probe_part, [20 + grip.side for grip in hands.grips])
    skin = probes(done, script.size, frames)[:, body]
    local = (skin - pose[frames, None, :3, 3]) @ pose[frames, :3, :3]
    deepest_m = float(penetration_m([obj.moved(np.eye(4))], local.reshape(-1, 3)).max())
    if deepest_m > _THROUGH_M:
        raise InputError(f"the {obj.label} goes {100 * deepest_m:.1f} cm into the body; draw the motion again")
