"""Unit of length of a moving camera's path: what a body rests on does not move.

Images give the path of a camera up to its scale only. Where a foot, the seat, the back or a hand is in contact, its
path relative to the camera and that of the camera cancel. (SLAHMR (Ye et al. 2023) takes the scale from the motion of
people, too.)
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from video2anim.body.contact import LIKELY
from video2anim.geometry.projection import transform_points
from video2anim.humans.lifter_input import CONTACT_INDEX

_REST_S = 0.27
"""Contacts of this length or longer are rests, as in stage scene."""
_ACROSS_M, _ALONG_RATIO = 0.03, 0.03
"""Error of a joint's path over a rest, across and along the line of sight (share of the distance): spread of a standing
sole and of a body's distance (`video2anim.calibration.fit`)."""
_USUAL_LOG_SIGMA = 0.7
"""The background is usually as far as the person, within a factor of two."""


def camera_scale_m(
    joints_camera_m: Float[np.ndarray, "frames 22 3"],
    contact: Float[np.ndarray, "frames 8"],
    valid: Bool[np.ndarray, "frames"],
    T_first_camera: Float[np.ndarray, "frames 4 4"],
    fps: float,
) -> tuple[float, float]:
    """Meters per unit of the camera's path, and the standard deviation of its logarithm.

    `contact` holds probabilities in the order of `CONTACT_JOINTS`.

    Least squares over all rests with Cauchy's cost, and a prior by the person's distance. Overlapping rests count as
    one.
    """
    distance_m = float(np.median(joints_camera_m[valid, 0, 2]))
    step = max(1, round(_REST_S * fps))
    if len(valid) <= step or np.ptp(T_first_camera[:, :3, 3], axis=0).max() == 0:
        return distance_m, _USUAL_LOG_SIGMA
    turned = T_first_camera.copy()
    turned[:, :3, 3] = 0
    points_m = transform_points(turned, joints_camera_m[:, CONTACT_INDEX])
    touches = (contact > LIKELY) & valid[:, None]
    rests = np.lib.stride_tricks.sliding_window_view(touches, step + 1, axis=0).all(-1)
    frame, part = np.nonzero(rests)
    moved_m = points_m[frame + step, part] - points_m[frame, part]
    moved = T_first_camera[frame + step, :3, 3] - T_first_camera[frame, :3, 3]
    sight = points_m[frame, part] / np.linalg.norm(points_m[frame, part], axis=1, keepdims=True)
    along_m = _ALONG_RATIO * np.linalg.norm(points_m[frame, part], axis=1)

    def cost(log: float) -> float:
        off_m = moved_m + distance_m * np.exp(log) * moved
        along = (off_m * sight).sum(1)
        across = np.linalg.norm(off_m - along[:, None] * sight, axis=1)
        squared = (along / along_m) ** 2 + (across / _ACROSS_M) ** 2
        return float(0.5 * np.log1p(squared).sum() / step + 0.5 * (log / _USUAL_LOG_SIGMA) ** 2)

    logs = np.linspace(-2.5, 2.5, 101)
    start = logs[int(np.argmin([cost(log) for log in logs]))]
    fine = start + np.linspace(-0.05, 0.05, 101)
    best = float(fine[int(np.argmin([cost(log) for log in fine]))])
    bend = (cost(best + 0.02) - 2 * cost(best) + cost(best - 0.02)) / 0.02**2
    return distance_m * float(np.exp(best)), float(max(bend, 1 / _USUAL_LOG_SIGMA**2) ** -0.5)
