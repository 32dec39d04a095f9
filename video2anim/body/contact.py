"""Contact of body parts: skin vertices of a part, speed of joints, and which parts touch the scene or the own body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from video2anim.body.shaped_body import CHUNK_FRAMES, ShapedBody
from video2anim.geometry.moving_field import MovingField
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.motion import BodyMotion
from video2anim.types.skeleton import FEET, JOINT_INDEX, TOUCHING_PARTS, forward_kinematics

LIKELY = 0.5
"""Contact probability above which a part counts as in contact."""
NEAR_M = 0.03
"""Skin this near to a surface touches it. It is the error of a body fitted to a video at best."""
REACH_M = 0.25
"""A part in contact that is farther than this from every surface touches something that the scene lacks."""
SLOW_M_S = 0.4
"""A part in contact is slower than this. After the solve a standing foot is below 0.1 m/s, a swinging one above 1."""
_SLOW_SEEN_M_S = 0.6
"""The same limit before the solve: landmarks of a resting part still move by 0.2 to 0.5 m/s across the line of sight,
and more along it, which a single camera measures badly and which is not counted."""
_WINDOW_FRAMES = 2
"""Speed is measured over this many frames before and after (0.13 s in total). Single steps contain the jitter of the
estimate; over a longer time feet that have just landed would count as moving."""
_STRIDE = 3
"""Every third vertex of a part is tested; they are 1 to 2 cm apart."""


def posed_vertices(
    motion: BodyMotion, body: ShapedBody, index: Int[np.ndarray, "chosen"] | None, frames: Int[np.ndarray, "some"]
) -> Float[np.ndarray, "some chosen 3"]:
    """World positions of some vertices (None: all) in some frames, meters."""
    joints_m, R_world_joint = forward_kinematics(
        motion.R_parent_joint[frames], motion.T_world_root[frames, :3, 3], motion.rest_joints_m
    )
    return body.vertices(R_world_joint, joints_m, index).astype(np.float64)


def lowest_points(
    motion: BodyMotion, body: ShapedBody, frames: Int[np.ndarray, "some"]
) -> tuple[Int[np.ndarray, "some"], Float[np.ndarray, "some 3"]]:
    """Number and world position of the lowest vertex of the skin in some frames."""
    index, points_m = np.empty(len(frames), int), np.empty((len(frames), 3))
    for begin in range(0, len(frames), CHUNK_FRAMES):
        some = slice(begin, begin + CHUNK_FRAMES)
        skin_m = posed_vertices(motion, body, None, frames[some])
        index[some] = skin_m[..., 1].argmin(1)
        points_m[some] = skin_m[np.arange(len(skin_m)), index[some]]
    return index, points_m


def skin_of(body: ShapedBody, joints: tuple[int, ...]) -> Int[np.ndarray, "vertices"]:
    """Every third vertex of the skin that moves with the given joints."""
    return np.flatnonzero(np.isin(body.vertex_part, joints))[::_STRIDE]


def speed_m_s(motion: BodyMotion, joint: int, *, across_sight: bool = False) -> Float[np.ndarray, "frames"]:
    """Speed of a joint over 0.13 s around each frame.

    Args:
        across_sight: leave out motion along the line of sight, which one camera sees badly.
    """
    path_m = motion.joints_world_m[:, joint].astype(np.float64)
    frame = np.arange(len(path_m))
    first, last = np.maximum(frame - _WINDOW_FRAMES, 0), np.minimum(frame + _WINDOW_FRAMES, len(path_m) - 1)
    way_m = path_m[last] - path_m[first]
    if across_sight:
        sight_m = path_m - motion.T_world_camera[:, :3, 3]
        sight = sight_m / np.maximum(np.linalg.norm(sight_m, axis=-1, keepdims=True), 1e-9)
        way_m = way_m - (way_m * sight).sum(-1, keepdims=True) * sight
    time_s = np.maximum(motion.frame_time_s[last] - motion.frame_time_s[first], 1e-3)
    return np.linalg.norm(way_m, axis=-1) / time_s


def believed(motion: BodyMotion, body: ShapedBody) -> Float[np.ndarray, "frames 22"]:
    """Contact probability of an observed motion, set to 0 for parts that move fast and hands on the own body."""
    contact = np.where(motion.valid[:, None], motion.contact, 0.0)
    for name, joints in TOUCHING_PARTS.items():
        flies = speed_m_s(motion, joints[0], across_sight=True) > _SLOW_SEEN_M_S
        contact[np.ix_(flies, np.array(joints))] = 0.0
        if name.endswith("hand"):
            frames = np.flatnonzero(contact[:, joints[0]] > LIKELY)
            contact[frames[on_own_body(motion, body, joints[0], frames)], joints[0]] = 0.0
    return contact


def on_own_body(
    motion: BodyMotion, body: ShapedBody, joint: int, frames: Int[np.ndarray, "some"]
) -> Bool[np.ndarray, "some"]:
    """Whether a hand rests on the body (legs, trunk, or the other arm and hand) in each of some frames.

    Args:
        motion: The motion.
        body: Its body.
        joint: Index of `left_wrist` or `right_wrist`.
        frames: Frames to test.
    """
    side = "left" if joint == JOINT_INDEX["left_wrist"] else "right"
    arm = [JOINT_INDEX[f"{side}_{name}"] for name in ("collar", "shoulder", "elbow", "wrist")]
    own = skin_of(body, (joint,))
    rest = np.flatnonzero(~np.isin(body.vertex_part, arm))[::_STRIDE]
    skin_m = posed_vertices(motion, body, np.concatenate([own, rest]), frames)
    gaps_m = [KDTree(one[len(own) :]).query(one[: len(own)])[0].min() for one in skin_m]
    return np.array(gaps_m) < NEAR_M if gaps_m else np.zeros(0, bool)


def touches(
    motion: BodyMotion,
    body: ShapedBody,
    scene: SdfGrid,
    likely: Float[np.ndarray, "frames 22"],
    moving: Sequence[MovingField] = (),
) -> Float[np.ndarray, "frames 22"]:
    """Contact of a motion with its scene: 1 where a part is within 3 cm of a surface and slow, else 0.

    For feet in synthetic clips this is as good as the image alone (F1 0.94 to 0.97). The scene alone is worse (0.86 to
    0.93), because it counts feet that are about to land.

    Args:
        motion: The motion in the world of the scene.
        body: Its body.
        scene: Signed distance field of the scene.
        likely: Contact probability from the image. In measured frames a joint (heel and toes separately) touches only
            where it is likely. In other frames feet that are near and slow touch.
        moving: Fields of objects that somebody moves, which the field of the scene does not contain.
    """
    frames = np.arange(motion.frame_count)
    contact = np.zeros(likely.shape)
    for joints in TOUCHING_PARTS.values():
        skin_m = posed_vertices(motion, body, skin_of(body, joints), frames)
        gaps_m = [field.sample(skin_m).min(1) for field in (scene, *moving)]
        near = np.abs(np.min(gaps_m, axis=0)) < NEAR_M
        for joint in joints:
            told = (likely[:, joint] > LIKELY) | (~motion.valid & (joint in FEET))
            contact[:, joint] = near & (speed_m_s(motion, joint) < SLOW_M_S) & told
    return contact
