"""Variations of a motion: mirrored, faster and slower, at another frame rate, shorter. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from scenemi.data.interpolate import blended, cubic_taps, nearest_rows, unit
from scenemi.data.retarget import RetargetedMotion
from video2anim.geometry.rotations import continuous_quaternions, matrix_from_quaternion, quaternion_from_matrix
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_NAMES

_OTHER = {"left": "right", "right": "left"}


def _mirror_name(name: str) -> str:
    side, _, rest = name.partition("_")
    return f"{_OTHER[side]}_{rest}" if side in _OTHER else name


MIRROR_JOINT: np.ndarray = np.array([JOINT_NAMES.index(_mirror_name(name)) for name in JOINT_NAMES])
"""For each joint the one of the other side."""
MIRROR_QUATERNION: np.ndarray = np.array([1.0, 1.0, -1.0, -1.0], np.float32)
"""Signs of w, x, y, z after reflection in the plane x = 0."""
_MIRROR_AXES = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True)
class WarpConfig:
    """A smooth random speed."""

    slowest: float = 0.8
    """Of the speed, and `fastest` the inverse: people walk at 0.8 to 1.25 times their usual speed (not measured)."""
    fastest: float = 1 / slowest
    longest_wave_frames: float = 600.0
    shortest_wave_frames: float = 120.0
    """Period of the change of speed."""


def mirrored(motion: RetargetedMotion) -> RetargetedMotion:
    """The motion reflected in the plane x = 0 with left and right exchanged."""
    R = motion.R_parent_joint[:, MIRROR_JOINT] * _MIRROR_AXES[:, None] * _MIRROR_AXES
    return replace(
        motion,
        translation_m=motion.translation_m * _MIRROR_AXES,
        R_parent_joint=R,
        contact=motion.contact[:, MIRROR_JOINT],
    )


def random_times(
    rng: np.random.Generator, count: int, frames: int, config: WarpConfig | None = None
) -> Float[np.ndarray, "count frames"]:
    """Source frame (from 0, rising) of each frame of a clip played at a smooth random speed.

    The speed is exp(a + b sin(...)), within [slowest, fastest] for `WarpConfig`.
    """
    config = config or WarpConfig()
    low, high = np.log(config.slowest), np.log(config.fastest)
    mean = rng.uniform(low, high, (count, 1))
    swing = rng.uniform(0.0, 1.0, (count, 1)) * np.minimum(mean - low, high - mean)
    waves = rng.uniform(1 / config.longest_wave_frames, 1 / config.shortest_wave_frames, (count, 1))
    phase = rng.uniform(0.0, 2 * np.pi, (count, 1))
    speed = np.exp(mean + swing * np.sin(2 * np.pi * waves * np.arange(frames - 1) + phase))
    return np.concatenate([np.zeros((count, 1)), np.cumsum(speed, axis=1)], axis=1)


def at_times(motion: RetargetedMotion, position: Float[np.ndarray, "new"]) -> RetargetedMotion:
    """The motion at these (fractional) frames; contacts are those of the nearest frame, ends are held."""
    count = np.full(position.shape, len(motion.translation_m))
    rows, weights = cubic_taps(position, count)
    quaternion = continuous_quaternions(quaternion_from_matrix(motion.R_parent_joint))
    return replace(
        motion,
        translation_m=blended(motion.translation_m, rows, weights),
        R_parent_joint=matrix_from_quaternion(unit(blended(quaternion, rows, weights))),
        contact=motion.contact[nearest_rows(position, count)],
    )


def resampled(motion: RetargetedMotion, fps: float, target_fps: float = FPS) -> RetargetedMotion:
    """The motion at another frame rate; frames are kept as they are where the rates divide.

    Raises:
        ValueError: a frame rate that is not above 0.
    """
    if not fps > 0 or not target_fps > 0:
        raise ValueError(f"resampled: want frame rates above 0, got {fps} and {target_fps}")
    step = fps / target_fps
    count = int(np.floor((len(motion.translation_m) - 1) / step + 1e-6)) + 1
    position = np.arange(count) * step
    if abs(step - round(step)) < 1e-6:
        rows = np.rint(position).astype(np.int64)
        return replace(
            motion,
            translation_m=motion.translation_m[rows],
            R_parent_joint=motion.R_parent_joint[rows],
            contact=motion.contact[rows],
        )
    return at_times(motion, position)


def cropped(motion: RetargetedMotion, start: int, stop: int) -> RetargetedMotion:
    """Frames [start, stop).

    Raises:
        ValueError: no frame is left, or the range is outside the clip.
    """
    if not 0 <= start < stop <= len(motion.translation_m):
        raise ValueError(f"cropped: want 0 <= start < stop <= {len(motion.translation_m)}, got {start}, {stop}")
    return replace(
        motion,
        translation_m=motion.translation_m[start:stop],
        R_parent_joint=motion.R_parent_joint[start:stop],
        contact=motion.contact[start:stop],
    )
