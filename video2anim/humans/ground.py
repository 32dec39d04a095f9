"""Floor under a moving body."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SUPPORT_WINDOW_S = 0.6
"""People who stand, walk or run have a foot on the ground at least once in this time."""
LEVEL_GAP_M = 0.25
"""Heights with a larger gap between them are different levels of ground."""
SUPPORT_SIGMA_M = 0.03
"""Standard deviation of the height of what supports a body: the spread of floor heights of stage humans on clips with
one floor. Heights that spread by twice as much are not of one level."""


def level_frame(up_camera: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """R_world_camera with `up_camera` on +Y and the camera's horizontal forward direction on -Z.

    A camera that looks straight up or down has no horizontal forward; its image x axis then gives +X.
    """
    y = up_camera / np.linalg.norm(up_camera)
    forward = np.array([0.0, 0.0, 1.0]) - y[2] * y
    if np.linalg.norm(forward) > 1e-3:
        z = -forward / np.linalg.norm(forward)
        x = np.cross(y, z)
    else:
        x = np.array([1.0, 0.0, 0.0]) - y[0] * y
        x /= np.linalg.norm(x)
        z = np.cross(x, y)
    return np.stack([x, y, z])


def floor_height(
    lowest_m: Float[np.ndarray, "frames"], fps: float, *, window_s: float = SUPPORT_WINDOW_S
) -> tuple[float, float]:
    """Height of the lowest level that carries the body in several windows, and the spread of that level.

    Somebody who stands, walks or runs has a foot down at least once in about 0.6 s, and others a hand or a knee, so the
    low end of the skin in every such window is a support. The floor is their `lowest_level`.

    Args:
        lowest_m: lowest point of the skin, valid frames in order of time.
    """
    windows = max(1, round(len(lowest_m) / max(1.0, window_s * fps)))
    level = lowest_level(np.array([np.percentile(part, 10) for part in np.array_split(lowest_m, windows)]))
    return float(np.median(level)), float(np.std(level))


def lowest_level(
    supports_m: Float[np.ndarray, "windows"], *, level_gap_m: float = LEVEL_GAP_M
) -> Float[np.ndarray, "some_windows"]:
    """Heights of the floor among those at which a body stood, sorted.

    Supports may lie at several heights (steps, a roof, a bed): they are split at gaps above `level_gap_m`,
    and the lowest level of at least two windows (and a twelfth of all) is the floor. Stairs are closer to each other:
    a level whose heights spread too much is cut to its lowest part, if a fifth of all windows are in it.
    """
    supports_m = np.sort(supports_m)
    levels = np.split(supports_m, np.flatnonzero(np.diff(supports_m) > level_gap_m) + 1)
    wanted = max(2, len(supports_m) / 12)
    level = next((one for one in levels if len(one) >= wanted), max(levels, key=len))
    return _lowest_stair(level, len(supports_m))


def _lowest_stair(heights_m: Float[np.ndarray, "windows"], windows: int) -> Float[np.ndarray, "some_windows"]:
    """The lowest of sorted heights, cut at the widest gap while they spread more than the noise of one level."""
    while np.std(heights_m) > 2 * SUPPORT_SIGMA_M:
        cut = int(np.argmax(np.diff(heights_m))) + 1
        low = heights_m[:cut]
        # A ramp, by an error of gravity, has no dominant gap; two outlier windows are no level.
        if len(low) < max(3, windows / 5) or heights_m[cut] - low[-1] < 2 * np.std(low):
            break
        heights_m = low
    return heights_m
