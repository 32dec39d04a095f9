"""The background image as directions and depths from its camera, at the resolution for segmenting planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from video2anim.geometry.masks import shrunk
from video2anim.geometry.projection import invert_rigid, pixel_rays, project, surface_normals, transform_points
from video2anim.types.camera import View
from video2anim.types.metric import MetricDepth
from video2anim.types.scene import BackgroundImage, DepthClip, InstanceMasks, PlacedObject

LONG_SIDE_PX = 192
"""Depth networks resolve nothing finer."""
MAX_DOUBT = 0.3
"""Maximum relative standard deviation of depth that is used; above it a pixel is `unsure`."""
_NORMAL_BLUR_PX = 2.0
"""Blur of inverse depth before normals: networks' depth ripples over a few pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Look(View):
    """Directions and depths of an image. Directions are in world axes with length 1 along the optical axis: a direction
    times a depth is an offset from the camera in meters."""

    direction: Float[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "height width"]
    known: Bool[np.ndarray, "height width"]
    unsure: Bool[np.ndarray, "height width"]
    """Depth too uncertain or too large to be used: the pixel is far away."""
    floor: Bool[np.ndarray, "height width"]
    objects: Bool[np.ndarray, "height width"]
    """Pixels of objects, which hide the background."""
    rgb: UInt8[np.ndarray, "height width 3"]

    @property
    def shape(self) -> tuple[int, int]:
        return self.depth_m.shape  # type: ignore[return-value]

    @property
    def camera_m(self) -> Float[np.ndarray, "3"]:
        return self.T_world_camera[:3, 3]

    @property
    def eye_m(self) -> float:
        """Height of the camera above the floor, at least 0.1 m."""
        return max(float(self.camera_m[1]), 0.1)

    @property
    def offset_m(self) -> Float[np.ndarray, "height width 3"]:
        """From the camera to what each pixel shows."""
        return self.direction * self.depth_m[..., None]

    def floor_depth_m(self) -> Float[np.ndarray, "height width"]:
        """Depth at which each pixel's ray meets y = 0; infinite from the horizon up."""
        down = -self.direction[..., 1]
        return np.where(down > 1e-6, self.camera_m[1] / np.maximum(down, 1e-6), np.inf)

    def normals(self) -> Float[np.ndarray, "height width 3"]:
        """Unit normals of the depth, towards the camera."""
        inverse = cv2.GaussianBlur((1 / self.depth_m).astype(np.float64), (0, 0), _NORMAL_BLUR_PX)
        return surface_normals(self.direction / inverse[..., None])

    def pixels(
        self, points_world_m: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
        """Pixel, depth, and whether the image holds it, of world points."""
        camera_m = transform_points(invert_rigid(self.T_world_camera), np.asarray(points_world_m, np.float64))
        ahead = camera_m[:, 2] > 0.05
        camera_m[~ahead] = (0.0, 0.0, 1.0)
        pixel = project(camera_m, self.intrinsics)
        size = np.array([self.intrinsics.width_px, self.intrinsics.height_px])
        return pixel, camera_m[:, 2], ahead & (pixel > -0.5).all(1) & (pixel < size - 0.5).all(1)

    def sampled(
        self, values: Shaped[np.ndarray, "height width"], points_world_m: Float[np.ndarray, "*points 3"], outside: Any
    ) -> Shaped[np.ndarray, "*points"]:
        """Values at the pixels of world points; `outside` for points outside the image."""
        pixel, _, inside = self.pixels(points_world_m.reshape(-1, 3))
        column, row = (np.where(inside, np.round(pixel[:, k]), 0).astype(int) for k in (0, 1))
        return np.where(inside, values[row, column], outside).reshape(points_world_m.shape[:-1])


def look(
    depth: MetricDepth, masks: InstanceMasks, background: BackgroundImage, relative_sigma: np.ndarray, far_m: float
) -> Look:
    """The first frame's view of the background image. `relative_sigma` is the relative standard deviation of
    its depth."""
    height, width = depth.background_depth_m.shape
    shrink = min(1.0, LONG_SIDE_PX / max(height, width))
    size = (max(8, round(width * shrink)), max(8, round(height * shrink)))
    view = depth.bodies.main_view.resized(*size)

    def small(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_NEAREST_EXACT)

    depth_m = small(depth.background_depth_m)
    known = (small(depth.background_valid) > 0) & np.isfinite(depth_m) & (depth_m > 0.05)
    depth_m = np.where(known, depth_m, np.float32(far_m)).astype(np.float64)
    objects = np.zeros(masks.floor_mask.shape, dtype=bool)
    for instance in masks.instances:
        objects |= instance.mask
    floor, objects = shrunk(masks.floor_mask, size[::-1], 0.5), shrunk(objects, size[::-1], 0.25)
    return Look(
        view.T_world_camera,
        view.intrinsics,
        pixel_rays(view.intrinsics) @ view.T_world_camera[:3, :3].T,
        depth_m,
        known,
        known & ((depth_m > far_m) | (small(relative_sigma) > MAX_DOUBT)),
        floor,
        objects,
        cv2.resize(background.background_rgb, size, interpolation=cv2.INTER_AREA),
    )


def nearer_than(objects: Sequence[PlacedObject], view: View, far_m: float) -> list[PlacedObject]:
    """Objects whose origin is at most `far_m` deep in a view."""
    forward, camera_m = view.T_world_camera[:3, 2], view.T_world_camera[:3, 3]
    return [one for one in objects if float((one.T_world_object[:3, 3] - camera_m) @ forward) <= far_m]


def relative_sigma(depth: MetricDepth, clip: DepthClip) -> Float[np.ndarray, "small_height small_width"]:
    """Standard deviation of the background image's depth as a share of it: of scale, offset and the provider's own
    values."""
    value = clip.background_value
    own = np.ma.median(np.ma.masked_array(clip.sigma, ~(clip.valid & np.isfinite(clip.sigma))), axis=0).filled(0.0)
    sigma = np.sqrt((value * depth.scale_sigma) ** 2 + depth.offset_sigma**2 + (depth.scale * own) ** 2)
    background_m = depth.background_depth_m
    with np.errstate(divide="ignore", invalid="ignore"):
        share = sigma * background_m if clip.kind == "disparity" else sigma / background_m
    return np.where(np.isfinite(share), share, np.inf)
