"""Cameras: pinhole intrinsics, views, and the estimated camera of the clip."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import FiniteFloat, NonNegativeFloat, PositiveFloat, PositiveInt

from video2anim.types.checks import Checked
from video2anim.types.storage import Holds

SLOPE_SIGMA_RAD = math.radians(1.5)
"""Usual slope of ground: twice as much, 5 %, is a steep path and the limit of ramps for wheelchairs."""
_SAME_PERSPECTIVE = 0.5
"""Of the usual distance of the background: images from farther apart show it in different perspectives. Not
measured."""


@dataclass(frozen=True, slots=True)
class Intrinsics(Checked):
    """Pinhole camera. Pixel (0, 0) is the center of the top-left pixel; +x right, +y down, +z forward."""

    fx_px: PositiveFloat
    fy_px: PositiveFloat
    cx_px: FiniteFloat
    cy_px: FiniteFloat
    width_px: PositiveInt
    height_px: PositiveInt

    @classmethod
    def centered(cls, focal_px: float, width_px: int, height_px: int) -> Intrinsics:
        """Intrinsics with square pixels and the principal point at the center of the picture."""
        return cls(focal_px, focal_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1), width_px, height_px)

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def resized(self, width_px: int, height_px: int) -> Intrinsics:
        """Intrinsics of the same picture at another size, with pixel (0, 0) still the center of the top-left pixel."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        cx_px, cy_px = (self.cx_px + 0.5) * sx - 0.5, (self.cy_px + 0.5) * sy - 0.5
        return Intrinsics(self.fx_px * sx, self.fy_px * sy, cx_px, cy_px, width_px, height_px)


@dataclass(frozen=True, slots=True, eq=False)
class View(Checked):
    """A camera in one frame: pose and intrinsics."""

    T_world_camera: Annotated[Float[np.ndarray, "4 4"], Holds.RIGID]
    intrinsics: Intrinsics

    @property
    def center_m(self) -> Float[np.ndarray, "3"]:
        """Position of the camera in the world."""
        return self.T_world_camera[:3, 3]

    @property
    def forward(self) -> Float[np.ndarray, "3"]:
        """Unit vector along the optical axis, in the world."""
        return self.T_world_camera[:3, 2]

    def resized(self, width_px: int, height_px: int) -> View:
        """The same view for a picture of another size."""
        return View(self.T_world_camera, self.intrinsics.resized(width_px, height_px))


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundPoints(Checked):
    """Points of the background whose depth the motion of a traveling camera tells."""

    place: Float[np.ndarray, "points 3"]
    """In the first camera's axes, in the unit of `CameraEstimate.T_first_camera`."""
    log_sigma: Float[np.ndarray, "points"]
    """Standard deviation of the logarithm of the depth."""
    in_first_frame: Bool[np.ndarray, "points"]
    """Whether the first frame shows the point."""

    @classmethod
    def none(cls) -> BackgroundPoints:
        """No points: a camera that does not travel."""
        return cls(np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool))


@dataclass(frozen=True, slots=True, eq=False)
class CameraEstimate(Checked):
    """Intrinsics and gravity of the clip's camera."""

    intrinsics: Intrinsics
    focal_source: str
    """`user`, `metadata`, `picture` (perspective of the image) or `motion` (of the background, if the camera moves)."""
    focal_sigma_ratio: NonNegativeFloat
    """Standard deviation of the focal length divided by the focal length."""
    up_camera: Annotated[Float[np.ndarray, "3"], Holds.DIRECTION]
    """Unit vector against gravity in camera axes, first frame."""
    up_sigma_rad: NonNegativeFloat
    is_static: bool
    T_first_camera: Annotated[Float[np.ndarray, "frames 4 4"], Holds.RIGID]
    """Pose of each frame's camera in the first one's axes; identity if `is_static`. Unit of length: the usual distance
    of the background, which images leave open (stages humans and metric find it in meters)."""
    points: BackgroundPoints = field(default_factory=BackgroundPoints.none)
    """Points of the background with known depth."""

    @property
    def up_in_frames(self) -> Float[np.ndarray, "frames 3"]:
        """`up_camera` in the axes of each frame's camera."""
        return self.up_camera @ self.T_first_camera[:, :3, :3]

    @property
    def travels(self) -> bool:
        """Whether the camera changes its place."""
        return bool(self.T_first_camera[:, :3, 3].any())

    def H_first_frame(self, frame: Int[np.ndarray, "samples"]) -> Float[np.ndarray, "samples 3 3"]:
        """Homographies from the pixels of some frames to those of the first one.

        They are exact for a camera that only turns, and for what is at the usual distance in front of the first camera.
        NaN where the camera has come half as far, from where it shows the background in another perspective.
        """
        K, R, center = self.intrinsics.matrix(), self.T_first_camera[frame, :3, :3], self.T_first_camera[frame, :3, 3]
        in_camera = np.swapaxes(R, 1, 2) @ (np.eye(3) - center[:, :, None] * [0.0, 0.0, 1.0])
        far = np.linalg.norm(center, axis=1) >= _SAME_PERSPECTIVE
        in_camera[far] = np.eye(3)
        H = K @ np.linalg.inv(in_camera) @ np.linalg.inv(K)
        return np.where(far[:, None, None], np.nan, H)
