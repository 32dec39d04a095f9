"""Keyframes met exactly and smoothly: the residual at them is spread over the neighboring frames.

The differences between the wanted and the made pose (rotations in the tangent space of the made one, translation in
meters) are joined by a Gaussian process in time with a Matérn-7/2 kernel, and its mean is added to every frame. That
curve has six continuous derivatives, so that velocity, acceleration and jerk have no step at a keyframe, and it dies
away within a few `reach_frames`, so that it cannot overshoot in long gaps as a spline does. A thousandth of the
variance counts as noise: between keyframes that follow each other frame by frame (the seed of a long motion) the
differences are as rough as the two motions, and a curve through all of them would swing out beyond the last one. What
the curve leaves there, and a thousandth of the difference at lone keyframes, is added at the keyframes alone.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from scenemi.prior import WindowMotion
from video2anim.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle

REACH_FRAMES = 10.0
"""Time scale of the correction: a third of a second at 30 fps."""
ROUGH_SHARE = 1e-3
"""Share of the variance that is not carried over to other frames. With 1e-12 the jerk at the seams of a jittery motion
was 1.46 times the median, from 1e-4 to 1e-2 it was 1.0 to 0.95 times."""


def fit_keyframes(
    made: WindowMotion, wanted: WindowMotion, exact: Bool[np.ndarray, "frames"], reach_frames: float = REACH_FRAMES
) -> WindowMotion:
    """The motion `made`, moved so that it is `wanted` at the `exact` frames.

    Args:
        made: any motion.
        wanted: the poses to meet; rows that are not `exact` are not read.
        exact: frames to meet. None set: the motion as it is.
        reach_frames: time scale in which a correction dies away.
    """
    if not exact.any():
        return made
    keys = np.flatnonzero(exact)
    R_made_wanted = np.swapaxes(made.R_parent_joint[keys], -1, -2) @ wanted.R_parent_joint[keys]
    turn_rad = axis_angle_from_matrix(R_made_wanted)
    shift_m = wanted.translation_world_m[keys] - made.translation_world_m[keys]
    missing = np.concatenate([turn_rad.reshape(len(keys), -1), shift_m], -1)
    spread = spread_over_time(missing, keys, len(exact), reach_frames)
    turns_rad = spread[:, :-3].reshape(len(exact), -1, 3)
    R_parent_joint = made.R_parent_joint @ matrix_from_axis_angle(turns_rad)
    translation_m = made.translation_world_m + spread[:, -3:]
    R_parent_joint[keys], translation_m[keys] = wanted.R_parent_joint[keys], wanted.translation_world_m[keys]
    return WindowMotion(R_parent_joint, translation_m)


def spread_over_time(
    values: Float[np.ndarray, "keys channels"], keys: np.ndarray, frame_count: int, reach_frames: float = REACH_FRAMES
) -> Float[np.ndarray, "frames channels"]:
    """A smooth curve near values at some frames that returns to zero away from them."""
    frames = np.arange(frame_count)
    among = _matern(keys[:, None] - keys[None], reach_frames) + ROUGH_SHARE * np.eye(len(keys))
    return _matern(frames[:, None] - keys[None], reach_frames) @ cho_solve(cho_factor(among), values)


def _matern(lag_frames: np.ndarray, reach_frames: float) -> np.ndarray:
    """Matérn covariance of smoothness 7/2 (Rasmussen and Williams 2006, section 4.2)."""
    x = np.sqrt(7.0) * np.abs(lag_frames) / reach_frames
    return (1 + x + 0.4 * x**2 + x**3 / 15) * np.exp(-x)
