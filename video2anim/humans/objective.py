"""The objective of the body fit: a negative log posterior in torch.

Every term is a squared (or Huber) residual over a standard deviation with a physical unit, so every weight has
a meaning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from video2anim.body.anny_body import ADULT, PEOPLES_LENGTHS, AnnyModel
from video2anim.geometry.robust import huber_of_square
from video2anim.geometry.rotations import matrix_from_axis_angle, matrix_from_rot6d
from video2anim.humans.body_height import KNOWN_SIGMA_M
from video2anim.humans.landmarks import KEYPOINT_TRUST, with_landmarks
from video2anim.humans.lifter_input import LiftedBody
from video2anim.humans.problem import Observations
from video2anim.types.motion import ADULT_HEIGHT_SIGMA_M
from video2anim.types.skeleton import JOINT_INDEX, PARENTS, forward_kinematics


@dataclass(frozen=True)
class FitConfig:
    """Standard deviations of the fit's terms."""

    landmark_2d_ratio: float = 0.004
    """Pixel error of a limb landmark as a share of the person's box diagonal."""
    landmark_2d_px: float = 3.0
    """Pixel error of a landmark at any size of the person; both add in quadrature."""
    acceleration_m_s2: float = 25.0
    """Standard deviation of joint accelerations; those over 1.5 of it count linearly. A tighter prior would remove more
    jitter, but couples the frames so that the fit converges slowly; the low-pass filter removes the rest."""
    body_height_m: float = 1.70
    """Mean standing height of adults (NCD-RisC 2016: women 1.59 to 1.65 m, men 1.71 to 1.78 m in most regions)."""
    body_height_sigma_m: float = ADULT_HEIGHT_SIGMA_M
    shape_sigma: float = 0.4
    """Standard deviation of the other phenotypes, whose range is 0 to 1: wide, since gender lies near its ends and the
    range of proportions changes the legs' share of the body height by 1.6 points only, as adults differ."""
    prior_share: float = 4.0
    """Weight of the shape prior per frame: a detector's bias is the same in every frame, so the evidence on shape does
    not grow with the length of the clip."""
    lifted_angle_rad_m: float = 3.5
    """Standard deviation of the lifter's joint angles, radians for each meter of the error that it predicts for the
    moved joints. With 5, PA-MPJPE of stage humans is 0.3 mm worse on V2A-Bench and 0.1 mm better on the four real clips
    of `benchmarks/lifter.py`."""

    @classmethod
    def for_height(cls, known_m: float | None) -> FitConfig:
        """For a person whose standing height is known in meters, or (None) for an adult."""
        return cls() if known_m is None else cls(body_height_m=known_m, body_height_sigma_m=KNOWN_SIGMA_M)


_HINGES = {"left_knee": (0, 1.0), "right_knee": (0, 1.0), "left_elbow": (1, -1.0), "right_elbow": (1, 1.0)}
"""Hinge joints: axis of flexion in the joint frame and its positive sense."""
_OVERSTRETCH_SIGMA_RAD = 0.1
"""Standard deviation of the angle by which knees and elbows bend the wrong way."""
PERSON = ADULT | {name: mean for name, (mean, _) in PEOPLES_LENGTHS.items()}
"""The average adult with people's proportions, from which a fit starts."""
SHAPE_PARAMETERS = ("height", "gender", "weight", "proportions", *PEOPLES_LENGTHS)
"""Parameters that are fitted; age and muscle cannot be told from landmarks."""


@dataclass(slots=True)
class Parameters:
    """Free variables of the fit (torch leaves)."""

    root_rot6d: torch.Tensor
    """(T, 6)"""
    angles_rad: torch.Tensor
    """(T, 21, 3) rotation vectors of joints 1 to 21."""
    translation_m: torch.Tensor
    """(T, 3) in the camera, for the body height that the fit starts with; see `Objective.translation_m`."""
    shape_offset: torch.Tensor
    """(10,) offsets of `SHAPE_PARAMETERS` from the shape that the fit starts with."""


@dataclass(frozen=True, slots=True)
class Prediction:
    joints_m: torch.Tensor
    keypoints_m: torch.Tensor
    R_camera_joint: torch.Tensor
    R_parent_joint: torch.Tensor
    rest_joints_m: torch.Tensor
    body_height_m: torch.Tensor


