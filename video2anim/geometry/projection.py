"""Pinhole projection and its inverse. Camera axes are OpenCV's; pixel (0, 0) is the center of the top-left pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from video2anim.types.camera import Intrinsics, View

NEAR_M = 0.05
"""Near plane: what is nearer to a camera than this is not drawn and counts as unseen."""


def project(points_camera_m: Any, intrinsics: Intrinsics) -> Any:
    """Pixels (..., 2) of points (..., 3) in front of the camera. numpy or torch.

    Points at or behind the camera plane give meaningless values; callers mask by z > 0.
    """
    x, y, z = points_camera_m[..., 0], points_camera_m[..., 1], points_camera_m[..., 2]
    u = intrinsics.fx_px * x / z + intrinsics.cx_px
    v = intrinsics.fy_px * y / z + intrinsics.cy_px
    if isinstance(points_camera_m, np.ndarray):
        return np.stack([u, v], -1)
    import torch

    return torch.stack([u, v], -1)


def pixel_rays(intrinsics: Intrinsics) -> Float[np.ndarray, "height width 3"]:
    """Camera-frame direction through every pixel center, with z = 1."""
    u, v = np.meshgrid(np.arange(intrinsics.width_px), np.arange(intrinsics.height_px))
    x = (u - intrinsics.cx_px) / intrinsics.fx_px
    y = (v - intrinsics.cy_px) / intrinsics.fy_px
    return np.stack([x, y, np.ones_like(x)], -1)


def backproject(
    depth_m: Float[np.ndarray, "height width"], intrinsics: Intrinsics
) -> Float[np.ndarray, "height width 3"]:
    """Camera-frame points of a z-depth map that has the size the intrinsics say."""
    if depth_m.shape != (intrinsics.height_px, intrinsics.width_px):
        raise ValueError(
            f"depth map is {depth_m.shape}, intrinsics are for ({intrinsics.height_px}, {intrinsics.width_px})"
        )
    return pixel_rays(intrinsics) * depth_m[..., None]


def transform_points(T_a_b: Any, points_b: Any) -> Any:
    """Points (..., N, 3) of frame b in frame a; T_a_b is (..., 4, 4)."""
    rotation, translation = T_a_b[..., :3, :3], T_a_b[..., None, :3, 3]
    swapped = rotation.swapaxes(-1, -2) if isinstance(T_a_b, np.ndarray) else rotation.transpose(-1, -2)
    return points_b @ swapped + translation


def world_points(depth_m: Float[np.ndarray, "height width"], view: View) -> Float[np.ndarray, "height width 3"]:
    """World points of all pixels."""
    camera_m = backproject(depth_m, view.intrinsics)
    return transform_points(view.T_world_camera, camera_m.reshape(-1, 3)).reshape(camera_m.shape)


def surface_normals(points_m: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Unit normals of a picture of points, towards the camera for points backprojected from its pixels."""
    normal = np.cross(np.gradient(points_m, axis=0), np.gradient(points_m, axis=1))
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def invert_rigid(T_a_b: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 4 4"]:
    """Inverse of rigid transforms, exact to rounding."""
    T_b_a = np.zeros_like(T_a_b)
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -np.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a
