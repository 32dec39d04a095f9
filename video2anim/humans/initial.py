"""Axes of a person's 3D landmarks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.geometry.rotations import matrix_from_axis_angle, rotations_between
from video2anim.types.camera import Intrinsics

_YAW_SHARE, _PITCH_SHARE = 0.75, 0.3
"""Parts of the viewing ray's angle by which BlazePose's landmarks are rotated against the camera
(`benchmarks/landmark_axes.py`)."""


def ray_rotation(points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the frame of a person's viewing ray into the camera frame, smallest about the optical axis.

    A crop-based landmark model sees every person as if the camera looked straight at them.
    """
    x = (points_px[:, 0] - intrinsics.cx_px) / intrinsics.fx_px
    y = (points_px[:, 1] - intrinsics.cy_px) / intrinsics.fy_px
    ray = np.stack([x, y, np.ones_like(x)], -1)
    return rotations_between(np.broadcast_to([0.0, 0.0, 1.0], ray.shape), ray)


def landmark_rotation(
    points_px: Float[np.ndarray, "frames 2"], intrinsics: Intrinsics
) -> Float[np.ndarray, "frames 3 3"]:
    """Rotation from the axes of a person's 3D landmarks into the camera frame.

    The landmark model sees a crop, whose place in the image it does not know, but assumes upright people and a level
    camera, and so corrects a part of the viewing ray's tilt. Measured on rendered people.
    """
    x = (points_px[:, 0] - intrinsics.cx_px) / intrinsics.fx_px
    y = (points_px[:, 1] - intrinsics.cy_px) / intrinsics.fy_px
    zero = np.zeros_like(x)
    angles = np.stack([-_PITCH_SHARE * np.arctan(y), _YAW_SHARE * np.arctan(x), zero], -1)
    return np.asarray(matrix_from_axis_angle(angles))
