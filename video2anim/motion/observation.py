"""The observed motion as input of the final solve: poses, contacts, and image positions of the joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from scenemi.postprocess.motion_solve import TRUNK, PictureTarget, SceneMotion
from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import believed
from video2anim.geometry.projection import invert_rigid, project
from video2anim.objects.path import holding
from video2anim.types import BodyMotion, PlacedObject
from video2anim.types.clip import FPS

_JUMP = 6.0
"""Frames whose jerk exceeds the usual one by this factor are jumps of the observation."""
_WALKING_M_S3 = 60.0
"""Mean jerk of the joints of people who walk, by stage humans: medians of `00_walk`, `02_step_up`, `07_walk` and
`12_turn` of V2A-Bench 51 to 64. Who stands still for most of a clip may walk in the rest. With 115, as of the walks on
real clips with truth, W-MPJPE on V2A-Bench is 82.9 instead of 82.5 mm: frames that do jump are taken for walking."""


def observation(motion: BodyMotion, objects: Sequence[PlacedObject]) -> SceneMotion:
    """The motion after stage keyframes, which moved it along lines of sight only, with its joints in the image; where
    the body jumps, with those of the trunk, which are on its axis and so the same with left and right, or front and
    back, exchanged. Hands that hold an object touch no solid."""
    shaped = shaped_body(motion.shape)
    camera_m = motion.joints_camera_m
    body_height_m = float(np.ptp(shaped.rest_vertices_m[:, 1]))
    seen = np.repeat(inlier_frames(motion)[:, None], camera_m.shape[1], axis=1)
    seen[:, TRUNK] = motion.valid[:, None]
    picture = PictureTarget(
        project(camera_m, motion.intrinsics), seen & (camera_m[:, :1, 2] > 0.1),
        motion.intrinsics.fy_px * body_height_m / np.maximum(camera_m[:, 0, 2], 0.1),
        invert_rigid(motion.T_world_camera), motion.intrinsics.matrix(),
    )  # fmt: skip
    contact = np.where(holding(objects, motion), 0.0, believed(motion, shaped))
    fixed = np.zeros(motion.frame_count, bool)
    return SceneMotion(
        motion.R_parent_joint, motion.T_world_root[:, :3, 3], contact, motion.rest_joints_m, shaped, FPS, fixed, picture
    )


def inlier_frames(motion: BodyMotion) -> Bool[np.ndarray, "frames"]:
    """Valid frames in which the observed body does not jump: where the landmark model flips left and right, or front
    and back, the jerk is many times the clip's median and that of walking."""
    calm = motion.valid.copy()
    jerk_m_s3 = np.linalg.norm(np.diff(motion.joints_world_m, n=3, axis=0), axis=-1).mean(1) * FPS**3
    seen = np.convolve(motion.valid, np.ones(4), "valid") == 4
    if not seen.any():
        return calm
    usual_m_s3 = max(float(np.median(jerk_m_s3[seen])), _WALKING_M_S3)
    for first in np.flatnonzero(seen & (jerk_m_s3 > _JUMP * usual_m_s3)):
        calm[first : first + 4] = False
    # Motion that is jerky throughout is used as observed.
    return calm if calm.sum() > 0.5 * motion.valid.sum() else motion.valid


def image_distance_ratio(motion: BodyMotion, seen: BodyMotion) -> Float[np.ndarray, "valid"]:
    """Mean image distance of the joints of two motions of one person over the standing body's height in the image, per
    valid frame."""
    body_height_m = float(np.ptp(shaped_body(seen.shape).rest_vertices_m[:, 1]))
    valid = motion.valid & seen.valid
    here, there = (one.joints_camera_m[valid] for one in (motion, seen))
    apart_px = np.linalg.norm(project(here, motion.intrinsics) - project(there, seen.intrinsics), axis=-1).mean(1)
    return apart_px * np.maximum(there[:, 0, 2], 0.1) / (seen.intrinsics.fy_px * body_height_m)
