"""A picture seen on a vertical cylinder around the camera: columns are plumb lines, rows are elevation angles.

In this view a vertical surface has one horizontal distance per column and the floor one per row, whatever the
camera's pitch and roll.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.projection import pixel_rays, project
from video2anim.types.camera import View


@dataclass(frozen=True, slots=True, eq=False)
class GravityView:
    """Maps between a picture and its cylinder, and what the cylinder knows of the floor y = 0."""

    camera: View
    camera_height_m: float
    ray_horizontal: Float[np.ndarray, "height width"]
    """Horizontal length of the pixel's ray of unit z-depth: horizontal distance = z-depth x this."""
    ray_world: Float[np.ndarray, "height width 3"]
    """World direction of the pixel's ray of unit z-depth."""
    center_world_m: Float[np.ndarray, "3"]
    heading_world: Float[np.ndarray, "3"]
    """Horizontal unit direction of azimuth 0."""
    step_rad: float
    azimuth_start_rad: float
    elevation_top_rad: float
    columns: int
    rows: int

    @classmethod
    def of(cls, camera: View) -> GravityView:
        """Of a camera's view; the angular step is that of a pixel at the picture's center."""
        T_world_camera, intrinsics = camera.T_world_camera, camera.intrinsics
        R_world_camera = T_world_camera[:3, :3]
        ray_world = pixel_rays(intrinsics) @ R_world_camera.T
        heading = _horizontal(R_world_camera[:, 2], R_world_camera @ np.array([0.0, -1.0, 0.0]))
        right = np.cross(heading, np.array([0.0, 1.0, 0.0]))
        ray_horizontal = np.maximum(np.hypot(ray_world[..., 0], ray_world[..., 2]), 1e-6)
        azimuth = np.arctan2(ray_world @ right, ray_world @ heading)
        elevation = np.arctan2(ray_world[..., 1], ray_horizontal)
        span = float(np.ptp(azimuth))
        step = max(1.0 / intrinsics.fx_px, span / (2.0 * max(intrinsics.width_px, 8)))
        return cls(
            camera=camera,
            camera_height_m=float(T_world_camera[1, 3]),
            ray_horizontal=ray_horizontal,
            ray_world=ray_world,
            center_world_m=np.asarray(T_world_camera[:3, 3], dtype=np.float64),
            heading_world=heading,
            step_rad=step,
            azimuth_start_rad=float(azimuth.min()),
            elevation_top_rad=float(elevation.max()),
            columns=int(np.ceil(span / step)) + 1,
            rows=int(np.ceil(float(np.ptp(elevation)) / step)) + 1,
        )

    @property
    def right_world(self) -> Float[np.ndarray, "3"]:
        """Horizontal unit direction of azimuth +90 degrees."""
        return np.cross(self.heading_world, np.array([0.0, 1.0, 0.0]))

    def azimuth_rad(self, columns: np.ndarray) -> np.ndarray:
        """Azimuth of (fractional) columns."""
        return np.asarray(self.azimuth_start_rad + columns * self.step_rad)

    def elevation_rad(self, rows: np.ndarray) -> np.ndarray:
        """Elevation of (fractional) rows; negative is below the horizon."""
        return np.asarray(self.elevation_top_rad - rows * self.step_rad)

    def locate(self, points_world_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 2"]:
        """Column and row of world points."""
        offset = points_world_m - self.center_world_m
        azimuth = np.arctan2(offset @ self.right_world, offset @ self.heading_world)
        elevation = np.arctan2(offset[..., 1], np.hypot(offset[..., 0], offset[..., 2]))
        column = (azimuth - self.azimuth_start_rad) / self.step_rad
        return np.stack([column, (self.elevation_top_rad - elevation) / self.step_rad], -1)

    def grid_of_pixels(self) -> Float[np.ndarray, "height width 2"]:
        """Column and row of every pixel of the picture."""
        points = self.center_world_m + self.ray_world.reshape(-1, 3)
        return self.locate(points).reshape(*self.ray_horizontal.shape, 2)

    def pixels_of_grid(self) -> tuple[Float[np.ndarray, "rows columns 2"], Bool[np.ndarray, "rows columns"]]:
        """Pixel under every node of the cylinder, held at the picture's edge, and whether the picture shows it."""
        azimuth = self.azimuth_rad(np.arange(self.columns))[None, :]
        elevation = self.elevation_rad(np.arange(self.rows))[:, None]
        flat = np.cos(azimuth)[..., None] * self.heading_world + np.sin(azimuth)[..., None] * self.right_world
        ray = flat + np.tan(np.clip(elevation, -1.56, 1.56))[..., None] * np.array([0.0, 1.0, 0.0])
        ray_camera = ray @ self.camera.T_world_camera[:3, :3]
        ahead = ray_camera[..., 2] > 1e-6
        ray_camera[~ahead] = (0.0, 0.0, 1.0)
        lens = self.camera.intrinsics
        pixels = project(ray_camera, lens)
        size = np.array([lens.width_px, lens.height_px])
        seen = ahead & (pixels >= -0.5).all(-1) & (pixels <= size - 0.5).all(-1)
        return np.clip(pixels, 0, size - 1), seen


def remap(field: np.ndarray, coordinates: Float[np.ndarray, "height width 2"], *, nearest: bool = False) -> np.ndarray:
    """Sample an image or map at (column, row) coordinates; edges are held."""
    mode = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    source = field.astype(np.uint8) if field.dtype == bool else field
    x, y = coordinates[..., 0].astype(np.float32), coordinates[..., 1].astype(np.float32)
    sampled = cv2.remap(source, x, y, mode, borderMode=cv2.BORDER_REPLICATE)
    return sampled.astype(bool) if field.dtype == bool else sampled


def _horizontal(direction: Float[np.ndarray, "3"], fallback: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    for candidate in (direction, fallback):
        flat = np.array([candidate[0], 0.0, candidate[2]])
        if np.linalg.norm(flat) > 0.05:
            return flat / np.linalg.norm(flat)
    return np.array([0.0, 0.0, -1.0])
