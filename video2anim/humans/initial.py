"""Axes of a person's 3D landmarks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.rotations import matrix_from_axis_angle, rotations_between
from video2anim.types.camera import Intrinsics

_LEVEL_SHARE = 0.4
"""How far BlazePose's landmarks are turned from the axes of the viewing ray to those of a level camera
(`benchmarks/landmark_axes.py`)."""


def ray_rotation(points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the frame of a person's viewing ray into the camera frame, smallest about the optical axis.

    A crop-based landmark model sees every person as if the camera looked straight at them.
    """
    x = (points_px[:, 0] - intrinsics.cx_px) / intrinsics.fx_px
    y = (points_px[:, 1] - intrinsics.cy_px) / intrinsics.fy_px
    ray = np.stack([x, y, np.ones_like(x)], -1)
    return rotations_between(np.broadcast_to([0.0, 0.0, 1.0], ray.shape), ray)


def level_ray_rotation(
    points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics, up_camera: Float[np.ndarray, "frames 3"]
) -> Float[np.ndarray, "frames 3 3"]:
    """`ray_rotation`, turned about the viewing ray so that up has no part across the image: the camera's roll is known.

    Args:
        points_px: Middle of the hips.
        intrinsics: Lens.
        up_camera: Unit vector against gravity in the axes of each frame's camera.
    """
    R_camera_ray = ray_rotation(points_px, intrinsics)
    up_ray = np.einsum("tab,ta->tb", R_camera_ray, up_camera)
    roll_rad = np.arctan2(up_ray[:, 0], -up_ray[:, 1])
    return R_camera_ray @ matrix_from_axis_angle(roll_rad[:, None] * [0.0, 0.0, 1.0])


def landmark_rotation(
    points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics, up_camera: Float[np.ndarray, "frames 3"]
) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the axes of a person's 3D landmarks into the camera frame.

    The landmark model sees a crop, which is an image along the viewing ray, but assumes upright people and a level
    camera: its axes lie between those of the ray and those of a level camera that faces the person. Measured on
    rendered people.

    Args:
        points_px: Middle of the hips.
        intrinsics: Lens.
        up_camera: Unit vector against gravity in the axes of each frame's camera.
    """
    R_camera_ray = ray_rotation(points_px, intrinsics)
    pitch_rad, across = ray_pitch(up_camera, R_camera_ray)
    return R_camera_ray @ matrix_from_axis_angle(_LEVEL_SHARE * pitch_rad[:, None] * across)


def ray_pitch(
    up_camera: Float[np.ndarray, "frames 3"], R_camera_ray: Float[np.ndarray, "frames 3 3"]
) -> tuple[Float[np.ndarray, "frames"], Float[np.ndarray, "frames 3"]]:
    """Angle of the viewing ray against the horizon in radians, and the horizontal axis across it in its own axes, about
    which a level camera is turned by this angle to look along the ray."""
    up_ray = np.einsum("tab,ta->tb", R_camera_ray, up_camera)
    across = np.stack([up_ray[:, 1], -up_ray[:, 0], np.zeros(len(up_ray))], -1)
    length = np.linalg.norm(across, axis=-1)
    return np.arctan2(up_ray[:, 2], length), across / np.maximum(length, 1e-6)[:, None]
