"""Axes of a person's 3D landmarks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.rotations import matrix_from_axis_angle, rotations_between
from video2anim.types.camera import Intrinsics

_YAW_SHARE, _PITCH_SHARE, _LEVEL_SHARE = 0.75, 0.3, 0.0
"""Parts of the viewing ray's angles and of the camera's pitch by which BlazePose's landmarks are rotated against the
camera (`benchmarks/landmark_axes.py`)."""


def ray_rotation(points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the frame of a person's viewing ray into the camera frame, smallest about the optical axis.

    A crop-based landmark model sees every person as if the camera looked straight at them.
    """
    x = (points_px[:, 0] - intrinsics.cx_px) / intrinsics.fx_px
    y = (points_px[:, 1] - intrinsics.cy_px) / intrinsics.fy_px
    ray = np.stack([x, y, np.ones_like(x)], -1)
    return rotations_between(np.broadcast_to([0.0, 0.0, 1.0], ray.shape), ray)


def landmark_rotation(
    points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics, up_camera: Float[np.ndarray, "frames 3"]
) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the axes of a person's 3D landmarks into the camera frame.

    The landmark model sees a crop, whose place in the image it does not know, but assumes upright people and a level
    camera: its axes lie between those of the viewing ray and those of a level camera. Measured on rendered people.

    Args:
        points_px: Middle of the hips.
        intrinsics: Lens.
        up_camera: Unit vector against gravity in the axes of each frame's camera.
    """
    yaw, pitch, level = landmark_turns(points_px, intrinsics, up_camera)
    return np.asarray(matrix_from_axis_angle(_YAW_SHARE * yaw + _PITCH_SHARE * pitch + _LEVEL_SHARE * level))


def landmark_turns(
    points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics, up_camera: Float[np.ndarray, "frames 3"]
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 3"]]:
    """Rotation vectors: of the viewing ray about the image's up direction, of the ray across it, and of the camera
    against a level one."""
    x = (points_px[:, 0] - intrinsics.cx_px) / intrinsics.fx_px
    y = (points_px[:, 1] - intrinsics.cy_px) / intrinsics.fy_px
    ray = np.stack([-np.arctan(y), np.arctan(x), np.zeros_like(x)], -1)
    length = np.linalg.norm(up_camera[:, :2], axis=-1, keepdims=True)
    up = np.concatenate([up_camera[:, :2] / np.maximum(length, 1e-6), np.zeros((len(up_camera), 1))], -1)
    across = np.stack([up[:, 1], -up[:, 0], up[:, 2]], -1)
    yaw, pitch = ((ray * axis).sum(-1, keepdims=True) * axis for axis in (up, across))
    return yaw, pitch, np.arctan2(up_camera[:, 2:], length) * across
