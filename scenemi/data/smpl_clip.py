"""Motions given as SMPL, SMPL-H or SMPL-X parameters, without the files of those bodies.

The pose parameters of all three begin with the 22 joints. What needs the body files is missing: the true rest joints
of the subject's shape. In their place stands the middle adult of our own body, scaled so that its standing feet reach
the floor of the data where there is one. The pelvis is put where SMPL has it for a mean shape, so heights are right
to one or two centimeters for the mean shape; limb lengths are our body's.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from scenemi.data.import_clip import at_fps, on_floor, with_glitches
from scenemi.data.source_clip import SourceClip, SourceSkeleton
from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.body.smplx_body import MEAN_PELVIS_M
from video2anim.errors import InputError
from video2anim.geometry.rotations import continuous_quaternions, matrix_from_axis_angle, quaternion_from_matrix
from video2anim.types import BodyShape
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS, forward_kinematics

SmplModel = Literal["smpl", "smplh", "smplx"]
PELVIS_M = MEAN_PELVIS_M
"""The translation parameter moves the origin of the model's own frame, so the pelvis lies here off it."""
R_Y_UP_Z_UP: np.ndarray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SCALES = (0.85, 1.15)
"""Sizes of people over the middle adult's: 1.45 to 1.95 m."""
_TOE_CLEARANCE_M = 0.02
"""Toe joint above the sole (0.02 to 0.045 m in captured clips)."""
_SLOW_M_S = 0.15
"""A toe slower than this may stand (not measured)."""


def smpl_clip(
    axis_angle_rad: Float[np.ndarray, "frames 66"],
    translation_m: Float[np.ndarray, "frames 3"],
    *,
    name: str,
    source: str,
    fps: float,
    model: SmplModel,
    T_world_data: Float[np.ndarray, "4 4"] | None = None,
    has_floor: bool = True,
    kind: str = "unknown",
) -> SourceClip:
    """A clip at 30 fps on a skeleton of the 22 SMPL joints.

    Args:
        axis_angle_rad: root orientation and 21 local rotations.
        translation_m: the translation parameter.
        name: of the clip.
        source: collection.
        fps: of the data.
        model: whose parameters these are.
        T_world_data: from the data's frame to a world with +Y up, floor near y = 0.
        has_floor: y = 0 is the floor; the skeleton is scaled to it. Else the floor is found below the feet.
        kind: kind of motion.

    Raises:
        InputError: wrong shapes, numbers that are not finite, or no frames.
    """
    pose = np.asarray(axis_angle_rad, float)
    shift_m = np.asarray(translation_m, float)
    if pose.ndim != 2 or pose.shape[1] != 66 or shift_m.shape != (len(pose), 3) or len(pose) == 0:
        raise InputError(f"{name}: want poses (T, 66) and translations (T, 3), got {pose.shape} and {shift_m.shape}")
    if not np.isfinite(pose).all() or not np.isfinite(shift_m).all() or not fps > 0:
        raise InputError(f"{name}: poses, translations or frame rate hold NaN or are out of range; leave the clip out")
    T = np.eye(4) if T_world_data is None else T_world_data
    R_parent_joint = matrix_from_axis_angle(pose.reshape(-1, 22, 3))
    R_parent_joint[:, 0] = T[:3, :3] @ R_parent_joint[:, 0]
    root_m = (shift_m + PELVIS_M[model]) @ T[:3, :3].T + T[:3, 3]
    rest_m = shaped_body(BodyShape("anny", dict(ADULT))).rest_joints_m
    scale = _reaching_scale(R_parent_joint, root_m, rest_m, fps) if has_floor else None
    offsets_m = (rest_m - np.where(PARENTS[:, None] < 0, rest_m[:1], rest_m[PARENTS])) * (scale or 1.0)
    same = np.arange(22)
    told = f"middle adult scaled by {scale:.3f} to reach the floor" if scale else "middle adult, moved to the floor"
    clip = SourceClip(
        name=name,
        source=source,
        kind=kind,
        description=f"{model.upper()} parameters; rest joints: {told}",
        origin="",
        fps=fps,
        uneven=False,
        skeleton=SourceSkeleton(f"smpl22_{scale or 1.0:.3f}", JOINT_NAMES, PARENTS.copy(), offsets_m, same, same),
        root_position_m=root_m,
        rotation_wxyz=continuous_quaternions(quaternion_from_matrix(R_parent_joint)),
        source_fps=fps,
    )
    clip = at_fps(clip)
    return with_glitches(clip if scale else on_floor(clip))


def _reaching_scale(R_parent_joint: np.ndarray, root_m: np.ndarray, rest_m: np.ndarray, fps: float) -> float | None:
    """Size of the body at which its standing toes are just above y = 0; None where no size of a person does it."""
    joints_m, _ = forward_kinematics(R_parent_joint, np.zeros_like(root_m), rest_m)
    toes_m = joints_m[:, [JOINT_INDEX["left_foot"], JOINT_INDEX["right_foot"]]]
    world_m = toes_m + root_m[:, None]
    lower = toes_m[..., 1] <= toes_m[..., 1].min(1, keepdims=True)
    slow = np.ones_like(lower)
    if len(root_m) > 2:
        slow = np.linalg.norm(np.gradient(world_m, axis=0), axis=-1) * fps < _SLOW_M_S
    standing = lower & slow if (lower & slow).any() else lower
    drop_m = np.broadcast_to(root_m[:, None, 1], lower.shape)[standing] - _TOE_CLEARANCE_M
    scale = float(np.median(drop_m / np.maximum(-toes_m[..., 1][standing], 0.1)))
    return scale if _SCALES[0] <= scale <= _SCALES[1] else None
