"""Noise of keyframes in training: the paper's Gaussian (3.2.1), and the errors that the video pipeline makes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float16, Int
from torch import Tensor

from scenemi.data.plain_files import read_arrays
from scenemi.features import ROTATIONS, TRANSLATION
from scenemi.model.kinematics import matrices, posed_joints
from video2anim.errors import InputError
from video2anim.geometry.rotations import matrix_from_axis_angle, rot6d_from_matrix

DEGREE = math.radians(1)
ERROR_SIZES = (0.4, 1.3)
"""Recorded errors are made smaller and larger by this: other people, cameras and lenses."""
REPORTED_SPREAD = 0.25
"""Standard deviation of the logarithm of reported over true noise: an estimator does not know its own error exactly."""


@dataclass(frozen=True, slots=True, eq=False)
class PipelineErrors:
    """Errors of estimated motions against the truth, runs of consecutive frames at 30 fps one after the other."""

    turn_rad: Float16[np.ndarray, "frames 22 3"]
    """Axis-angle of R_true^T R_estimated of every local rotation (root: in the world)."""
    shift_m: Float16[np.ndarray, "frames 3"]
    """Estimated minus true root in axes x right of, y up, z away from the camera; the mean of each run is zero."""
    start: Int[np.ndarray, "runs+1"]

    @classmethod
    def read(cls, path: Path) -> PipelineErrors:
        """From `training/pipeline_errors.py`.

        Raises:
            InputError: no such file, or not of these tables.
        """
        names = ("turn_rad", "shift_m", "start")
        turn_rad, shift_m, start = read_arrays(path, (), "file of pipeline errors", needed=names).values()
        frames = len(turn_rad) if turn_rad.ndim else 0
        good = turn_rad.shape == (frames, 22, 3) and shift_m.shape == (frames, 3) and start.ndim == 1
        good = good and start.dtype.kind in "iu" and len(start) > 1 and start[0] == 0 and start[-1] == frames
        good = good and turn_rad.dtype.kind == shift_m.dtype.kind == "f" and (np.diff(start.astype(np.int64)) > 0).all()
        if not good or not np.isfinite(turn_rad).all() or not np.isfinite(shift_m).all():
            raise InputError(f"{path}: tables of pipeline errors contradict each other; make them again")
        return cls(turn_rad, shift_m, start)

    def draw(
        self, rng: np.random.Generator, frames: int
    ) -> tuple[Float[np.ndarray, "frames 22 3"], Float[np.ndarray, "frames 3"]]:
        """Errors for a window: radians, and meters in a world seen from a random side; zero shift over the ground in
        the first frame, which a window's own frame of reference starts from. Short runs go back and forth."""
        run = int(rng.integers(len(self.start) - 1))
        first, last = int(self.start[run]), int(self.start[run + 1]) - 1
        begin = int(rng.integers(first, max(last - frames, first) + 1))
        step = np.arange(frames) % max(1, 2 * (last - begin))
        rows = begin + np.where(step > last - begin, 2 * (last - begin) - step, step)
        turn, shift = self.turn_rad[rows].astype(np.float32), self.shift_m[rows].astype(np.float32)
        shift[:, [0, 2]] -= shift[0, [0, 2]]
        yaw = rng.uniform(0, 2 * np.pi)
        cos, sin = np.cos(yaw), np.sin(yaw)
        x, z = shift[:, 0].copy(), shift[:, 2].copy()
        shift[:, 0], shift[:, 2] = cos * x + sin * z, cos * z - sin * x
        size = rng.uniform(*ERROR_SIZES)
        return size * turn, size * shift


def gaussian(
    rng: np.random.Generator, frames: int, level: float
) -> tuple[Float[np.ndarray, "frames 22 3"], Float[np.ndarray, "frames 3"]]:
    """Noise of l degrees on every joint and l centimeters on the translation (paper 3.2.1): radians and meters."""
    turn, shift = rng.standard_normal((frames, 22, 3), np.float32), rng.standard_normal((frames, 3), np.float32)
    return turn * np.float32(level * DEGREE), shift * np.float32(0.01 * level)


def reported_level(
    rng: np.random.Generator, turn_rad: Float[np.ndarray, "frames 22 3"], shift_m: Float[np.ndarray, "frames 3"]
) -> tuple[float, float]:
    """Noise level that the model gets for a window: about its root mean square, in degrees and centimeters."""
    true = np.array([np.sqrt(np.square(turn_rad).mean()) / DEGREE, 100 * np.sqrt(np.square(shift_m).mean())])
    degrees, centimeters = true * np.exp(rng.normal(0.0, REPORTED_SPREAD, 2))
    return float(degrees), float(centimeters)


def noisy_features(
    features: Float[Tensor, "batch frames 201"],
    rest_joints_m: Float[Tensor, "batch 22 3"],
    turn_rad: Float[Tensor, "batch frames 22 3"],
    shift_m: Float[Tensor, "batch frames 3"],
) -> Float[Tensor, "batch frames 201"]:
    """Features (not normalized) of the motion with every local rotation turned and the root shifted."""
    R = matrices(features[..., ROTATIONS].unflatten(-1, (22, 6)))
    turned = R @ matrix_from_axis_angle(turn_rad)
    return features_of(turned, features[..., TRANSLATION] + shift_m, rest_joints_m)


def features_of(
    R_parent_joint: Float[Tensor, "batch frames 22 3 3"],
    translation_m: Float[Tensor, "batch frames 3"],
    rest_joints_m: Float[Tensor, "batch 22 3"],
) -> Float[Tensor, "batch frames 201"]:
    """Features of a motion in the canonical frame, not normalized."""
    joints = posed_joints(R_parent_joint, translation_m, rest_joints_m)
    return torch.cat([translation_m, rot6d_from_matrix(R_parent_joint).flatten(2), joints.flatten(2)], -1)
