"""Hands over time, and when they take something or put it down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.objects.changes import Change
from video2anim.objects.path import BOTH
from video2anim.types import BodyMotion
from video2anim.types.camera import Intrinsics
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

UP = np.array([0.0, 1.0, 0.0])
NEAR_M = 0.2
"""Maximum distance of a hand from the outline of a change, at the hand's depth: a hand's length."""
_HAND_M = 0.09
"""From the wrist to the middle of the hand."""
_STEADY_M = 0.06
"""Maximum standard deviation of the distance between two hands that hold one object."""
_SLACK = 2
"""Samples by which the moment may differ from that of the change: an object that moves slowly still overlaps its old
place."""


@dataclass(frozen=True, slots=True, eq=False)
class HandPath:
    """A hand, or the middle of both, in every frame."""

    person_id: int
    name: str
    T_world_hand: Float[np.ndarray, "frames 4 4"]
    """At the middle of the hand, with the wrist's axes."""
    pixels: Float[np.ndarray, "frames 2"]
    depth_m: Float[np.ndarray, "frames"]
    valid: Bool[np.ndarray, "frames"]


@dataclass(frozen=True, slots=True, eq=False)
class Grip:
    """A change that hands of a person caused by taking or putting down."""

    change: Change
    person_id: int
    hands: dict[str, HandPath]
    """Near hands, nearest first."""
    frames: dict[str, int]
    """Frame at which each is nearest."""

    def frame(self, name: str) -> int:
        """Frame of that hand; of a hand that is not near, the frame of the nearest."""
        return self.frames.get(name, next(iter(self.frames.values())))


def hands_of(motion: BodyMotion, lens: Intrinsics) -> list[HandPath]:
    """Left and right hand of a person in the images of a fixed camera."""
    joints_m, R = forward_kinematics(motion.R_parent_joint, motion.T_world_root[:, :3, 3], motion.rest_joints_m)
    found = []
    for side in ("left", "right"):
        wrist, elbow = (JOINT_INDEX[f"{side}_{name}"] for name in ("wrist", "elbow"))
        along = joints_m[:, wrist] - joints_m[:, elbow]
        T = np.tile(np.eye(4), (len(joints_m), 1, 1))
        T[:, :3, :3] = R[:, wrist]
        T[:, :3, 3] = joints_m[:, wrist] + _HAND_M * along / np.linalg.norm(along, axis=-1, keepdims=True)
        camera_m = transform_points(invert_rigid(motion.T_world_camera), T[:, None, :3, 3])[:, 0]
        valid = motion.valid & (camera_m[:, 2] > 0.1)
        pixels = project(np.where(valid[:, None], camera_m, [0, 0, 1.0]), lens)
        found.append(HandPath(motion.person_id, f"{side} hand", T, pixels, camera_m[:, 2], valid))
    return found


def reach(hands: Sequence[HandPath], lens: Intrinsics) -> Bool[np.ndarray, "height width"]:
    """Pixels within three hand lengths of a hand, where it may take or put down something."""
    near = np.zeros((lens.height_px, lens.width_px), np.uint8)
    for hand in hands:
        for (x, y), depth_m in zip(hand.pixels[hand.valid], hand.depth_m[hand.valid], strict=True):
            radius = round(3 * NEAR_M * lens.fx_px / depth_m)
            if -radius < x < lens.width_px + radius and -radius < y < lens.height_px + radius:
                cv2.circle(near, (round(x), round(y)), radius, 1, -1)
    return near > 0


def gaps_m(hand: HandPath, mask: Bool[np.ndarray, "height width"], lens: Intrinsics) -> Float[np.ndarray, "frames"]:
    """Image distance of a hand from an outline, at the hand's depth; infinite where the hand is not in the image."""
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    x, y = (hand.pixels[:, k].round() for k in (0, 1))
    inside = hand.valid & (x >= 0) & (x < lens.width_px) & (y >= 0) & (y < lens.height_px)
    found = np.full(len(hand.valid), np.inf)
    found[inside] = away[y[inside].astype(int), x[inside].astype(int)] * hand.depth_m[inside] / lens.fx_px
    return found


def grip(change: Change, hands: Sequence[HandPath], step: int, lens: Intrinsics) -> Grip | None:
    """The near hands of the nearest person during a change; None where there are none.

    Args:
        step: Frames from sample to sample of the change.
    """
    near: list[tuple[float, int, HandPath]] = []
    for hand in hands:
        span = slice(max((change.first - _SLACK) * step, 0), (change.last + _SLACK) * step + 1)
        gap_m = gaps_m(hand, change.mask, lens)[span]
        if len(gap_m) and gap_m.min() <= NEAR_M:
            close = span.start + np.flatnonzero(gap_m <= gap_m.min() + 0.1 * NEAR_M)
            near.append((float(gap_m.min()), int(close[0] if change.came else close[-1]), hand))
    if not near:
        return None
    near.sort(key=lambda one: one[0])
    person = near[0][2].person_id
    own = {hand.name: (hand, frame) for _, frame, hand in near if hand.person_id == person}
    return Grip(
        change, person, {name: hand for name, (hand, _) in own.items()}, {name: at for name, (_, at) in own.items()}
    )


def holders(grips: Sequence[Grip], first: int, last: int) -> dict[str, HandPath]:
    """The hands that may hold an object between two frames: both together where their distance is constant, else each
    that is near at one end."""
    found = {name: hand for one in grips for name, hand in one.hands.items()}
    if len(found) < 2 or not all(len(one.hands) == 2 for one in grips):
        return found
    left, right = (found[f"{side} hand"] for side in ("left", "right"))
    apart_m = (left.T_world_hand - right.T_world_hand)[first : last + 1, :3, 3]
    if np.linalg.norm(apart_m, axis=-1).std() > _STEADY_M:
        return found
    return {BOTH: _both(left, right)}


def _both(left: HandPath, right: HandPath) -> HandPath:
    """The middle of both hands, with the yaw of the line between them."""
    T = left.T_world_hand.copy()
    across = right.T_world_hand[:, :3, 3] - left.T_world_hand[:, :3, 3]
    yaw_rad = np.arctan2(-across[:, 2], across[:, 0])
    T[:, :3, :3] = matrix_from_axis_angle(yaw_rad[:, None] * UP)
    T[:, :3, 3] += 0.5 * across
    pixels, depth_m = 0.5 * (left.pixels + right.pixels), 0.5 * (left.depth_m + right.depth_m)
    return HandPath(left.person_id, BOTH, T, pixels, depth_m, left.valid & right.valid)
