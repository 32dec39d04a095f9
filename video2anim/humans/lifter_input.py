"""Input of the temporal lifter, and the body that its output stands for.

The network sees neither pixels nor the lens: each frame is given in the frame of the person's viewing ray (optical axis
through the middle of the hips, without roll), as directions in units of the person's size, so one network serves all
cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from video2anim.body.anny_body import KEYPOINT_NAMES
from video2anim.geometry.rotations import matrix_from_rot6d
from video2anim.humans.initial import landmark_rotation, level_ray_rotation
from video2anim.humans.landmarks import KEYPOINT_INDEX
from video2anim.humans.problem import Observations
from video2anim.types.skeleton import JOINT_INDEX, PARENTS

KEYPOINTS = len(KEYPOINT_NAMES)
CONTACT_JOINTS: tuple[str, ...] = (
    "left_ankle", "right_ankle", "left_foot", "right_foot", "left_wrist", "right_wrist", "pelvis", "spine3",
)  # fmt: skip
"""Heels, balls of the feet, hands, seat and back."""
CONTACT_INDEX = np.array([JOINT_INDEX[name] for name in CONTACT_JOINTS])
FEATURES = 6 * KEYPOINTS + 4
"""Directions 2, 3D landmarks 3 and visibility 1 per keypoint; logarithm of the size, motion of the hips 2, valid 1."""
CONTACT_OUTPUTS = slice(6 * len(PARENTS) + 3, 6 * len(PARENTS) + 3 + len(CONTACT_JOINTS))
"""After rotations and position."""
ERROR_OUTPUTS = slice(CONTACT_OUTPUTS.stop, CONTACT_OUTPUTS.stop + len(PARENTS))
OUTPUTS = ERROR_OUTPUTS.stop + 3
"""Rotations, position, contact logits, logarithms of the joints' expected errors, up."""
LOG_ERROR_RANGE = (-5.0, 0.5)
"""Logarithms of expected errors (meters) are cut to this: 7 mm to 1.6 m, as in training."""
_HIPS = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]
_FARTHEST = 6.0
"""Directions are clipped to this many sizes of the person from the hips."""


@dataclass(frozen=True, slots=True, eq=False)
class LifterInput:
    """Features of frames at `FPS`, and the frame of reference that they are in."""

    features: Float[np.ndarray, "*batch frames features"]
    R_camera_ray: Float[np.ndarray, "*batch frames 3 3"]
    size: Float[np.ndarray, "*batch frames"]
    """Root mean square distance of the seen keypoints' directions from the middle of the hips, at depth 1."""


@dataclass(frozen=True, slots=True, eq=False)
class LiftedBody:
    """Output of the lifter, in the camera (OpenCV axes)."""

    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    """Joint 0 is the root orientation in the camera."""
    contact: Float[np.ndarray, "frames 8"]
    """Probabilities, in the order of `CONTACT_JOINTS`."""
    up_camera: Float[np.ndarray, "frames 3"]
    """Unit vector against gravity, estimated from the pose."""
    error_m: Float[np.ndarray, "frames 22"]
    """Error that the network predicts for each joint, relative to the pelvis."""

    def rows(self, frames: Int[np.ndarray, "chosen"]) -> LiftedBody:
        """The output for some of the frames."""
        return LiftedBody(
            self.R_parent_joint[frames], self.contact[frames], self.up_camera[frames], self.error_m[frames]
        )


def lifter_input(observed: Observations) -> LifterInput:
    """Features of a person's frames, which must be evenly spaced at `FPS`."""
    valid = observed.valid & np.isfinite(observed.keypoints_px).all((1, 2))
    k = observed.intrinsics
    center_px = _carried(observed.keypoints_px[:, _HIPS].mean(1), valid)
    R_camera_ray = level_ray_rotation(center_px, k, observed.up_camera)
    pixels = np.nan_to_num(observed.keypoints_px)
    ray = np.stack(
        [(pixels[..., 0] - k.cx_px) / k.fx_px, (pixels[..., 1] - k.cy_px) / k.fy_px, np.ones(pixels.shape[:2])], -1
    )
    R_ray_landmarks = np.swapaxes(R_camera_ray, -1, -2) @ landmark_rotation(center_px, k, observed.up_camera)
    points_ray_m = np.einsum("tab,tkb->tka", R_ray_landmarks, np.nan_to_num(observed.keypoints_m))
    return ray_features(ray, R_camera_ray, points_ray_m, observed.weight, valid)


