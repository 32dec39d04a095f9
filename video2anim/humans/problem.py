"""Input and result of a body fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.types.camera import Intrinsics
from video2anim.types.motion import BodyShape


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Landmarks of one person in the order of `KEYPOINT_NAMES`; frames need not be neighbors in time."""

    frame_time_s: Float[np.ndarray, "frames"]
    valid: Bool[np.ndarray, "frames"]
    keypoints_px: Float[np.ndarray, "frames keypoints 2"]
    keypoints_m: Float[np.ndarray, "frames keypoints 3"]
    """Root-relative, OpenCV axes, as the landmark model gives them (along the viewing ray of the person)."""
    weight: Float[np.ndarray, "frames keypoints"]
    """Confidence, 0 where not seen or not valid."""
    intrinsics: Intrinsics
    up_camera: Float[np.ndarray, "frames 3"]
    """Unit vector against gravity in the axes of each frame's camera."""

    @property
    def size_px(self) -> Float[np.ndarray, "frames"]:
        """Diagonal of the box around the seen keypoints per frame, the unit of pixel errors; NaN where not valid."""
        seen = np.where(self.weight[..., None] > 0, self.keypoints_px, np.nan)
        size = np.full(len(self.valid), np.nan)
        rows = self.valid & (np.isfinite(seen[..., 0]).sum(1) >= 2)
        extent = np.nanmax(seen[rows], axis=1) - np.nanmin(seen[rows], axis=1)
        size[rows] = np.linalg.norm(extent, axis=-1)
        return size


def evenly_spread(rows: Int[np.ndarray, "rows"], count: int) -> Int[np.ndarray, "chosen"]:
    """At most `count` of the rows, first and last among them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int))]


@dataclass(frozen=True, slots=True, eq=False)
class FittedBody:
    """Result of a fit in the camera frame (OpenCV axes)."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    """Joint 0 is the root orientation in the camera."""
    translation_camera_m: Float[np.ndarray, "frames 3"]
    joints_camera_m: Float[np.ndarray, "frames 22 3"]
    rest_joints_m: Float[np.ndarray, "22 3"]
    shape: BodyShape
    reprojection_px: Float[np.ndarray, "frames keypoints"]
    """NaN where the keypoint was not seen."""
