"""The fitted bodies in the world: floor under the main person's feet, +Y up, and one motion per person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import CHUNK_FRAMES
from video2anim.geometry.projection import transform_points
from video2anim.humans.ground import floor_height, level_frame
from video2anim.humans.lifter_input import CONTACT_INDEX, LiftedBody
from video2anim.humans.problem import FittedBody
from video2anim.humans.support import with_support
from video2anim.types import BodyMotion, CameraEstimate, PersonTrack
from video2anim.types.skeleton import forward_kinematics


def world_poses(
    fit: FittedBody,
    valid: Bool[np.ndarray, "frames"],
    up_camera: Float[np.ndarray, "3"],
    T_first_camera: Float[np.ndarray, "frames 4 4"],
    fps: float,
) -> tuple[Float[np.ndarray, "frames 4 4"], float]:
    """Camera poses in the world, and the spread of the floor's height in meters.

    The floor of the person is at y = 0, and the first valid root above the origin. `T_first_camera` is in meters.
    """
    T_world_camera = T_first_camera.copy()
    T_world_camera[:, :3] = level_frame(up_camera) @ T_first_camera[:, :3]
    root_m = transform_points(T_world_camera, fit.joints_camera_m[:, :1])[:, 0]
    lowest_m = _lowest_heights(fit, T_world_camera[:, :3, :3]) + T_world_camera[:, 1, 3]
    floor_m, spread_m = floor_height(lowest_m[valid], fps)
    first = int(np.flatnonzero(valid)[0])
    T_world_camera[:, :3, 3] -= [root_m[first, 0], floor_m, root_m[first, 2]]
    return T_world_camera, spread_m


def _lowest_heights(fit: FittedBody, R_world_camera: np.ndarray) -> Float[np.ndarray, "frames"]:
    """Height of the lowest point of the skin above the camera."""
    body = shaped_body(fit.shape)
    R_parent_joint, translation_m = _turned(fit, R_world_camera)
    joints, R_world_joint = forward_kinematics(R_parent_joint, translation_m, body.rest_joints_m)
    heights = np.empty(len(joints))
    for begin in range(0, len(joints), CHUNK_FRAMES):
        some = slice(begin, begin + CHUNK_FRAMES)
        heights[some] = body.vertices(R_world_joint[some], joints[some])[..., 1].min(1)
    return heights


def _turned(
    fit: FittedBody, R_world_camera: np.ndarray
) -> tuple[Float[np.ndarray, "frames 22 3 3"], Float[np.ndarray, "frames 3"]]:
    """Rotations and translation of the body along the world's axes, about the camera."""
    R_parent_joint = fit.R_parent_joint.copy()
    R_parent_joint[:, 0] = R_world_camera @ R_parent_joint[:, 0]
    return R_parent_joint, np.einsum("tab,tb->ta", R_world_camera, fit.translation_camera_m)


def world_motion(
    fit: FittedBody,
    lifted: LiftedBody,
    track: PersonTrack,
    camera: CameraEstimate,
    T_world_camera: Float[np.ndarray, "frames 4 4"],
    frame_time_s: Float[np.ndarray, "frames"],
    fps: float,
) -> BodyMotion:
    """One person's motion, with the contacts of the lifter and, where it has none, those of what carries the body."""
    frames = len(frame_time_s)
    R_parent_joint, translation_m = _turned(fit, T_world_camera[:, :3, :3])
    blank = BodyMotion(
        person_id=track.person_id,
        frame_time_s=frame_time_s,
        valid=track.valid,
        T_world_root=T_world_camera,
        R_parent_joint=R_parent_joint,
        T_world_camera=T_world_camera,
        intrinsics=camera.intrinsics,
        contact=np.zeros((frames, 22)),
        shape=fit.shape,
        rest_joints_m=fit.rest_joints_m,
        joints_world_m=np.zeros((frames, 22, 3)),
    )
    translation_m = translation_m + T_world_camera[:, :3, 3]
    posed = blank.with_pose(translation_world_m=translation_m, R_parent_joint=R_parent_joint)
    contact = np.zeros((frames, 22))
    contact[:, CONTACT_INDEX] = lifted.contact * track.valid[:, None]
    touching = replace(posed, contact=contact)
    return replace(touching, contact=with_support(touching, fps))