def ray_features(
    ray_camera: Float[np.ndarray, "*batch frames keypoints 3"],
    R_camera_ray: Float[np.ndarray, "*batch frames 3 3"],
    points_ray_m: Float[np.ndarray, "*batch frames keypoints 3"],
    visibility: Float[np.ndarray, "*batch frames keypoints"],
    valid: Bool[np.ndarray, "*batch frames"],
) -> LifterInput:
    """Features from viewing rays and 3D landmarks of the keypoints, of one clip or of many at once.

    Args:
        ray_camera: directions in the camera, of any length.
        R_camera_ray: `ray_rotation` of the middle of the hips, level or not.
        points_ray_m: 3D landmarks in the frame of the ray, with any origin.
        visibility: 0 to 1.
        valid: frames with a measurement; features of the others are zero.
    """
    seen = np.where(valid[..., None], visibility, 0.0)
    turned = ray_camera @ R_camera_ray  # rows: R^T ray
    directions = turned[..., :2] / np.maximum(turned[..., 2:], 0.1)
    directions = directions - directions[..., _HIPS, :].mean(-2, keepdims=True)
    weight = np.maximum(seen, 0.05)
    size = np.sqrt((weight * (directions**2).sum(-1)).sum(-1) / weight.sum(-1))
    size = np.maximum(_carried(size, valid), np.finfo(np.float32).eps)
    center = ray_camera[..., _HIPS, :].mean(-2)
    before = np.concatenate([center[..., :1, :], center[..., :-1, :]], -2)
    moved = (before[..., None, :] @ R_camera_ray)[..., 0, :]
    hips = turned[..., _HIPS, :].mean(-2)
    motion = (hips[..., :2] / hips[..., 2:] - moved[..., :2] / np.maximum(moved[..., 2:], 0.1)) / size[..., None]
    motion *= (valid & np.concatenate([valid[..., :1], valid[..., :-1]], -1))[..., None]
    points = points_ray_m - points_ray_m[..., _HIPS, :].mean(-2, keepdims=True)
    columns = [
        np.clip(directions / size[..., None, None], -_FARTHEST, _FARTHEST).reshape(*valid.shape, -1),
        np.clip(points, -2.0, 2.0).reshape(*valid.shape, -1),
        seen, np.log(size)[..., None], np.clip(motion, -2.0, 2.0), valid[..., None],
    ]  # fmt: skip
    features = np.concatenate(columns, -1) * valid[..., None]
    return LifterInput(features.astype(np.float32), R_camera_ray, size)


def lifted_body(output: Float[np.ndarray, "frames outputs"], given: LifterInput) -> LiftedBody:
    """The network's output as a body.

    Args:
        output: 22 rotations (6D, root in the frame of the ray), logarithm of depth x size, offset of the pelvis from
            the ray (x, y, meters), contact logits, logarithms of expected errors, up in the frame of the ray. Place and
            depth are learned only: those by the landmarks in the image are better.
    """
    output = output.astype(np.float64)
    R = matrix_from_rot6d(output[:, :132].reshape(-1, 22, 6))
    R[:, 0] = given.R_camera_ray @ R[:, 0]
    up_ray = output[:, -3:] / np.maximum(np.linalg.norm(output[:, -3:], axis=-1, keepdims=True), 1e-6)
    return LiftedBody(
        R,
        1.0 / (1.0 + np.exp(-output[:, CONTACT_OUTPUTS])),
        np.einsum("tab,tb->ta", given.R_camera_ray, up_ray),
        np.exp(np.clip(output[:, ERROR_OUTPUTS], *LOG_ERROR_RANGE)),
    )


def _carried(values: np.ndarray, valid: Bool[np.ndarray, "*batch frames"]) -> np.ndarray:
    """Values of the nearest valid frame (the earlier one of two) where there is none; zeros if no frame is valid."""
    frames = np.arange(valid.shape[-1])
    before = np.maximum.accumulate(np.where(valid, frames, -1), -1)
    after = np.minimum.accumulate(np.where(valid, frames, 2 * len(frames))[..., ::-1], -1)[..., ::-1]
    nearer_before = (before >= 0) & (frames - before <= after - frames)
    chosen = np.where(nearer_before, before, np.minimum(after, len(frames) - 1))
    extra = (1,) * (values.ndim - valid.ndim)
    carried = np.take_along_axis(np.nan_to_num(values), chosen.reshape(*chosen.shape, *extra), valid.ndim - 1)
    return carried * valid.any(-1).reshape(*valid.shape[:-1], 1, *extra)
