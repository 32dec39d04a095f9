"""What body regressors agree on: SMPL pose per frame in the camera, and the squares they look at.

Axes: SMPL rests with x to the body's left, y up, z forward. Rotations turn that body frame into the camera's OpenCV
axes (x right, y down, z forward), so someone who stands upright and faces the camera has the root orientation
diag(1, -1, -1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from video2anim.geometry.rotations import matrix_from_rot6d, rot6d_from_matrix
from video2anim.networks.roi import SquareRoi
from video2anim.types.camera import Intrinsics
from video2anim.types.motion import BodyShape

BODY_RATIO = 192 / 256
"""Width over height of the box that ViT pose backbones see: the middle of a square crop."""
_MAX_SKEW = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class BodyEstimate:
    """SMPL parameters of one person in the camera frame, for one frame or with leading axes for many."""

    body_model: str
    """Model whose parameters these are: `smpl` or `smplx`."""
    valid: Bool[np.ndarray, "*frames"]
    """False: no measurement (nobody seen, or a camera that makes no sense)."""
    R_parent_joint: Float[np.ndarray, "*frames 22 3 3"]
    """Local rotations in SMPL order; joint 0 is the root orientation in the camera. Hands are dropped."""
    translation_camera_m: Float[np.ndarray, "*frames 3"]
    """SMPL's translation parameter: where the origin of the model's own frame lies, not the pelvis; NaN where the
    network gave no sensible camera."""
    betas: Float[np.ndarray, "*frames 10"]

    def pelvis_camera_m(self, pelvis_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*frames 3"]:
        """Pelvis in the camera, which is the root translation of a `BodyMotion`.

        SMPL turns about the pelvis, so its offset in the model's frame is added unturned.

        Args:
            pelvis_m: pelvis of the shape in the model's own frame (`SmplModel.pelvis_m`).
        """
        return self.translation_camera_m + pelvis_m

    def shape(self) -> BodyShape:
        """One shape for all frames: the median of each coefficient over the valid ones (over all if none is)."""
        betas = self.betas.reshape(-1, self.betas.shape[-1])
        valid = self.valid.reshape(-1)
        center = np.median(betas[valid] if valid.any() else betas, axis=0)
        return BodyShape(self.body_model, {f"beta_{i}": float(beta) for i, beta in enumerate(center)})


def square_of_box(box_px: Float[np.ndarray, "*frames 4"], margin: float = 1.0) -> Float[np.ndarray, "*frames 3"]:
    """Centre x, y and side of the upright square whose middle 3:4 strip just holds a box x0, y0, x1, y1 (pixels)."""
    width, height = box_px[..., 2] - box_px[..., 0], box_px[..., 3] - box_px[..., 1]
    side = margin * np.maximum(height, width / BODY_RATIO)
    center = 0.5 * (box_px[..., :2] + box_px[..., 2:])
    return np.concatenate([center, side[..., None]], -1)


def square_of_roi(roi: SquareRoi) -> Float[np.ndarray, "3"]:
    """Centre x, y and side of the upright square around the body's circle of a pose network's crop (pixels).

    The turn of the crop is dropped: these networks were trained on upright pictures.
    """
    return np.array([roi.center_x_px, roi.center_y_px, 2.0 * roi.radius_px])


def full_frame_translation(
    weak_camera: Float[np.ndarray, "*frames 3"], square_px: Float[np.ndarray, "*frames 3"], intrinsics: Intrinsics
) -> Float[np.ndarray, "*frames 3"]:
    """SMPL's translation (meters, camera frame) from the weak-perspective camera of a square crop.

    The network sees the square's half side as the length 1 / s at the body, hence z = 2 f / (s side); x and y are the
    crop's own shift plus the square's place in the picture at that depth (CLIFF, Li et al. 2022, as in 4D-Humans).
    Square pixels are assumed. NaN where s is not positive.

    Args:
        weak_camera: scale s (1 / m) and shifts t_x, t_y (m).
        square_px: center x, y and side.
        intrinsics: of the whole picture.
    """
    scale, side_px = weak_camera[..., 0], square_px[..., 2]
    positive = np.isfinite(scale) & (scale > 0)
    depth_m = 2.0 * intrinsics.fx_px / (np.where(positive, scale, np.nan) * side_px)
    x_m = weak_camera[..., 1] + (square_px[..., 0] - intrinsics.cx_px) * depth_m / intrinsics.fx_px
    y_m = weak_camera[..., 2] + (square_px[..., 1] - intrinsics.cy_px) * depth_m / intrinsics.fy_px
    xyz_m = np.stack([x_m, y_m, depth_m], -1)
    return np.where(np.isfinite(xyz_m).all(-1, keepdims=True), xyz_m, np.nan)


def nearest_rotations(matrices: Float[np.ndarray, "*any 3 3"]) -> Float[np.ndarray, "*any 3 3"] | None:
    """Matrices of a network made exactly orthonormal (half precision bends them a little); None if they are none."""
    matrices = matrices.astype(np.float64)
    skew = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max()
    if not skew <= _MAX_SKEW or (np.linalg.det(matrices) < 0).any():
        return None
    return matrix_from_rot6d(rot6d_from_matrix(matrices))
