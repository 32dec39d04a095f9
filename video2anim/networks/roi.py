"""The rotated square a pose network looks at. Pixel (0, 0) is the center of the top-left pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

CROP_MARGIN = 1.25
"""Side of the crop over the diameter of the person's circle; the margin BlazePose was trained with."""
_MAX_OVERSAMPLING = 4


@dataclass(frozen=True, slots=True)
class SquareRoi:
    """A square in the picture, turned about its center."""

    center_x_px: float
    center_y_px: float
    side_px: float
    rotation_rad: float
    """Angle from the picture's x axis to the crop's, clockwise on screen; 0 = upright."""

    @classmethod
    def from_circle(
        cls,
        center_px: Float[np.ndarray, "2"],
        rim_px: Float[np.ndarray, "2"],
        margin: float = CROP_MARGIN,
    ) -> SquareRoi:
        """Square around the circle of a body: its center (mid hips) and the point of its rim above the head."""
        dx, dy = (float(v) for v in rim_px - center_px)
        side_px = 2.0 * margin * math.hypot(dx, dy)
        # The rim lies on the crop's -y axis, which is (sin r, -cos r) in the picture.
        return cls(float(center_px[0]), float(center_px[1]), side_px, math.atan2(dx, -dy))

    @property
    def radius_px(self) -> float:
        """Radius of the body's circle, from the hips to beyond the head."""
        return 0.5 * self.side_px / CROP_MARGIN

    def T_image_crop(self) -> Float[np.ndarray, "2 3"]:
        """Affine map from crop coordinates in [0, 1] x [0, 1] (edge to edge) to pixels."""
        cos, sin = math.cos(self.rotation_rad), math.sin(self.rotation_rad)
        linear = self.side_px * np.array([[cos, -sin], [sin, cos]])
        offset = np.array([self.center_x_px, self.center_y_px]) - linear @ np.array([0.5, 0.5])
        return np.column_stack([linear, offset])

    def to_pixels(self, points_crop: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Crop coordinates to pixels."""
        T_image_crop = self.T_image_crop()
        return points_crop @ T_image_crop[:, :2].T + T_image_crop[:, 2]

    def to_crop(self, points_px: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Pixels to crop coordinates."""
        T_image_crop = self.T_image_crop()
        return np.linalg.solve(T_image_crop[:, :2], (points_px - T_image_crop[:, 2]).T).T

    def crop(self, image: UInt8[np.ndarray, "height width 3"], size_px: int) -> UInt8[np.ndarray, "size size 3"]:
        """The square as a picture of `size_px`; black outside the image.

        Crop pixel i has its center at crop coordinate (i + 0.5) / size_px. Reductions of two and more are sampled
        finely and averaged over areas, so that they do not alias.
        """
        fine_px = size_px * min(max(int(self.side_px // size_px), 1), _MAX_OVERSAMPLING)
        T_image_crop = self.T_image_crop()
        linear, offset = T_image_crop[:, :2] / fine_px, T_image_crop[:, 2]
        T_image_fine = np.column_stack([linear, offset + linear @ np.array([0.5, 0.5])])
        fine = cv2.warpAffine(
            image,
            T_image_fine,
            (fine_px, fine_px),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        return fine if fine_px == size_px else cv2.resize(fine, (size_px, size_px), interpolation=cv2.INTER_AREA)
