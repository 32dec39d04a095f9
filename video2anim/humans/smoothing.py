"""Low-pass filter for observed motion: takes measurement jitter out, leaves human motion in."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import butter, sosfiltfilt

from video2anim.geometry.rotations import continuous_quaternions, matrix_from_quaternion, quaternion_from_matrix

_ORDER = 2
"""Forward and backward: fourth order, no lag, the usual filter of gait analysis."""


def low_pass(
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"],
    translation_world_m: Float[np.ndarray, "frames 3"],
    valid: Bool[np.ndarray, "frames"],
    *,
    fps: float,
    cutoff_hz: float,
) -> tuple[Float[np.ndarray, "frames 22 3 3"], Float[np.ndarray, "frames 3"]]:
    """Rotations and root filtered within each run of valid frames; other frames, and runs too short, are unchanged.

    Raises:
        ValueError: the cutoff is not between 0 and half the frame rate.
    """
    if not 0 < cutoff_hz < 0.5 * fps:
        raise ValueError(f"low_pass: want 0 < cutoff_hz < {0.5 * fps}, got {cutoff_hz}")
    sections = butter(_ORDER, cutoff_hz, fs=fps, output="sos")
    shortest = 3 * (_ORDER + 1) + 1
    R_smooth, translation_m = R_parent_joint.copy(), translation_world_m.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8)))
    for start, stop in edges.reshape(-1, 2):
        if stop - start < shortest:
            continue
        run = slice(start, stop)
        quaternions = continuous_quaternions(quaternion_from_matrix(R_parent_joint[run]))
        R_smooth[run] = matrix_from_quaternion(sosfiltfilt(sections, quaternions, axis=0))
        translation_m[run] = sosfiltfilt(sections, translation_world_m[run], axis=0)
    return R_smooth, translation_m