class Objective:
    """Negative log posterior of `Parameters` given `Observations`."""

    def __init__(
        self,
        observed: Observations,
        model: AnnyModel,
        base_shape: dict[str, float],
        config: FitConfig,
        lifted: LiftedBody,
    ) -> None:
        self.observed, self.model, self.config = observed, model, config
        self._lifted = torch.from_numpy(lifted.R_parent_joint).float()
        error_m = lifted.error_m
        moved_m = np.stack([error_m[:, np.flatnonzero(j == PARENTS)].max(1, initial=0) for j in range(22)], 1)
        self._joint_sigma_m = torch.from_numpy(error_m).float()
        self._angle_sigma = config.lifted_angle_rad_m * torch.from_numpy(np.maximum(moved_m, error_m)).float()
        self._believed = torch.from_numpy(observed.valid).float()
        self._base_shape = base_shape
        k = observed.intrinsics
        self._center = torch.tensor([k.cx_px, k.cy_px], dtype=torch.float32)
        self._focal_px = k.fx_px
        weight = observed.weight * KEYPOINT_TRUST
        self._weight = torch.from_numpy(weight).float()
        self._pixels = torch.from_numpy(np.nan_to_num(observed.keypoints_px)).float()
        size = np.where(observed.valid, observed.size_px, np.nan)
        typical = np.nanmedian(size)
        share_px = config.landmark_2d_ratio * np.where(np.isfinite(size), size, typical)
        self._sigma_px = torch.from_numpy(np.hypot(share_px, config.landmark_2d_px)).float()
        step_s = np.diff(observed.frame_time_s)
        self._step_s = torch.from_numpy(step_s).float()
        self._prior_weight = max(1.0, config.prior_share * int(observed.valid.sum()))
        with torch.no_grad():
            phenotype = {name: torch.tensor(value) for name, value in base_shape.items()}
            self.start_rest = with_landmarks(model.rest_skeleton(phenotype))
        self.start_body_height_m = float(self.start_rest.body_height_m)

    def shape(self, parameters: Parameters) -> dict[str, torch.Tensor]:
        """Phenotypes in [0, 1] and lengths in [-1, 1]."""
        values = {name: torch.tensor(value) for name, value in self._base_shape.items()}
        for i, name in enumerate(SHAPE_PARAMETERS):
            least = -1.0 if name in PEOPLES_LENGTHS else 0.0
            values[name] = (values[name] + parameters.shape_offset[i]).clamp(least, 1.0)
        return values

    def translation_m(self, parameters: Parameters, body_height_m: torch.Tensor) -> torch.Tensor:
        """(T, 3) root translations, scaled by the body. It then keeps its place and size in the image while its shape
        changes, so that is not coupled to every translation."""
        return parameters.translation_m * (body_height_m / self.start_body_height_m)

    def predict(self, parameters: Parameters) -> Prediction:
        """Pose the body."""
        rest = with_landmarks(self.model.rest_skeleton(self.shape(parameters)))
        R_root = matrix_from_rot6d(parameters.root_rot6d)
        R = torch.cat([R_root[:, None], matrix_from_axis_angle(parameters.angles_rad)], 1)
        joints, R_camera_joint = forward_kinematics(
            R, self.translation_m(parameters, rest.body_height_m), rest.rest_joints_m
        )
        keypoints = rest.keypoints_m(joints, R_camera_joint)
        return Prediction(joints, keypoints, R_camera_joint, R, rest.rest_joints_m, rest.body_height_m)

    def residual_px(self, prediction: Prediction) -> torch.Tensor:
        """(T, K, 2) projected minus observed keypoints."""
        z = prediction.keypoints_m[..., 2:].clamp_min(0.1)
        projected = self._focal_px * prediction.keypoints_m[..., :2] / z + self._center
        return projected - self._pixels

    def cost(self, parameters: Parameters) -> torch.Tensor:
        """The negative log posterior, up to a constant."""
        prediction = self.predict(parameters)
        error = self.residual_px(prediction) / self._sigma_px[:, None, None]
        data = (self._weight * _half_huber((error**2).sum(-1))).sum()
        lifted = self._as_lifted(prediction) + _hinges(parameters)
        return data + lifted + self._motion(prediction) + self._shape(prediction, parameters)

    def _as_lifted(self, prediction: Prediction) -> torch.Tensor:
        """Joints (relative to the pelvis, for a body of this shape) and angles against those of the lifter."""
        zero = torch.zeros_like(prediction.joints_m[:, 0])
        wanted, _ = forward_kinematics(self._lifted, zero, prediction.rest_joints_m)
        off = prediction.joints_m - prediction.joints_m[:, :1] - wanted
        joints = _half_huber(off.square().sum(-1) / self._joint_sigma_m**2).sum(1)
        # The squared distance of two rotation matrices is twice the squared angle, for small angles.
        apart = (prediction.R_parent_joint - self._lifted).square().sum((-1, -2)) / 2
        angles = _half_huber(apart / self._angle_sigma**2).sum(1)
        return (self._believed * (joints + angles)).sum()

    def _motion(self, prediction: Prediction) -> torch.Tensor:
        """Accelerations of joints; frames may be any time apart."""
        if len(self._step_s) < 2:
            return torch.zeros(())
        step = self._step_s[:, None, None]
        velocity = prediction.joints_m.diff(dim=0) / step
        between = 0.5 * (step[1:] + step[:-1])
        # Scaled to the mean height: else the prior would favor small bodies, whose accelerations are smaller.
        scale = self.config.acceleration_m_s2 * prediction.body_height_m / self.config.body_height_m
        acceleration = velocity.diff(dim=0) / between / scale
        # Joints move together: 22 accelerations weigh as about 7 independent ones.
        return 0.3 * _half_huber((acceleration**2).sum(-1), 1.5).sum()

    def _shape(self, prediction: Prediction, parameters: Parameters) -> torch.Tensor:
        c = self.config
        sigma = torch.tensor([*[c.shape_sigma] * 3, *(sigma for _, sigma in PEOPLES_LENGTHS.values())])
        spread = (parameters.shape_offset[1:] / sigma).square().sum()
        body_height = ((prediction.body_height_m - c.body_height_m) / c.body_height_sigma_m).square()
        return 0.5 * self._prior_weight * (spread + body_height)


def _half_huber(square: torch.Tensor, threshold: float = 2.0) -> torch.Tensor:
    """Negative log likelihood of a squared residual in sigmas: Huber cost, linear beyond the threshold."""
    return 0.5 * huber_of_square(square, threshold)


def _hinges(parameters: Parameters) -> torch.Tensor:
    """Knees and elbows do not bend the wrong way."""
    total = torch.zeros(())
    for name, (axis, sense) in _HINGES.items():
        bent = -sense * parameters.angles_rad[:, JOINT_INDEX[name] - 1, axis]
        total = total + (torch.relu(bent) / _OVERSTRETCH_SIGMA_RAD).square().sum()
    return 0.5 * total
