"""Low-pass filter that removes the jitter of the landmarks from a fitted motion."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.signal import butter, sosfiltfilt

from video2anim.geometry.rotations import continuous_quaternions, matrix_from_quaternion, quaternion_from_matrix
from video2anim.humans.optimize import reposed
from video2anim.humans.problem import FittedBody, Observations

_ORDER = 2
"""Forward and backward: fourth order, no lag, the usual filter of gait analysis."""


def smoothed_fit(observed: Observations, fit: FittedBody, cutoff_hz: float) -> FittedBody:
    """The fit after a low-pass filter; unchanged where the cutoff is 0 or not below half the frame rate."""
    frames = len(observed.valid)
    fps = 1.0 / float(np.median(np.diff(observed.frame_time_s))) if frames > 1 else 0.0
    if not 0 < cutoff_hz < 0.5 * fps:
        return fit
    R, translation_m = low_pass(fit.R_parent_joint, fit.translation_camera_m, fps=fps, cutoff_hz=cutoff_hz)
    return reposed(observed, fit, R, translation_m)


def low_pass(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_m: Float[np.ndarray, "frames 3"],
    *,
    fps: float,
    cutoff_hz: float,
) -> tuple[Float[np.ndarray, "frames 22 3 3"], Float[np.ndarray, "frames 3"]]:
    """Filtered rotations and root translation; clips too short for the filter are unchanged.

    Raises:
        ValueError: the cutoff is not between 0 and half the frame rate.
    """
    if not 0 < cutoff_hz < 0.5 * fps:
        raise ValueError(f"low_pass: want 0 < cutoff_hz < {0.5 * fps}, got {cutoff_hz}")
    sections = butter(_ORDER, cutoff_hz, fs=fps, output="sos")
    if len(translation_m) < 3 * (_ORDER + 1) + 1:
        return R_parent_joint, translation_m
    quaternions = continuous_quaternions(quaternion_from_matrix(R_parent_joint))
    R_smooth = matrix_from_quaternion(sosfiltfilt(sections, quaternions, axis=0))
    return np.asarray(R_smooth), np.ascontiguousarray(sosfiltfilt(sections, translation_m, axis=0))
