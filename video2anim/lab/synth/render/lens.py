"""Lens of the synthetic camera: pinhole with two radial terms (Brown-Conrady, as in OpenCV's k1 and k2)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.types import Intrinsics

_ITERATIONS = 12


def distort(xy: Float[np.ndarray, "... 2"], k1: float, k2: float) -> Float[np.ndarray, "... 2"]:
    """Distorted position of an ideal point; both in normalized coordinates (camera plane z = 1)."""
    r2 = (xy * xy).sum(-1, keepdims=True)
    return xy * (1.0 + r2 * (k1 + k2 * r2))


def undistort(xy: Float[np.ndarray, "... 2"], k1: float, k2: float) -> Float[np.ndarray, "... 2"]:
    """Inverse of `distort` by Newton steps on the radius; exact to rounding where the lens is invertible."""
    if k1 == 0.0 and k2 == 0.0:
        return xy
    seen = np.linalg.norm(xy, axis=-1, keepdims=True)
    radius = seen.copy()
    for _ in range(_ITERATIONS):
        r2 = radius * radius
        error = radius * (1.0 + r2 * (k1 + k2 * r2)) - seen
        slope = 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2)
        radius = radius - error / np.maximum(slope, 0.05)
    return xy * (radius / np.maximum(seen, 1e-12))


def covers_picture(intrinsics: Intrinsics, k1: float, k2: float) -> bool:
    """Whether the distortion is invertible up to the picture's corners: the radial curve rises until there."""
    corner = np.hypot(
        max(intrinsics.cx_px, intrinsics.width_px - 1 - intrinsics.cx_px) / intrinsics.fx_px,
        max(intrinsics.cy_px, intrinsics.height_px - 1 - intrinsics.cy_px) / intrinsics.fy_px,
    )
    radius = np.linspace(0.0, 2.0 * corner, 400)
    slope = 1.0 + radius**2 * (3.0 * k1 + 5.0 * k2 * radius**2)
    rising = radius[: int(np.argmax(slope < 0.2)) or None]
    return bool((rising * (1.0 + rising**2 * (k1 + k2 * rising**2))).max() > 1.01 * corner)


def pixel_directions(
    pixels: Float[np.ndarray, "... 2"], intrinsics: Intrinsics, k1: float = 0.0, k2: float = 0.0
) -> Float[np.ndarray, "... 3"]:
    """Ray directions (camera axes, z = 1) through pixel coordinates; the distance along such a ray is the z-depth."""
    seen = (pixels - [intrinsics.cx_px, intrinsics.cy_px]) / [intrinsics.fx_px, intrinsics.fy_px]
    ideal = undistort(np.asarray(seen, float), k1, k2)
    return np.concatenate([ideal, np.ones_like(ideal[..., :1])], -1)


def project_distorted(
    points_camera_m: Float[np.ndarray, "... 3"], intrinsics: Intrinsics, k1: float = 0.0, k2: float = 0.0
) -> Float[np.ndarray, "... 2"]:
    """Pixel coordinates, with lens distortion, of points in front of the camera."""
    seen = distort(points_camera_m[..., :2] / points_camera_m[..., 2:], k1, k2)
    return seen * [intrinsics.fx_px, intrinsics.fy_px] + [intrinsics.cx_px, intrinsics.cy_px]
