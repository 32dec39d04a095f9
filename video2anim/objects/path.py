"""Paths of carried objects: they follow the hand after the body has been moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.projection import invert_rigid
from video2anim.geometry.rotations import matrix_from_axis_angle, matrix_from_quaternion, quaternion_from_matrix, slerp
from video2anim.types.motion import BodyMotion
from video2anim.types.scene import Hold, PlacedObject
from video2anim.types.skeleton import JOINT_INDEX, TOUCHING_PARTS, forward_kinematics

BOTH = "both hands"
_HANDS = ("left hand", "right hand")
BLEND_FRAMES = 5
"""Frames (0.17 s) of the transition between rest and hand."""
_SURE_M = 0.1
"""Horizontal distance of the hands below which their yaw is down-weighted."""


def follow_hand(placed: PlacedObject, before: Sequence[BodyMotion], after: Sequence[BodyMotion]) -> PlacedObject:
    """The object with its path adapted to bodies that have been moved.

    While it is held it keeps its pose in the hand; while it rests it stays in place; the transition lies within the
    hold. An object in both hands follows their middle and the yaw of the line between them.

    Args:
        placed: the object; without a path it is returned as it is.
        before: the motions that its path was found with.
        after: the moved ones; people who are in one of both only are ignored.
    """
    if not placed.path:
        return placed
    (path,) = placed.path
    known = {motion.person_id: motion for motion in before}
    moved = {motion.person_id: motion for motion in after}
    T_before = np.asarray(path.T_world_object, np.float64)
    T_world_object, way = T_before.copy(), np.eye(4)
    holds = [hold for hold in path.holds if hold.person_id in known and hold.person_id in moved]
    for number, hold in enumerate(holds):
        taken_over = number > 0 and holds[number - 1].last_frame + 1 >= hold.first_frame
        handed_on = number + 1 < len(holds) and holds[number + 1].first_frame <= hold.last_frame + 1
        frames = slice(hold.first_frame, hold.last_frame + 1)
        # The pose before the hold: at rest, or in the hand before.
        start = (way if taken_over else np.eye(4)) @ T_before[frames]
        ways = _hand_ways(known[hold.person_id], moved[hold.person_id], hold)
        held = ways @ T_before[frames]
        share = _shares(len(held), rises=hold.first_frame > 0)
        T_world_object[frames] = _blended(start, held, share)
        if hold.last_frame + 1 < len(T_before) and not handed_on:
            falls = _shares(len(held), rises=True)[::-1]
            T_world_object[frames] = _blended(T_before[frames], T_world_object[frames], falls)
        way = ways[-1]
    return replace(placed, T_world_object=T_world_object[0], path=(replace(path, T_world_object=T_world_object),))


def settled(placed: PlacedObject) -> PlacedObject | None:
    """The object at rest, if it rests in one place for more than half of the clip; else None."""
    if not placed.path:
        return placed
    T = placed.path[0].T_world_object
    starts = np.flatnonzero(np.concatenate([[True], np.abs(np.diff(T, axis=0)).max((1, 2)) > 0, [True]]))
    longest = int(np.diff(starts).argmax())
    if 2 * (starts[longest + 1] - starts[longest]) <= len(T):
        return None
    return replace(placed, T_world_object=T[starts[longest]], path=())


def holding(objects: Sequence[PlacedObject], motion: BodyMotion) -> Bool[np.ndarray, "frames 22"]:
    """Joints of a person's hands that hold an object."""
    held = np.zeros(motion.contact.shape, bool)
    for hold in (hold for placed in objects for hold in placed.holds if hold.person_id == motion.person_id):
        for part in _HANDS if hold.hand == BOTH else (hold.hand,):
            held[hold.first_frame : hold.last_frame + 1, list(TOUCHING_PARTS[part])] = True
    return held


def _hand_ways(before: BodyMotion, after: BodyMotion, hold: Hold) -> Float[np.ndarray, "held 4 4"]:
    """Rigid transforms that move an object with the hand from one motion to the other, by frame of the hold."""
    frames = slice(hold.first_frame, hold.last_frame + 1)
    joints = [
        forward_kinematics(motion.R_parent_joint[frames], motion.T_world_root[frames, :3, 3], motion.rest_joints_m)
        for motion in (before, after)
    ]
    left, right = (JOINT_INDEX[f"{side}_wrist"] for side in ("left", "right"))
    T_world_hand = np.tile(np.eye(4), (2, len(joints[0][0]), 1, 1))
    if hold.hand != BOTH:
        wrist = left if hold.hand == _HANDS[0] else right
        for own, (joints_m, R_world_joint) in zip(T_world_hand, joints, strict=True):
            own[:, :3, :3], own[:, :3, 3] = R_world_joint[:, wrist], joints_m[:, wrist]
    else:
        apart_m = np.stack([joints_m[:, left] - joints_m[:, right] for joints_m, _ in joints])
        yaw_rad = np.arctan2(-apart_m[..., 2], apart_m[..., 0])
        sure = np.clip(np.linalg.norm(apart_m[..., [0, 2]], axis=-1).min(0) / _SURE_M, 0.0, 1.0)
        turn_rad = sure * ((yaw_rad[1] - yaw_rad[0] + np.pi) % (2 * np.pi) - np.pi)
        T_world_hand[1, :, :3, :3] = matrix_from_axis_angle(turn_rad[:, None] * np.array([0.0, 1.0, 0.0]))
        for own, (joints_m, _) in zip(T_world_hand, joints, strict=True):
            own[:, :3, 3] = 0.5 * (joints_m[:, left] + joints_m[:, right])
    return T_world_hand[1] @ invert_rigid(T_world_hand[0])


def _shares(count: int, *, rises: bool) -> Float[np.ndarray, "frames"]:
    """Weight of the hand at each frame of a hold: from 0 before the first to 1 at the sixth; all 1 without a rise."""
    if not rises:
        return np.ones(count)
    share = np.clip((1.0 + np.arange(count)) / (BLEND_FRAMES + 1), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def _blended(
    T_a: Float[np.ndarray, "frames 4 4"], T_b: Float[np.ndarray, "frames 4 4"], share: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "frames 4 4"]:
    """Poses interpolated between two; a share of 1 gives the second exactly."""
    T = T_b.copy()
    some = share < 1.0
    weight = share[some, None]
    a, b = (quaternion_from_matrix(one[some, :3, :3]) for one in (T_a, T_b))
    T[some, :3, :3] = matrix_from_quaternion(slerp(a, b, weight))
    T[some, :3, 3] = T_a[some, :3, 3] + weight * (T_b[some, :3, 3] - T_a[some, :3, 3])
    return T
