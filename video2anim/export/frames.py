"""Changes of axes at the border between this package and file formats."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from video2anim.types import Intrinsics

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_opencv_opengl: camera axes of glTF and USD (+X right, +Y up, looking along -Z) into OpenCV's."""

_SAME = 1e-9
"""From one frame to the next; a thousandth of what counts for a whole clip, so that slow motion is not lost."""
CENTIMETERS_PER_METER = 100.0
ZUP_FROM_YUP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""R_zup_yup: +Y up to +Z up by a quarter turn about +X, as Blender's glTF import does."""


def opengl_camera_poses(T_world_camera: Float[np.ndarray, "frames 4 4"]) -> Float[np.ndarray, "frames 4 4"]:
    """Poses of an OpenCV camera for formats whose cameras look along -Z with +Y up."""
    return T_world_camera @ OPENCV_FROM_OPENGL


def is_still(T_world_camera: Float[np.ndarray, "frames 4 4"], tolerance: float = 1e-6) -> bool:
    """Whether the poses are all the same (meters and matrix entries within `tolerance`)."""
    return bool(np.abs(T_world_camera - T_world_camera[:1]).max() <= tolerance)


def needed_keys(T_world_object: Float[np.ndarray, "frames 4 4"]) -> Int[np.ndarray, "keys"]:
    """Frames that a linear track needs: the first, the last, and those beside which the pose changes."""
    step = np.abs(np.diff(T_world_object, axis=0)).max((1, 2)) > _SAME
    edges = np.concatenate([[True], step, [True]])
    return np.flatnonzero(edges[:-1] | edges[1:])


def vertical_fov_rad(intrinsics: Intrinsics) -> float:
    """Full vertical field of view of a centered camera with this focal length and height."""
    return float(2.0 * np.arctan2(0.5 * intrinsics.height_px, intrinsics.fy_px))


def linear_from_srgb(rgb: np.ndarray) -> Float[np.ndarray, "... 3"]:
    """uint8 sRGB to linear light in [0, 1] (IEC 61966-2-1)."""
    return linear_light(rgb.astype(np.float64) / 255.0)


def linear_light(value: np.ndarray) -> Float[np.ndarray, "... 3"]:
    """sRGB in [0, 1] to linear light in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
